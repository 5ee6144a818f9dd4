    const real *const w = in->rate;
    const real turn = (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) * p->period * p->period; /* [rad^2] */
