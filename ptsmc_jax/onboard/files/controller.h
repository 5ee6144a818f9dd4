/* ptsmc_${name}.h: ${law}, from ${scenario}.
 * Made by ptsmc export; scenario SHA-256 ${checksum}.
 */

#ifndef PTSMC_${upper}_H
#define PTSMC_${upper}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Numbers: double, or float with -DPTSMC_REAL=float. */
#ifndef PTSMC_REAL
#define PTSMC_REAL double
#endif
typedef PTSMC_REAL ptsmc_real;

/* Symbols contain the precision, so that files with different PTSMC_REAL do not link. */
#define PTSMC_SUFFIXED_(name, real) name##_##real
#define PTSMC_SUFFIXED(name, real) PTSMC_SUFFIXED_(name, real)
#define ptsmc_init PTSMC_SUFFIXED(ptsmc_init, PTSMC_REAL)
#define ptsmc_step PTSMC_SUFFIXED(ptsmc_step, PTSMC_REAL)
#define ptsmc_parameters PTSMC_SUFFIXED(ptsmc_parameters, PTSMC_REAL)

#define PTSMC_SCENARIO "${checksum}"

/* Return value of ptsmc_step, the most severe last. */
enum ptsmc_status {
${statuses}
};

/* Gains, body, devices: numbers that may change without another export. */
typedef struct {
${params_members}
} ptsmc_params;

/* The measurements at a sample. */
typedef struct {
    double t; /* time of the sample from the start of the manoeuvre [s]; double, because times are subtracted */
${in_members}
} ptsmc_in;

/* The results of a sample. */
typedef struct {
${out_members}
} ptsmc_out;

${derived_struct}
/* The memory between two samples; ptsmc_init initialises it.${filter_note} */
typedef struct {
    double t; /* time of the last good sample [s] */
    int started; /* 0 until the first sample */
    int tracking; /* 0: the next sample chooses the signs of the attitude and of the distance to the singularity */
${state_members}
    ptsmc_out last; /* output of the last good sample */
${derived_member}
} ptsmc_state;

/* The parameters of the scenario. */
extern const ptsmc_params ptsmc_parameters;

/* Initialise the memory before the first sample. */
void ptsmc_init(const ptsmc_params *p, ptsmc_state *state);

/* Call once in each control period: computes `out` from `in` and returns the status. `out` is always finite.
 * There is no allocation and no global state.
 */
int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out);

#ifdef __cplusplus
}
#endif
#endif
