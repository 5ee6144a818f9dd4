/* Return whether a quaternion has a norm near 1. */
static int rotation(const real *q)
{
    const real square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];

    return isfinite(square) && square > R(0.25) && square < R(4);
}

