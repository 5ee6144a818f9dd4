/* ptsmc_${name}.c: ${law}, from ${scenario}.
 * Made by ptsmc export; scenario SHA-256 ${checksum}. Headings name the Python functions that the code is traced from.
 * Equation numbers refer to Chen, Ju, Wang, Li, The prescribed time sliding mode control for attitude tracking of
 * spacecraft.
 */

${head}

/* Return whether numbers are finite and at most ${largest}: the observer would forget larger ones very slowly. */
static int within(const real *v, int count)
{
    for (int k = 0; k < count; k++) {
        if (!(M(fabs)(v[k]) <= R(${largest}))) {
            return 0;
        }
    }
    return 1;
}

${rotation}
/* Return whether an input can be used. */
static int usable(${params}const ptsmc_state *state, const ptsmc_in *in)
{
${turn}
    return ${usable};
}

/* Return whether the new memory and the output are finite. */
static int sound(const ptsmc_state *now, const ptsmc_out *out)
{
    return ${sound};
}
${current}

void ptsmc_init(const ptsmc_params *p, ptsmc_state *state)
{
    static const ptsmc_state none = {0};

    *state = none;
${derive}
    ${begin};
${unused}
}

int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out)
{
${time}
    const real dt = state->started ? (real)(in->t - state->t) : R(0);
    const int regular = state->started && M(fabs)(dt - p->period) <= R(0.1) * p->period;
${tracking}
    int status = state->started && !regular ? PTSMC_MISSED : PTSMC_OK;
    ptsmc_state now;
    ptsmc_out found;

    if (!usable(${p}state, in)) {
        *out = state->last;
        return PTSMC_INPUT;
    }
${derive_again}
    now = *state;
    found = state->last;
    ${sense};
    ${observe};
    ${command};
${act}
    if (!sound(&now, &found)) {
        *out = state->last;
        return PTSMC_OVERFLOW;
    }
${regularity}
    now.t = in->t;
    now.started = 1;
    now.last = found;
    *state = now;
    *out = found;
    return status;
}
${derivation}
