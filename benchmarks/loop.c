/* The sampled closed loop of the paper's spacecraft by hand, as the yardstick for `rollout.simulate`: star tracker and
 * gyro perfect, digital disturbance observer, law (57)/(60), torque held over a period, one RK4 step of the plant a
 * period on the anchored clock. `LANES` trials side by side in every array, so that each loop over them is vectors.
 *
 * METRICS = 0: only the largest commanded torque; 1: everything that a run of the library returns.
 * LANES = 1 is the scalar program. Build: gcc -O3 -march=native -ffast-math -fopenmp -shared -fPIC. */
#include <math.h>
#include <string.h>

#ifndef LANES
#define LANES 16
#endif
#ifndef FULL
#define FULL 1
#endif
#ifndef METRICS
#define METRICS 1
#endif

typedef double real;

/* Constants of a study, in this order in memory. */
typedef struct {
    real J[9], Ji[9]; /* inertia and its inverse, row by row */
    real qf[4];       /* fixed reference */
    real t_f, eta, delta, k1, width;
    real l_rate, bound_start, bound_floor; /* K2(t) */
    real amplitude[3], frequency[3], phase[3];
    real period, t_end, window, settling;
    real keep[9], first_keep[9]; /* (1 - e^(-A dt))/dt of the observer, whole and first period */
} Study;

typedef struct {
    real q[4][LANES], w[3][LANES], w_seen[3][LANES], d_hat[3][LANES], u[3][LANES];
    real peak[LANES];
    real square[LANES], hold[LANES], effort[LANES], settled[LANES], variation[3][LANES], rate[LANES], momentum[LANES];
    real angle[LANES], terminal_error[LANES], terminal_angle[LANES];
    int status[LANES];
    real bad_time[LANES];
} State;

#define SMALL static inline __attribute__((always_inline))

/* y = A x; with FULL = 0 only the diagonal of A, for a body in its principal axes. */
SMALL void times(const real *A, const real *x, real *y) {
    for (int i = 0; i < 3; i++)
        y[i] = FULL ? A[3 * i] * x[0] + A[3 * i + 1] * x[1] + A[3 * i + 2] * x[2] : A[4 * i] * x[i];
}

/* w x J w */
SMALL void gyroscopic(const real *J, const real *w, real *g) {
    real h[3];
    if (FULL) {
        times(J, w, h);
        g[0] = w[1] * h[2] - w[2] * h[1];
        g[1] = w[2] * h[0] - w[0] * h[2];
        g[2] = w[0] * h[1] - w[1] * h[0];
    } else {
        g[0] = (J[8] - J[4]) * w[1] * w[2];
        g[1] = (J[0] - J[8]) * w[2] * w[0];
        g[2] = (J[4] - J[0]) * w[0] * w[1];
    }
}

SMALL void slope(const Study *s, const real *x, const real *u, const real *d, real *f) {
    const real *q = x, *w = x + 4;
    f[0] = 0.5 * (q[3] * w[0] + q[1] * w[2] - q[2] * w[1]);
    f[1] = 0.5 * (q[3] * w[1] + q[2] * w[0] - q[0] * w[2]);
    f[2] = 0.5 * (q[3] * w[2] + q[0] * w[1] - q[1] * w[0]);
    f[3] = -0.5 * (q[0] * w[0] + q[1] * w[1] + q[2] * w[2]);
    real g[3];
    gyroscopic(s->J, w, g);
    for (int k = 0; k < 3; k++) g[k] = u[k] + d[k] - g[k];
    times(s->Ji, g, f + 4);
}

