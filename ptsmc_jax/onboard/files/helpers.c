/* The larger number; NaN if one of them is NaN. */
static real larger(real a, real b)
{
    return a > b || isnan(a) ? a : b;
}

/* The smaller number; NaN if one of them is NaN. */
static real smaller(real a, real b)
{
    return a < b || isnan(a) ? a : b;
}

/* The relative resolution of the type in use: four times the distance from 1 to the next number. */
static real resolution(void)
{
    return sizeof(real) < sizeof(double) ? R(4.76837158203125e-07) : R(8.881784197001252e-16);
}

static real sign_of(real x)
{
    return x > R(0) ? R(1) : (x < R(0) ? R(-1) : x);
}

/* A word of Threefry-2x32 with 20 rounds (Salmon et al., SC11, 2011), for a key (a, b) and a counter (x, y). */
static uint32_t threefry(uint32_t a, uint32_t b, uint32_t x, uint32_t y, int second)
{
    static const int rotations[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
    const uint32_t keys[3] = {a, b, a ^ b ^ 0x1BD11BDAu};
    x += keys[0];
    y += keys[1];
    for (int group = 0; group < 5; group++) {
        for (int k = 0; k < 4; k++) {
            const int by = rotations[group % 2][k];
            x += y;
            y = ((y << by) | (y >> (32 - by))) ^ x;
        }
        x += keys[(group + 1) % 3];
        y += keys[(group + 2) % 3] + (uint32_t)group + 1u;
    }
    return second ? y : x;
}

/* The inverse of erf: the approximation of Giles (GPU Computing Gems, 2012), and eight steps of Halley's method. */
static real erf_inv(real x)
{
    static const double middle[] = {1.50140941, 0.246640727, -0.00417768164, -0.00125372503, 0.00021858087,
                                    -4.39150654e-06, -3.5233877e-06, 3.43273939e-07, 2.81022636e-08};
    static const double tail[] = {2.83297682, 1.00167406, 0.00943887047, -0.0076224613, 0.00573950773,
                                  -0.00367342844, 0.00134934322, 0.000100950558, -0.000200214257};
    const double a = fabs((double)x);
    const double w = -log((1.0 - a) * (1.0 + a));
    const double at = w < 5.0 ? w - 2.5 : sqrt(w) - 3.0;
    const double *const c = w < 5.0 ? middle : tail;
    double y = c[8];
    if (!(a < 1.0)) {
        return R(a > 1.0 ? NAN : x * INFINITY);
    }
    for (int k = 7; k >= 0; k--) {
        y = y * at + c[k];
    }
    y *= a;
    for (int k = 0; k < 8; k++) { /* far in the tails the approximation is off by some percent */
        const double off = (a < 0.5 ? erf(y) - a : (1.0 - a) - erfc(y)) / (1.1283791670955126 * exp(-y * y));
        y -= off / (1.0 + y * off);
    }
    return R(x < R(0) ? -y : y);
}
