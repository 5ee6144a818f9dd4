/* The sampled closed loop of `scenarios/cubesat.toml` by hand, to compare `montecarlo.run` with: star tracker and gyro
 * with noise and a drifting bias, steady-state attitude filter, disturbance observer, the law on the error quaternion,
 * one period of delay, three wheels with limits and a first-order lag, drawn inertia and disturbance phase, one RK4
 * step a period. `LANES` trials side by side; each loop over them is vectors, and what they share is computed once.
 *
 * POINTING = 1 adds APE, MPE, RPE, PDE, AKE, MKE and RKE. FULL = 0: the model and the wheels are along the body axes.
 * The noise is the library's (Threefry-2x32-20, Box and Muller), so that both compute the same trials.
 * Build: gcc -O3 -march=native -ffast-math -fopenmp -shared -fPIC. */
#include <stdint.h>

#include "loop.c"

#ifndef POINTING
#define POINTING 1
#endif
#define SUBSTEPS 1
#define DIRECTIONS 16
#define PROJECTIONS (3 + DIRECTIONS)
#define FAR 1e300
#define EACH_LANE _Pragma("omp simd") for (int i = 0; i < LANES; i++)

/* Constants of a scenario, in this order in memory. */
typedef struct {
    real J[9], Ji[9]; /* of the model that law and observer have */
    real qf[4];       /* fixed reference */
    real t_f, eta, k1, surface_rate, width, layer_time;
    real l_rate, bound_start, bound_floor; /* K2(t) */
    real amplitude[3], frequency[3], bias[3];
    real period, t_end, window, settling;
    real keep[9], first_keep[9];           /* (1 - e^(-A dt))/dt of the observer, whole and first period */
    real star_noise, gyro_noise, bias_rate; /* 1 sigma */
    real attitude_gain, bias_gain;
    real lag, axes[9], allocation[9], torque_limit, momentum_limit;
    real frame[9], after, pointing_window;
} Mission;

/* A control period. */
typedef struct {
    real t, t_next, hold, sample, weight, partial;
} Tick;

/* What is drawn for a trial before its run. */
typedef struct {
    real q[4], w[3], J[9], Ji[9], phase[3], gyro_bias[3], estimate[4], estimate_bias[3];
} Trial;

typedef real Lanes[LANES];

/* Pointing indices of one error: about each axis, and of the boresight's half-cone. */
typedef struct {
    Lanes largest[4], mean[4], relative[4], integral[5];
    Lanes high[PROJECTIONS], low[PROJECTIONS], means_high[PROJECTIONS], means_low[PROJECTIONS];
} Tally;

typedef struct {
    Lanes q[4], w[3], J[9], Ji[9], sin_phase[3], cos_phase[3];
    Lanes q0[4], w0[3]; /* at the start of the period */
    uint32_t key[6][LANES];
    Lanes noise[6], drift[3], fresh[9]; /* of this sample, of the bias; standard normal numbers */
    Lanes gyro_bias[3], estimate[4], estimate_bias[3], rate_read[3];
    Lanes seen_q[4], seen_w[3], d_hat[3], applied[3], stored[3];
    Lanes u[3], queue[3], v[3], h[3], c[3], gap[3], delivered[3][3], limited;
    Lanes peak, peak_delivered, saturated, effort, settled, variation[3], rate, momentum, wheel_momentum, wheel_torque;
    Lanes square, square_angle, hold, hold_angle, angle, angle0, terminal_error, terminal_angle, last[3];
    Lanes bad_time;
    int status[LANES];
#if POINTING
    Tally error, knowledge;
    Lanes first[5], until[5], end[5], part[5], rest[5];
#endif
} Flight;

/* What all trials share in a period. */
typedef struct {
    real t, dt, dt_before, dt_assumed, c, e, a, b, layer, k2, weight;
    const real *keep;
    uint32_t sample;
} Shared;

/* Elementary functions written out, since gcc keeps a loop scalar that calls the C library: fdlibm (Sun Microsystems,
 * 1993) and Cephes (Moshier, 1989), as in `ptsmc_jax.numerics.elementary`. */
SMALL real horner(real x, const real *c, int n) {
    real sum = c[n - 1];
    for (int k = n - 2; k >= 0; k--) sum = sum * x + c[k];
    return sum;
}

/* sin and cos of u turns */
SMALL void of_turns(real u, real *sine, real *cosine) {
    static const real S[6] = {-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
                              2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10};
    static const real C[6] = {4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
                              -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11};
    real quarter = floor(4.0 * u + 0.5), x = (u - 0.25 * quarter) * 6.283185307179586, z = x * x;
    real s = x + x * z * horner(z, S, 6), c = 1.0 - (0.5 * z - z * z * horner(z, C, 6));
    quarter -= 4.0 * floor(0.25 * quarter); /* selections by arithmetic, which gcc keeps as vectors */
    real half = floor(0.5 * quarter), odd = quarter - 2.0 * half, sign = 1.0 - 2.0 * half;
    *sine = sign * (s + odd * (c - s));
    *cosine = sign * (1.0 - 2.0 * odd) * (c + odd * (s - c));
}

SMALL real logarithm(real x) {
    static const real L[7] = {6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01,
                              2.222219843214978396e-01, 1.818357216161805012e-01, 1.531383769920937332e-01,
                              1.479819860511658591e-01};
    int64_t bits, rest;
    memcpy(&bits, &x, 8);
    int64_t exponent = (bits - 0x3FE6A09E667F3BCD) >> 52;
    rest = bits - (exponent << 52);
    real f, k = (real)exponent;
    memcpy(&f, &rest, 8);
    f -= 1.0;
    real s = f / (2.0 + f), square = 0.5 * f * f;
    return k * 0.6931471805599453 + f - square + s * (square + s * s * horner(s * s, L, 7));
}