SMALL void rk4(const Study *s, real *x, const real *u, real (*d)[3], real h) {
    real k1[7], k2[7], k3[7], k4[7], y[7];
    slope(s, x, u, d[0], k1);
    for (int i = 0; i < 7; i++) y[i] = x[i] + 0.5 * h * k1[i];
    slope(s, y, u, d[1], k2);
    for (int i = 0; i < 7; i++) y[i] = x[i] + 0.5 * h * k2[i];
    slope(s, y, u, d[1], k3);
    for (int i = 0; i < 7; i++) y[i] = x[i] + h * k3[i];
    slope(s, y, u, d[2], k4);
    for (int i = 0; i < 7; i++) x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
}

SMALL void unit(real *q) {
    real r = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) q[i] *= r;
}

SMALL real angle_to(const Study *s, const real *q) {
    const real *p = s->qf;
    real a = p[3] * q[0] - q[3] * p[0] - (p[1] * q[2] - p[2] * q[1]);
    real b = p[3] * q[1] - q[3] * p[1] - (p[2] * q[0] - p[0] * q[2]);
    real c = p[3] * q[2] - q[3] * p[2] - (p[0] * q[1] - p[1] * q[0]);
    real v = p[3] * q[3] + p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    return 2.0 * atan2(sqrt(a * a + b * b + c * c), fabs(v));
}

SMALL real primitive(real x, real g0, real g1, real g2) {
    return x * (g0 + x * (0.5 * (-3.0 * g0 + 4.0 * g1 - g2) + x * (2.0 * g0 - 4.0 * g1 + 2.0 * g2) * (1.0 / 3.0)));
}

SMALL real clip01(real x) { return fmin(fmax(x, 0.0), 1.0); }

