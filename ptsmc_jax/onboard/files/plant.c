/* ptsmc_${name}.c: the true plant of ${scenario}: actuators, disturbance, motion and sensors.
 * Made by ptsmc export; scenario SHA-256 ${checksum}. Headings name the Python functions that the code is traced from.
 */

${head}

void ptsmc_init(const ptsmc_params *p, ptsmc_state *state)
{
    static const ptsmc_state none;
    ptsmc_state now = none;
    ptsmc_out found = now.last;

    *state = none;
${derive}
    ${begin};
    now.last = found;
${keep}
    *state = now;
${unused}
}

int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out)
{
    ptsmc_state now = *state;
    ptsmc_out found = state->last;

    if (!(${usable})) {
        *out = state->last;
        return PTSMC_INPUT;
    }
    ${advance};
    if (!(${sound})) {
        *out = state->last;
        return PTSMC_OVERFLOW;
    }
    now.last = found;
    *state = now;
    *out = found;
${unused}
    return PTSMC_OK;
}
${derivation}