/* angle of the point (x, y), both at least 0 */
SMALL real arctangent(real y, real x) {
    static const real P[5] = {-6.485021904942025371773e01, -1.228866684490136173410e02, -7.500855792314704667340e01,
                              -1.615753718733365076637e01, -8.750608600031904122785e-01};
    static const real Q[6] = {1.945506571482613964425e02, 4.853903996359136964868e02, 4.328810604912902668951e02,
                              1.650270098316988542046e02, 2.485846490142306297962e01, 1.0};
    int flat = y <= 0.4142135623730950 * x, steep = y > 2.414213562373095 * x;
    real top = flat ? y : (steep ? -x : y - x), bottom = flat ? x : (steep ? y : y + x);
    real w = top / (bottom == 0.0 ? 1.0 : bottom), z = w * w;
    real part = w + w * z * horner(z, P, 5) / horner(z, Q, 6);
    return part + (flat ? 0.0 : (steep ? 1.5707963267948966 : 0.7853981633974483));
}

/* 1 - 2 / (e^(2 |x|) + 1) with the sign of x */
SMALL real hyperbolic_tangent(real x) {
    static const real E[13] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040, 1.0 / 40320,
                               1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800, 1.0 / 479001600};
    real y = fmin(2.0 * fabs(x), 40.0), k = floor(y * 1.4426950408889634 + 0.5);
    real e = horner(y - k * 0.6931471805599453, E, 13), power;
    int64_t bits = (int64_t)(k + 1023.0) << 52;
    memcpy(&power, &bits, 8);
    real size = 1.0 - 2.0 / (e * power + 1.0);
    return x < 0.0 ? -size : size;
}

SMALL void cross(const real *a, const real *b, real *c) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