/* One period of one trial; everything that does not depend on the trial is in the arguments. */
SMALL void period(const Study *s, State *z, int i, real t, real dt, real dt_before, const real *keep, int hold,
                  real k2, real (*d)[3], real (*d_cross)[3]) {
    real x[7], ws[3], dh[3], u[3];
    for (int k = 0; k < 4; k++) x[k] = z->q[k][i];
    for (int k = 0; k < 3; k++) {
        x[4 + k] = z->w[k][i];
        ws[k] = z->w_seen[k][i];
        dh[k] = z->d_hat[k][i];
        u[k] = z->u[k][i];
    }
    const real *w = x + 4, *J = s->J, *Ji = s->Ji;
    real x_start[7];
    memcpy(x_start, x, sizeof x);
    /* observer */
    real g0[3], g1[3], gained[3], news[3];
    gyroscopic(J, w, g0);
    gyroscopic(J, ws, g1);
    for (int k = 0; k < 3; k++) gained[k] = w[k] - ws[k];
    times(J, gained, news);
    for (int k = 0; k < 3; k++) news[k] -= dt_before * (u[k] - 0.5 * (g0[k] + g1[k]) + dh[k]);
    times(keep, news, gained);
    for (int k = 0; k < 3; k++) dh[k] += gained[k];
    /* law */
    real tau = hold ? 1.0 : s->t_f - t, c = tau, e = hold ? 1.0 : s->eta;
    real a = hold ? 2.0 : 2.0 * (s->eta - 1.0) / tau, b = hold ? s->k1 : 2.0 * s->eta / (tau * tau);
    real q4 = x[3], ww = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    real rate[7], zero[3] = {0, 0, 0};
    slope(s, x, zero, zero, rate);
    /* |T J^-1| of Frobenius */
    real n = 0.0;
    for (int k = 0; k < 3; k++) {
        int l = (k + 1) % 3, m = (k + 2) % 3;
        if (FULL) {
            real a0 = Ji[k], a1 = Ji[3 + k], a2 = Ji[6 + k]; /* a column */
            real b0 = q4 * a0 + x[1] * a2 - x[2] * a1, b1 = q4 * a1 + x[2] * a0 - x[0] * a2,
                 b2 = q4 * a2 + x[0] * a1 - x[1] * a0;
            n += b0 * b0 + b1 * b1 + b2 * b2;
        } else {
            n += Ji[4 * k] * Ji[4 * k] * (q4 * q4 + x[l] * x[l] + x[m] * x[m]);
        }
    }
    real switching = sqrt(n) * k2, wanted[3], y[3], sliding;
    for (int k = 0; k < 3; k++) {
        real error = x[k] - s->qf[k];
        sliding = c * rate[k] + e * error;
        wanted[k] = 0.5 * ww * x[k] - switching * tanh(sliding / s->width) - a * rate[k] - b * sliding;
    }
    real dot = x[0] * wanted[0] + x[1] * wanted[1] + x[2] * wanted[2];
    real norm2 = q4 * q4 + x[0] * x[0] + x[1] * x[1] + x[2] * x[2], inverse = 1.0 / (q4 * norm2);
    real cross[3] = {x[1] * wanted[2] - x[2] * wanted[1], x[2] * wanted[0] - x[0] * wanted[2],
                     x[0] * wanted[1] - x[1] * wanted[0]};
    real most = 0.0;
    for (int k = 0; k < 3; k++) y[k] = (q4 * q4 * wanted[k] + x[k] * dot - q4 * cross[k]) * inverse;
    times(J, y, u);
    for (int k = 0; k < 3; k++) {
        u[k] += g0[k] - dh[k];
        most = fmax(most, fabs(u[k]));
    }
#if METRICS
    real error0[3], rate0[3], angle0 = z->angle[i], jump[3];
    for (int k = 0; k < 3; k++) {
        error0[k] = x[k] - s->qf[k];
        rate0[k] = rate[k];
        jump[k] = fabs(u[k] - z->u[k][i]);
    }
#endif
    rk4(s, x, u, d, dt);
    unit(x);
    for (int k = 0; k < 4; k++) z->q[k][i] = x[k];
    for (int k = 0; k < 3; k++) {
        z->w[k][i] = x[4 + k];
        z->w_seen[k][i] = x_start[4 + k];
        z->d_hat[k][i] = dh[k];
        z->u[k][i] = u[k];
    }
    z->peak[i] = fmax(z->peak[i], most);
#if METRICS
    real t_next = t + dt;
    z->effort[i] += dt * (fabs(u[0]) + fabs(u[1]) + fabs(u[2]));
    for (int k = 0; k < 3; k++) z->variation[k][i] += t > s->t_f + 1e-9 * s->period ? jump[k] : 0.0;
    /* error over the interval: cubic, its square a parabola */
    real end[7];
    slope(s, x, zero, zero, end);
    real e0 = 0.0, e1 = 0.0, e2 = 0.0;
    for (int k = 0; k < 3; k++) {
        real last = x[k] - s->qf[k], middle = 0.5 * (error0[k] + last) + 0.125 * dt * (rate0[k] - end[k]);
        e0 += error0[k] * error0[k];
        e1 += middle * middle;
        e2 += last * last;
    }
    real upper = clip01((s->t_f + s->window - t) / dt), lower = clip01((s->t_f - t) / dt);
    z->square[i] += dt * (primitive(upper, e0, e1, e2) - primitive(lower, e0, e1, e2));
    z->hold[i] = t_next > s->t_f ? fmax(z->hold[i], sqrt(e2)) : z->hold[i];
    real angle1 = angle_to(s, x);
    int above0 = !(angle0 < s->settling), above1 = !(angle1 < s->settling);
    real crossing = t + dt * (angle0 - s->settling) / ((above0 && !above1) ? angle0 - angle1 : 1.0);
    z->settled[i] = above1 ? 1e300 : (above0 ? crossing : z->settled[i]);
    z->angle[i] = angle1;
    real ww1 = x[4] * x[4] + x[5] * x[5] + x[6] * x[6];
    z->rate[i] = fmax(z->rate[i], sqrt(ww1));
    real h[3];
    times(J, x + 4, h);
    z->momentum[i] = fmax(z->momentum[i], sqrt(h[0] * h[0] + h[1] * h[1] + h[2] * h[2]));
    /* the state at t_f, inside the period that contains it */
    int near = (s->qf[3] < 0.0 ? -x[3] : x[3]) < 1e-3, fast = ww1 * dt * dt > 1.0;
    int code = near ? 3 : (fast ? 2 : 0), first = z->status[i] == 0 && code != 0;
    z->bad_time[i] = first ? t_next : z->bad_time[i];
    z->status[i] = first ? code : z->status[i];
    if (t < s->t_f && s->t_f <= t_next) { /* the same for all trials */
        rk4(s, x_start, u, d_cross, s->t_f - t);
        unit(x_start);
        real v = 0.0;
        for (int k = 0; k < 3; k++) v += (x_start[k] - s->qf[k]) * (x_start[k] - s->qf[k]);
        z->terminal_error[i] = sqrt(v);
        z->terminal_angle[i] = angle_to(s, x_start);
    }
#endif
}

