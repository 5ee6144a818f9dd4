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