SMALL real dot(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

SMALL void multiply(const real *p, const real *q, real *r) {
    real c[3];
    cross(p, q, c);
    for (int k = 0; k < 3; k++) r[k] = p[3] * q[k] + q[3] * p[k] + c[k];
    r[3] = p[3] * q[3] - dot(p, q);
}

/* p* q */
SMALL void relative(const real *p, const real *q, real *r) {
    real inverse[4] = {-p[0], -p[1], -p[2], p[3]};
    multiply(inverse, q, r);
}

SMALL void full_times(const real *A, const real *x, real *y) {
    for (int i = 0; i < 3; i++) y[i] = A[3 * i] * x[0] + A[3 * i + 1] * x[1] + A[3 * i + 2] * x[2];
}

/* q turned by a rotation vector */
SMALL void turn(const real *q, const real *r, real *turned) {
    real square = dot(r, r), small = square < 1e-6 ? 1.0 : 0.0, angle = sqrt(square + small), sine, cosine;
    of_turns(angle * 0.07957747154594767, &sine, &cosine);
    real scale = small * (0.5 - square / 48.0 + square * square / 3840.0) + (1.0 - small) * sine / angle;
    real scalar = small * (1.0 - square / 8.0 + square * square / 384.0) + (1.0 - small) * cosine;
    real by[4] = {scale * r[0], scale * r[1], scale * r[2], scalar};
    multiply(q, by, turned);
}

SMALL real angle_of(const real *q) { return 2.0 * arctangent(sqrt(dot(q, q)), fabs(q[3])); }

/* Two words of Threefry-2x32-20 as two normal numbers. */
SMALL void normals(uint32_t a, uint32_t b, uint32_t sample, uint32_t block, real *one, real *other) {
    uint32_t s[3] = {a, b, a ^ b ^ 0x1BD11BDAu}, x = sample + a, y = block + b;
#define ROUND(r) x += y, y = ((y << r) | (y >> (32 - r))) ^ x
#define GROUP(r0, r1, r2, r3, n) \
    ROUND(r0); ROUND(r1); ROUND(r2); ROUND(r3); x += s[(n + 1) % 3], y += s[(n + 2) % 3] + n + 1u
    GROUP(13, 15, 26, 6, 0);
    GROUP(17, 29, 16, 24, 1);
    GROUP(13, 15, 26, 6, 2);
    GROUP(17, 29, 16, 24, 3);
    GROUP(13, 15, 26, 6, 4);
    real radius = sqrt(-2.0 * logarithm(((real)x + 0.5) * 0x1p-32)), sine, cosine;
    of_turns(((real)y + 0.5) * 0x1p-32, &sine, &cosine);
    *one = radius * cosine;
    *other = radius * sine;
}

/* Three normal numbers of a stream for one sample. */
SMALL void draw_three(const Flight *z, int i, int stream, uint32_t sample, Lanes *into) {
    real n[4];
    normals(z->key[2 * stream][i], z->key[2 * stream + 1][i], sample, 0, n, n + 1);
    normals(z->key[2 * stream][i], z->key[2 * stream + 1][i], sample, 1, n + 2, n + 3);
    for (int k = 0; k < 3; k++) into[k][i] = n[k];
}

SMALL void draw(Flight *z, int stream, uint32_t sample, Lanes *into) {
    EACH_LANE draw_three(z, i, stream, sample, into);
}

#define LOAD(a, n, from) \
    real a[n]; \
    for (int k = 0; k < n; k++) a[k] = z->from[k][i]
#define STORE(a, n, into) \
    for (int k = 0; k < n; k++) z->into[k][i] = a[k]

/* Sensors, filter, observer, law and the command of the actuators. */
SMALL void control(const Mission *s, Flight *z, int i, const Shared *now) {
    LOAD(q, 4, q);
    LOAD(w, 3, w);
    LOAD(old, 4, estimate);
    LOAD(bias, 3, estimate_bias);
    LOAD(read, 3, rate_read);
    STORE(q, 4, q0);
    STORE(w, 3, w0);
    real star[3], gyro[3], measured[4], p[4], r[3], a[3], b[3], ab[3], residual[3], e[4];
    for (int k = 0; k < 3; k++) {
        real star_next = s->star_noise * z->fresh[k][i], gyro_next = s->gyro_noise * z->fresh[3 + k][i];
        star[k] = star_next + now->weight * (z->noise[k][i] - star_next);
        z->gyro_bias[k][i] += s->bias_rate * now->dt_before * z->fresh[6 + k][i];
        gyro[k] = w[k] + gyro_next + now->weight * (z->noise[3 + k][i] - gyro_next) + z->gyro_bias[k][i];
        z->noise[k][i] = star_next;
        z->noise[3 + k][i] = gyro_next;
        a[k] = read[k] - bias[k];
        b[k] = gyro[k] - bias[k];
    }
    turn(q, star, measured);
    cross(a, b, ab);
    real h = now->dt_before;
    for (int k = 0; k < 3; k++) r[k] = 0.5 * h * (a[k] + b[k]) + h * h / 12.0 * ab[k];
    turn(old, r, p);
    relative(p, measured, e);
    real scale = (e[3] < 0.0 ? -2.0 : 2.0) * now->weight;
    for (int k = 0; k < 3; k++) {
        residual[k] = scale * e[k];
        r[k] = s->attitude_gain * residual[k];
        bias[k] -= s->bias_gain * residual[k];
    }
    real seen[4], ws[3], ws_old[3];
    turn(p, r, seen);
    unit(seen);
    STORE(seen, 4, estimate);
    STORE(bias, 3, estimate_bias);
    STORE(gyro, 3, rate_read);
    STORE(seen, 4, seen_q);
    for (int k = 0; k < 3; k++) {
        ws[k] = gyro[k] - bias[k];
        ws_old[k] = z->seen_w[k][i];
        z->seen_w[k][i] = ws[k];
    }
    /* observer */
    LOAD(torque, 3, applied);
    LOAD(stored, 3, stored);
    LOAD(dh, 3, d_hat);
    real mid[3], carried[3], g0[3], g1[3], gained[3], news[3];
    for (int k = 0; k < 3; k++) mid[k] = 0.5 * (ws_old[k] + ws[k]), gained[k] = ws[k] - ws_old[k];
    cross(mid, stored, carried);
    gyroscopic(s->J, ws, g0);
    gyroscopic(s->J, ws_old, g1);
    times(s->J, gained, news);
    for (int k = 0; k < 3; k++) news[k] -= h * (torque[k] - carried[k] - 0.5 * (g0[k] + g1[k]) + dh[k]);
    times(now->keep, news, gained);
    for (int k = 0; k < 3; k++) dh[k] += h > 0.0 ? gained[k] : 0.0;
    STORE(dh, 3, d_hat);
    /* law */
    const real *Ji = s->Ji;
    real qe[4], vw[3], wanted[3], y[3], u[3], ww = dot(ws, ws), n = 0.0;
    relative(s->qf, seen, qe);
    real q4 = qe[3];
    cross(qe, ws, vw);
    for (int k = 0; k < 3; k++) {
        int l = (k + 1) % 3, m = (k + 2) % 3;
        if (FULL) {
            real a0 = Ji[k], a1 = Ji[3 + k], a2 = Ji[6 + k];
            real b0 = q4 * a0 + qe[1] * a2 - qe[2] * a1, b1 = q4 * a1 + qe[2] * a0 - qe[0] * a2,
                 b2 = q4 * a2 + qe[0] * a1 - qe[1] * a0;
            n += b0 * b0 + b1 * b1 + b2 * b2;
        } else {
            n += Ji[4 * k] * Ji[4 * k] * (q4 * q4 + qe[l] * qe[l] + qe[m] * qe[m]);
        }
    }
    real switching = sqrt(n) * now->k2;
    for (int k = 0; k < 3; k++) {
        real rate = 0.5 * (q4 * ws[k] + vw[k]), sliding = now->c * rate + now->e * qe[k];
        wanted[k] = 0.5 * ww * qe[k] - switching * hyperbolic_tangent(sliding * now->layer) - now->a * rate - now->b * sliding;
    }
    real along = dot(qe, wanted), inverse = 1.0 / (q4 * (q4 * q4 + dot(qe, qe))), vy[3];
    cross(qe, wanted, vy);
    for (int k = 0; k < 3; k++) y[k] = (q4 * q4 * wanted[k] + qe[k] * along - q4 * vy[k]) * inverse;
    times(s->J, y, u);
    real most = 0.0;
    for (int k = 0; k < 3; k++) {
        u[k] += g0[k] - dh[k];
        most = fmax(most, fabs(u[k]));
    }
    z->peak[i] = fmax(z->peak[i], most);
    /* actuators: compensation of the wheels, delay, allocation, limits */
    LOAD(hw, 3, h);
    LOAD(v, 3, v);
    LOAD(due, 3, queue);
    real Ah[3], wAh[3], target[3], limited = 0.0;
    times(s->axes, hw, Ah);
    cross(ws, Ah, wAh);
    for (int k = 0; k < 3; k++) z->queue[k][i] = due[k] + now->weight * (u[k] + wAh[k] - due[k]);
    times(s->allocation, due, target);
    real slip = s->lag * -expm1(-now->dt_assumed / s->lag), span = 1.0 / (now->dt_assumed - slip);
    for (int k = 0; k < 3; k++) {
        real left = hw[k] - slip * v[k];
        real c = fmin(fmax(target[k], (left - s->momentum_limit) * span), (left + s->momentum_limit) * span);
        c = fmin(fmax(c, -s->torque_limit), s->torque_limit);
        limited = c != target[k] ? 1.0 : limited;
        z->c[k][i] = c;
        z->gap[k][i] = c - v[k];
    }
    z->limited[i] = limited;
}

/* Time derivative of the true state under torque and disturbance, with the wheels' momentum in body axes. */
SMALL void rate_of(const real *J, const real *Ji, const real *x, const real *torque, const real *stored, real *f) {
    const real *w = x + 4;
    real c[3], h[3], g[3];
    cross(x, w, c);
    for (int k = 0; k < 3; k++) f[k] = 0.5 * (x[3] * w[k] + c[k]);
    f[3] = -0.5 * dot(x, w);
    full_times(J, w, h);
    for (int k = 0; k < 3; k++) h[k] += stored[k];
    cross(w, h, g);
    for (int k = 0; k < 3; k++) g[k] = torque[k] - g[k];
    full_times(Ji, g, f + 4);
}

/* A time of a substep: what does not depend on the trial. */
typedef struct {
    real slope, impulse, slope_impulse, sine[3], cosine[3];
} Stage;

/* One RK4 step of dt under a torque that is linear in time, mean - gap m and slope - gap k; momentum A h at its start.
 * stages: at its start, its middle and its end. */
SMALL void advance(const Mission *s, Flight *z, int i, real dt, real mean_gap, real slope_gap, real begun, real begun_gap,
                   const Stage *stages) {
    real x[7], y[7], f[4][7], torque[3][3], stored[3][3], mean[3], slope[3], h[3], vector[3];
    for (int k = 0; k < 4; k++) x[k] = z->q[k][i];
    for (int k = 0; k < 3; k++) x[4 + k] = z->w[k][i];
    LOAD(J, 9, J);
    LOAD(Ji, 9, Ji);
    for (int k = 0; k < 3; k++) vector[k] = z->c[k][i] - mean_gap * z->gap[k][i];
    times(s->axes, vector, mean);
    for (int k = 0; k < 3; k++) vector[k] = -slope_gap * z->gap[k][i];
    times(s->axes, vector, slope);
    for (int k = 0; k < 3; k++) vector[k] = z->h[k][i] - begun * z->c[k][i] + begun_gap * z->gap[k][i];
    times(s->axes, vector, h);
    for (int n = 0; n < 3; n++)
        for (int k = 0; k < 3; k++) {
            real swing = stages[n].sine[k] * z->cos_phase[k][i] + stages[n].cosine[k] * z->sin_phase[k][i];
            torque[n][k] = mean[k] + slope[k] * stages[n].slope + s->bias[k] + s->amplitude[k] * swing;
            stored[n][k] = h[k] - mean[k] * stages[n].impulse - slope[k] * stages[n].slope_impulse;
        }
    rate_of(J, Ji, x, torque[0], stored[0], f[0]);
    for (int k = 0; k < 7; k++) y[k] = x[k] + 0.5 * dt * f[0][k];
    rate_of(J, Ji, y, torque[1], stored[1], f[1]);
    for (int k = 0; k < 7; k++) y[k] = x[k] + 0.5 * dt * f[1][k];
    rate_of(J, Ji, y, torque[1], stored[1], f[2]);
    for (int k = 0; k < 7; k++) y[k] = x[k] + dt * f[2][k];
    rate_of(J, Ji, y, torque[2], stored[2], f[3]);
    for (int k = 0; k < 7; k++) x[k] += dt / 6.0 * (f[0][k] + 2.0 * (f[1][k] + f[2][k]) + f[3][k]);
    for (int k = 0; k < 4; k++) z->q[k][i] = x[k];
    for (int k = 0; k < 3; k++) z->w[k][i] = x[4 + k];
}

SMALL void renormalise(Flight *z, int i) {
    LOAD(q, 4, q);
    unit(q);
    STORE(q, 4, q);
}

SMALL real lagged(const Mission *s, real t) { return s->lag * -expm1(-t / s->lag); }

/* The plant from the start of a period, in `SUBSTEPS` steps over dt. */
SMALL void move(const Mission *s, Flight *z, real t, real dt) {
    real step = dt / SUBSTEPS;
    for (int n = 0; n < SUBSTEPS; n++) {
        real start = n * step, end = start + step, a0 = lagged(s, start), a1 = lagged(s, end);
        real mean = (a1 - a0) / step;
        real moment = 0.5 * (a0 + a1) * step - s->lag * ((end - a1) - (start - a0));
        Stage stages[3];
        for (int m = 0; m < 3; m++) {
            real into = 0.5 * m * step;
            stages[m].slope = into - 0.5 * step;
            stages[m].impulse = into;
            stages[m].slope_impulse = 0.5 * into * (into - step);
            for (int k = 0; k < 3; k++) {
                real angle = s->frequency[k] * (t + start + into);
                stages[m].sine[k] = sin(angle);
                stages[m].cosine[k] = cos(angle);
            }
        }
        EACH_LANE advance(s, z, i, step, mean, 12.0 * moment / (step * step * step), start, a0, stages);
    }
    EACH_LANE renormalise(z, i);
}

/* Wheels and the torque that the flight software assumes, at the end of a period. */
SMALL void wheels(const Mission *s, Flight *z, int i, const Shared *now, real nominal, real left_middle,
                  real lagged_middle, real lagged_end, real lagged_nominal) {
    real v0[3], v1[3], v2[3], mean[3], Ah[3], carried[3], dt = now->dt, left_end = 1.0 - lagged_end / s->lag;
    real torque = z->wheel_torque[i], momentum = z->wheel_momentum[i];
    for (int k = 0; k < 3; k++) {
        real c = z->c[k][i], gap = z->gap[k][i], h = z->h[k][i];
        v0[k] = c - gap;
        v1[k] = c - gap * left_middle;
        v2[k] = c - gap * left_end;
        mean[k] = c - gap * lagged_nominal / nominal;
        carried[k] = h;
        real middle = h - c * 0.5 * dt + gap * lagged_middle, end = h - c * dt + gap * lagged_end;
        momentum = fmax(momentum, fmax(fabs(middle), fabs(end)));
        torque = fmax(torque, fmax(fabs(v0[k]), fabs(v2[k])));
        z->v[k][i] = v2[k];
        z->h[k][i] = end;
    }
    z->wheel_torque[i] = torque;
    z->wheel_momentum[i] = momentum;
    real d0[3], d1[3], d2[3], on_body[3];
    times(s->axes, v0, d0);
    times(s->axes, v1, d1);
    times(s->axes, v2, d2);
    times(s->axes, mean, on_body);
    times(s->axes, carried, Ah);
    real most = z->peak_delivered[i], sum = 0.0;
    for (int k = 0; k < 3; k++) {
        most = fmax(most, fmax(fabs(d0[k]), fmax(fabs(d1[k]), fabs(d2[k]))));
        sum += fabs(d0[k]) + 4.0 * fabs(d1[k]) + fabs(d2[k]);
        z->applied[k][i] = on_body[k];
        z->stored[k][i] = Ah[k] - on_body[k] * 0.5 * nominal;
        z->delivered[0][k][i] = d0[k];
        z->delivered[1][k][i] = d1[k];
        z->delivered[2][k][i] = d2[k];
    }
    z->peak_delivered[i] = most;
    z->effort[i] += dt / 6.0 * sum;
    z->saturated[i] += dt * z->limited[i];
}

/* The metrics at t_f, by the state there; the state goes back to the start of the period. */
SMALL void arrive(const Mission *s, Flight *z, int i) {
    LOAD(q, 4, q);
    LOAD(q0, 4, q0);
    LOAD(w0, 3, w0);
    real qe[4];
    relative(s->qf, q, qe);
    z->terminal_error[i] = sqrt(dot(qe, qe));
    z->terminal_angle[i] = angle_of(qe);
    STORE(q0, 4, q);
    STORE(w0, 3, w);
}

/* Metrics that every period changes. */
SMALL void judge(const Mission *s, Flight *z, int i, const Shared *now) {
    LOAD(q, 4, q);
    LOAD(w, 3, w);
    LOAD(J, 9, J);
    real qe[4], h[3], t_next = now->t + now->dt, ww = dot(w, w), angle0 = z->angle[i], step = now->dt / SUBSTEPS;
    relative(s->qf, q, qe);
    real angle = angle_of(qe);
    int above0 = !(angle0 < s->settling), above = !(angle < s->settling);
    real crossing = now->t + now->dt * (angle0 - s->settling) / ((above0 && !above) ? angle0 - angle : 1.0);
    z->settled[i] = above ? FAR : (above0 ? crossing : z->settled[i]);
    z->angle0[i] = angle0;
    z->angle[i] = angle;
    full_times(J, w, h);
    z->rate[i] = fmax(z->rate[i], sqrt(ww));
    z->momentum[i] = fmax(z->momentum[i], sqrt(dot(h, h)));
    int code = qe[3] < 1e-3 ? 3 : (ww * step * step > 1.0 ? 2 : 0), first = z->status[i] == 0 && code != 0;
    z->bad_time[i] = first ? t_next : z->bad_time[i];
    z->status[i] = first ? code : z->status[i];
}

/* Integral over the part of a period inside the window, of the parabola through these. */
SMALL real in_window(real upper, real lower, real dt, real g0, real g1, real g2) {
    real share = upper - lower, least = share * share * share / 4.0 * (g0 + 4.0 * g1 + g2) / 6.0;
    return dt * fmax(least, primitive(upper, g0, g1, g2) - primitive(lower, g0, g1, g2));
}

/* Metrics of a period that reaches t_f. */
SMALL void judge_after(const Mission *s, Flight *z, int i, const Shared *now, real upper, real lower, real jumps,
                       real holds) {
    LOAD(q, 4, q);
    LOAD(w, 3, w);
    LOAD(q0, 4, q0);
    LOAD(w0, 3, w0);
    real e[4], e0[4], c[3], c0[3], middle[4], dt = now->dt;
    relative(s->qf, q, e);
    relative(s->qf, q0, e0);
    cross(e, w, c);
    cross(e0, w0, c0);
    for (int k = 0; k < 3; k++)
        middle[k] = 0.5 * (e0[k] + e[k]) + 0.0625 * dt * (e0[3] * w0[k] + c0[k] - e[3] * w[k] - c[k]);
    middle[3] = 0.5 * (e0[3] + e[3]) - 0.0625 * dt * (dot(e0, w0) - dot(e, w));
    real g0 = dot(e0, e0), g1 = dot(middle, middle), g2 = dot(e, e), a1 = angle_of(middle);
    real a0 = z->angle0[i], a2 = z->angle[i];
    z->square[i] += in_window(upper, lower, dt, g0, g1, g2);
    z->square_angle[i] += in_window(upper, lower, dt, a0 * a0, a1 * a1, a2 * a2);
    for (int k = 0; k < 3; k++) {
        real d0 = z->delivered[0][k][i], d1 = z->delivered[1][k][i], d2 = z->delivered[2][k][i];
        z->variation[k][i] += jumps * fabs(d0 - z->last[k][i]) + holds * (fabs(d1 - d0) + fabs(d2 - d1));
    }
    if (now->t + dt > s->t_f) {
        z->hold[i] = fmax(z->hold[i], sqrt(g2));
        z->hold_angle[i] = fmax(z->hold_angle[i], a2);
    }
}

#if POINTING
/* An attitude's error (5) from another attitude, and with `w` its rate: rotation vector, then across the boresight. */
SMALL void pointing(const Mission *s, const real *from, const real *q, const real *w, real *error, real *rate) {
    real e[4], de[4], c[3], by[3], vb[3], dvb[3], pointed[3], turned[3];
    const real *b = s->frame;
    relative(from, q, e);
    real sign = e[3] < 0.0 ? -1.0 : 1.0;
    for (int k = 0; k < 4; k++) e[k] *= sign;
    cross(e, w, c);
    for (int k = 0; k < 3; k++) de[k] = 0.5 * (e[3] * w[k] + c[k]);
    de[3] = -0.5 * dot(e, w);
    real square = dot(e, e), d_square = 2.0 * dot(e, de), x = square < 1e-6 ? 0.25 : square;
    int small = square < 1e-6;
    real size = sqrt(x), scalar = sqrt(fmax(1.0 - x, 1e-12)), half_angle = arctangent(size, scalar);
    real g = small ? 2.0 + square / 3.0 + 3.0 * square * square / 20.0 + 5.0 * square * square * square / 56.0
                   : 2.0 * half_angle / size;
    real d_g = small ? 1.0 / 3.0 + 3.0 * square / 10.0 + 15.0 * square * square / 56.0
                     : (1.0 / scalar - 0.5 * g) / x;
    real along = dot(e, b), d_along = dot(de, b);
    for (int k = 0; k < 3; k++) {
        error[k] = e[k] * g;
        rate[k] = de[k] * g + e[k] * d_g * d_square;
        by[k] = b[k];
    }
    cross(e, by, vb);
    cross(de, by, dvb);
    for (int k = 0; k < 3; k++) {
        pointed[k] = (1.0 - 2.0 * square) * b[k] + 2.0 * (along * e[k] + e[3] * vb[k]);
        turned[k] = -2.0 * d_square * b[k] + 2.0 * (d_along * e[k] + along * de[k] + de[3] * vb[k] + e[3] * dvb[k]);
    }
    real y = dot(b + 3, pointed), y_dot = dot(b + 3, turned), v = dot(b + 6, pointed), v_dot = dot(b + 6, turned);
    real ahead = dot(b, pointed), d_ahead = dot(b, turned), side = y * y + v * v;
    int little = side < 1e-12;
    real reach = sqrt(little ? 1.0 : side), d_side = 2.0 * (y * y_dot + v * v_dot), d_reach = 0.5 * d_side / reach;
    real arc = arctangent(reach, fabs(ahead)), flip = ahead < 0.0 ? -1.0 : 1.0;
    real d_arc = (fabs(ahead) * d_reach - reach * flip * d_ahead) / (reach * reach + ahead * ahead);
    real factor = little ? 1.0 + side / 6.0 : (ahead < 0.0 ? 3.141592653589793 - arc : arc) / reach;
    real d_factor = little ? d_side / 6.0 : (flip * d_arc - factor * d_reach) / reach;
    error[3] = y * factor;
    error[4] = v * factor;
    rate[3] = y_dot * factor + y * d_factor;
    rate[4] = v_dot * factor + v * d_factor;
}

/* The error's cubic over a period at shares of it: values, and integrals between them. */
SMALL void error_path(const Mission *s, Flight *z, int i, real dt, real share, real until) {
    real e0[5], r0[5], e1[5], r1[5];
    LOAD(q0, 4, q0);
    LOAD(w0, 3, w0);
    LOAD(q, 4, q);
    LOAD(w, 3, w);
    pointing(s, s->qf, q0, w0, e0, r0);
    pointing(s, s->qf, q, w, e1, r1);
#define AT(x) (e0[k] + x * rise + x * (1.0 - x) * ((1.0 - x) * a + x * b))
#define INTEGRAL(x) \
    dt * (x * e0[k] + 0.5 * x * x * rise + x * x * (0.5 - x * (2.0 / 3.0 - 0.25 * x)) * a + \
          x * x * x * (1.0 / 3.0 - 0.25 * x) * b)
#pragma GCC unroll 5
    for (int k = 0; k < 5; k++) {
        real rise = e1[k] - e0[k], a = dt * r0[k] - rise, b = rise - dt * r1[k], between = INTEGRAL(until);
        z->first[k][i] = AT(share);
        z->until[k][i] = AT(until);
        z->end[k][i] = e1[k];
        z->part[k][i] = between - INTEGRAL(share);
        z->rest[k][i] = INTEGRAL(1.0) - between;
    }
}

/* The error of the attitude that the law was given, which stays over the period. */
SMALL void knowledge_path(const Mission *s, Flight *z, int i, real dt, real share, real until) {
    real e[5], unused[5], still[3] = {0.0, 0.0, 0.0};
    LOAD(seen, 4, seen_q);
    LOAD(q0, 4, q0);
    pointing(s, q0, seen, still, e, unused);
    for (int k = 0; k < 5; k++) {
        z->first[k][i] = z->until[k][i] = z->end[k][i] = e[k];
        z->part[k][i] = dt * (until - share) * e[k];
        z->rest[k][i] = dt * (1.0 - until) * e[k];
    }
}

SMALL void largest(Lanes *most, const Lanes *e) {
    EACH_LANE {
        for (int k = 0; k < 3; k++) most[k][i] = fmax(most[k][i], fabs(e[k][i]));
        most[3][i] = fmax(most[3][i], sqrt(e[3][i] * e[3][i] + e[4][i] * e[4][i]));
    }
}

static const real *directions(void) {
    static real table[2 * DIRECTIONS];
    for (int k = 0; k < DIRECTIONS; k++) {
        table[2 * k] = cos(3.141592653589793 * k / DIRECTIONS);
        table[2 * k + 1] = sin(3.141592653589793 * k / DIRECTIONS);
    }
    return table;
}

/* Projections of an error among the largest and the smallest. */
SMALL void include(const real *table, Lanes *high, Lanes *low, const Lanes *e) {
    for (int p = 0; p < PROJECTIONS; p++) {
        const real *along = table + 2 * (p - 3);
        EACH_LANE {
            real value = p < 3 ? e[p][i] : along[0] * e[3][i] + along[1] * e[4][i];
            high[p][i] = fmax(high[p][i], value);
            low[p][i] = fmin(low[p][i], value);
        }
    }
}

SMALL void reset(Lanes *high, Lanes *low) {
    for (int p = 0; p < PROJECTIONS; p++)
        EACH_LANE high[p][i] = -FAR, low[p][i] = FAR;
}

/* A period that may open the observation, and close a window; carries: the next window begins in this period. */
SMALL void tally(const Mission *s, const real *table, Flight *z, Tally *of, int opens, int closes, int carries) {
    if (opens) {
        include(table, of->high, of->low, z->first);
        largest(of->largest, z->first);
    }
    for (int k = 0; k < 5; k++)
        EACH_LANE of->integral[k][i] += z->part[k][i];
    include(table, of->high, of->low, z->until);
    largest(of->largest, z->end);
    if (!closes) return;
    Lanes mean[5], most[4];
    for (int k = 0; k < 5; k++)
        EACH_LANE {
            mean[k][i] = of->integral[k][i] / s->pointing_window;
            of->integral[k][i] = z->rest[k][i];
        }
    largest(of->mean, mean);
    include(table, of->means_high, of->means_low, mean);
    memset(most, 0, sizeof most);
    for (int p = 0; p < PROJECTIONS; p++) {
        const real *along = table + 2 * (p - 3);
        int k = p < 3 ? p : 3;
        EACH_LANE {
            real value = p < 3 ? mean[p][i] : along[0] * mean[3][i] + along[1] * mean[4][i];
            most[k][i] = fmax(most[k][i], fmax(of->high[p][i] - value, value - of->low[p][i]));
        }
    }
    for (int k = 0; k < 4; k++)
        EACH_LANE of->relative[k][i] =
            fmax(of->relative[k][i], k < 3 ? most[k][i] : most[k][i] / cos(0.5 * 3.141592653589793 / DIRECTIONS));
    reset(of->high, of->low);
    if (carries) {
        include(table, of->high, of->low, z->until);
        include(table, of->high, of->low, z->end);
    }
}

SMALL void begin_tally(Tally *of) {
    memset(of, 0, sizeof *of);
    reset(of->high, of->low);
    reset(of->means_high, of->means_low);
}
#endif

SMALL void begin(const Mission *s, Flight *z, const Trial *trials, const uint32_t *keys) {
    memset(z, 0, sizeof *z);
#if POINTING
    begin_tally(&z->error);
    begin_tally(&z->knowledge);
#endif
    for (int i = 0; i < LANES; i++) {
        const Trial *of = trials + i;
        real qe[4], h[3];
        for (int k = 0; k < 4; k++) z->q[k][i] = of->q[k], z->estimate[k][i] = of->estimate[k];
        for (int k = 0; k < 3; k++) {
            z->w[k][i] = z->rate_read[k][i] = z->seen_w[k][i] = of->w[k];
            z->gyro_bias[k][i] = of->gyro_bias[k];
            z->estimate_bias[k][i] = of->estimate_bias[k];
            z->sin_phase[k][i] = sin(of->phase[k]);
            z->cos_phase[k][i] = cos(of->phase[k]);
        }
        for (int k = 0; k < 9; k++) z->J[k][i] = of->J[k], z->Ji[k][i] = of->Ji[k];
        for (int k = 0; k < 6; k++) z->key[k][i] = keys[6 * i + k];
        relative(s->qf, of->q, qe);
        z->angle[i] = angle_of(qe);
        z->settled[i] = z->angle[i] < s->settling ? 0.0 : FAR;
        full_times(of->J, of->w, h);
        z->rate[i] = sqrt(dot(of->w, of->w));
        z->momentum[i] = sqrt(dot(h, h));
    }
}

/* trials: a multiple of LANES; keys: (trials, 6) of attitude noise, rate noise and bias walk; out: (trials, columns) in
 * the order of `common.CUBESAT_METRICS`, then 28 pointing indices if there are. */
void simulate_cubesat(const Mission *s, const Tick *ticks, int steps, const Trial *drawn, const uint32_t *keys, int trials,
                 real *out) {
    const int columns = 16 + 28 * POINTING;
#if POINTING
    const real *table = directions();
#endif
#pragma omp parallel for schedule(static)
    for (int block = 0; block < trials / LANES; block++) {
        Flight flight, *z = &flight;
        begin(s, z, drawn + block * LANES, keys + 6 * block * LANES);
        real dt_before = 0.0, windows = 0.0, wide = 1e-9 * s->period;
        int partial_before = 1, begun = 0;
        for (int n = 0; n < steps; n++) {
            const Tick *tick = ticks + n;
            real t = tick->t, dt = tick->t_next - t, nominal = dt;
            if (!(dt > 0.0)) continue;
            int hold = tick->hold > 0.0;
            real tau = hold ? 1.0 : s->t_f - t;
            Shared now = {
                t, dt, dt_before, tick->partial > 0.0 ? dt : s->period, tau, hold ? s->surface_rate : s->eta,
                hold ? 2.0 * s->surface_rate : 2.0 * (s->eta - 1.0) / tau, hold ? s->k1 : 2.0 * s->eta / (tau * tau),
                1.0 / (hold ? s->width : s->width * s->layer_time),
                s->bound_floor + exp(-s->l_rate * t) * (s->bound_start - s->bound_floor), tick->weight,
                partial_before ? s->first_keep : s->keep, (uint32_t)(int32_t)tick->sample};
            if (!begun) {
                draw(z, 0, now.sample, z->fresh);
                draw(z, 1, now.sample, z->fresh + 3);
                for (int k = 0; k < 6; k++)
                    EACH_LANE z->noise[k][i] = (k < 3 ? s->star_noise : s->gyro_noise) * z->fresh[k][i];
                begun = 1;
            }
            draw(z, 0, now.sample + 1, z->fresh);
            draw(z, 1, now.sample + 1, z->fresh + 3);
            draw(z, 2, now.sample, z->fresh + 6);
            EACH_LANE control(s, z, i, &now);
            int meets = t < s->t_f && s->t_f <= tick->t_next;
            if (meets) { /* the state at t_f, inside the period that contains it */
                move(s, z, t, s->t_f - t);
                EACH_LANE arrive(s, z, i);
            }
            move(s, z, t, dt);
            real middle = lagged(s, 0.5 * dt), end = lagged(s, dt);
            EACH_LANE wheels(s, z, i, &now, nominal, 1.0 - middle / s->lag, middle, end, end);
            EACH_LANE judge(s, z, i, &now);
            if (tick->t_next >= s->t_f) {
                real upper = clip01((s->t_f + s->window - t) / dt), lower = clip01((s->t_f - t) / dt);
                EACH_LANE judge_after(s, z, i, &now, upper, lower, t > s->t_f + wide, t >= s->t_f - wide);
            }
            for (int k = 0; k < 3; k++)
                EACH_LANE z->last[k][i] = z->delivered[2][k][i];
#if POINTING
            real begins = s->t_f + s->after, close = 1e-9 * s->pointing_window;
            if (tick->t_next > begins + close) {
                real window_end = begins + (windows + 1.0) * s->pointing_window;
                real share = clip01((begins - t) / dt), until = fmin(fmax((window_end - t) / dt, share), 1.0);
                int opens = t <= begins + close, closes = window_end <= tick->t_next + close;
                EACH_LANE error_path(s, z, i, dt, share, until);
                tally(s, table, z, &z->error, opens, closes, 1);
                EACH_LANE knowledge_path(s, z, i, dt, share, until);
                tally(s, table, z, &z->knowledge, opens, closes, tick->t_next > window_end + close);
                windows += closes;
            }
#endif
            dt_before = dt;
            partial_before = tick->partial > 0.0;
        }
        for (int i = 0; i < LANES; i++) {
            real *row = out + (long)columns * (block * LANES + i);
            real most = fmax(z->variation[0][i], fmax(z->variation[1][i], z->variation[2][i]));
            real values[16] = {
                z->terminal_error[i], z->terminal_angle[i], sqrt(z->square[i] / s->window),
                fmax(z->hold[i], z->terminal_error[i]), sqrt(z->square_angle[i] / s->window),
                fmax(z->hold_angle[i], z->terminal_angle[i]), z->peak[i], z->peak_delivered[i],
                z->saturated[i] / s->t_end, z->effort[i], z->settled[i], most / (s->t_end - s->t_f), z->rate[i],
                z->momentum[i], z->wheel_momentum[i], z->wheel_torque[i]};
            memcpy(row, values, sizeof values);
#if POINTING
            for (int k = 0; k < 4; k++) {
                real drift = 0.0;
                for (int p = k; p < (k < 3 ? k + 1 : PROJECTIONS); p++)
                    drift = fmax(drift, z->error.means_high[p][i] - z->error.means_low[p][i]);
                row[16 + k] = z->error.largest[k][i];
                row[20 + k] = z->error.mean[k][i];
                row[24 + k] = z->error.relative[k][i];
                row[28 + k] = k < 3 ? drift : drift / cos(0.5 * 3.141592653589793 / DIRECTIONS);
                row[32 + k] = z->knowledge.largest[k][i];
                row[36 + k] = z->knowledge.mean[k][i];
                row[40 + k] = z->knowledge.relative[k][i];
            }
#endif
        }
    }
}