SMALL void disturbance(const Study *s, real t, real *d) {
    for (int k = 0; k < 3; k++) d[k] = s->amplitude[k] * sin(s->frequency[k] * t + s->phase[k]);
}

/* trials: a multiple of LANES. q0: (trials, 4); out: (trials, 1) or, with METRICS, (trials, 12): peak_torque,
 * terminal_error, terminal_angle, window_error, hold_error, effort, settling_time, chattering, peak_rate,
 * peak_momentum, status, bad_time. nodes: (steps + 1,) times. */
void simulate(const Study *s, const real *nodes, int steps, const real *q0, int trials, real *out) {
    const int columns = METRICS ? 12 : 1;
#pragma omp parallel for schedule(static)
    for (int block = 0; block < trials / LANES; block++) {
        State z;
        memset(&z, 0, sizeof z);
        for (int i = 0; i < LANES; i++) {
            real q[4];
            for (int k = 0; k < 4; k++) z.q[k][i] = q[k] = q0[4 * (block * LANES + i) + k];
#if METRICS
            z.angle[i] = angle_to(s, q);
            z.settled[i] = z.angle[i] < s->settling ? 0.0 : 1e300;
#endif
        }
        real dt_before = 0.0;
        for (int n = 0; n < steps; n++) {
            real t = nodes[n], dt = nodes[n + 1] - t, d[3][3], d_cross[3][3];
            if (!(dt > 0.0)) continue;
            int partial = dt_before > 0.0 && dt_before < s->period * (1.0 - 1e-12) && n > 0 && nodes[n - 1] == 0.0;
            const real *keep = partial ? s->first_keep : s->keep;
            int hold = t >= s->t_f - s->delta - 1e-9 * s->period;
            real k2 = s->bound_floor + exp(-s->l_rate * t) * (s->bound_start - s->bound_floor);
            disturbance(s, t, d[0]);
            disturbance(s, t + 0.5 * dt, d[1]);
            disturbance(s, t + dt, d[2]);
            disturbance(s, t, d_cross[0]);
            disturbance(s, 0.5 * (t + s->t_f), d_cross[1]);
            disturbance(s, s->t_f, d_cross[2]);
#pragma omp simd
            for (int i = 0; i < LANES; i++)
                period(s, &z, i, t, dt, dt_before, keep, hold, k2, d, d_cross);
            dt_before = dt;
        }
        for (int i = 0; i < LANES; i++) {
            real *row = out + (long)columns * (block * LANES + i);
            row[0] = z.peak[i];
#if METRICS
            real most = fmax(z.variation[0][i], fmax(z.variation[1][i], z.variation[2][i]));
            real values[11] = {z.terminal_error[i], z.terminal_angle[i], sqrt(z.square[i] / s->window),
                               fmax(z.hold[i], z.terminal_error[i]), z.effort[i], z.settled[i],
                               most / (s->t_end - s->t_f), z.rate[i], z.momentum[i], z.status[i], z.bad_time[i]};
            memcpy(row + 1, values, sizeof values);
#endif
        }
    }
}
