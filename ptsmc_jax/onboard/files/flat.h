/* Structs of ptsmc_${name}.h from and to rows of doubles, in the order of vectors.csv and controller.json. */
#include "ptsmc_${name}.h"

enum {
    PTSMC_IN_SIZE = ${in_size},
    PTSMC_OUT_SIZE = ${out_size},
    PTSMC_STATE_SIZE = ${state_size},
    PTSMC_PARAMS_SIZE = ${params_size}
};

static inline void ptsmc_in_from(const double *v, ptsmc_in *x)
{
${in_from}
}

static inline void ptsmc_state_from(const double *v, ptsmc_state *x)
{
${state_from}
}

static inline void ptsmc_params_from(const double *v, ptsmc_params *x)
{
${params_from}
}

static inline void ptsmc_out_to(const ptsmc_out *x, double *v)
{
${out_to}
}

static inline void ptsmc_state_to(const ptsmc_state *x, double *v)
{
${state_to}
}

static inline void ptsmc_params_to(const ptsmc_params *x, double *v)
{
${params_to}
}
