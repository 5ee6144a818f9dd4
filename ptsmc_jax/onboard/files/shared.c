/* shared.c: the controller as a shared library for other languages. Rows are doubles in the order of controller.json. */
#include <stdlib.h>

#include "ptsmc_${name}_flat.h"

ptsmc_state *controller_new(void);
void controller_set(ptsmc_state *state, const double *row);
int controller_step(ptsmc_state *state, const double *in, double *out);
void controller_free(ptsmc_state *state);

ptsmc_state *controller_new(void)
{
    ptsmc_state *const state = malloc(sizeof *state);

    if (state != NULL) {
        ptsmc_init(&ptsmc_parameters, state);
    }
    return state;
}

void controller_set(ptsmc_state *state, const double *row)
{
    ptsmc_state_from(row, state);
}

int controller_step(ptsmc_state *state, const double *in, double *out)
{
    ptsmc_in given;
    ptsmc_out found;
    int status = 0;

    ptsmc_in_from(in, &given);
    status = ptsmc_step(&ptsmc_parameters, state, &given, &found);
    ptsmc_out_to(&found, out);
    return status;
}

void controller_free(ptsmc_state *state)
{
    free(state);
}
