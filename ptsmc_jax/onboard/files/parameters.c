/* The parameters of ${scenario} (SHA-256 ${checksum}). */
#include "ptsmc_${name}.h"

#define R(x) ((ptsmc_real)(x))

const ptsmc_params ptsmc_parameters = {
${parameter_values}
};
