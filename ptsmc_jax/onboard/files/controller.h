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

/* Symbols contain the precision, so files of different PTSMC_REAL don't link. */
#define PTSMC_SUFFIXED_(name, real) name##_##real
#define PTSMC_SUFFIXED(name, real) PTSMC_SUFFIXED_(name, real)
#define ptsmc_init PTSMC_SUFFIXED(ptsmc_init, PTSMC_REAL)
#define ptsmc_step PTSMC_SUFFIXED(ptsmc_step, PTSMC_REAL)
#define ptsmc_parameters PTSMC_SUFFIXED(ptsmc_parameters, PTSMC_REAL)

#define PTSMC_SCENARIO "${checksum}"

/* What ptsmc_step returns, the most severe last. */
enum ptsmc_status {
${statuses}
};

/* Gains, body, devices: numbers that may change without another export. */
typedef struct {
${params_members}
} ptsmc_params;

/* The measurements at a sample. */
typedef struct {
    double t; /* of the sample, from the start of the manoeuvre [s]; double, since it is subtracted */
${in_members}
} ptsmc_in;

/* The results of a sample. */
typedef struct {
${out_members}
} ptsmc_out;

${derived_struct}
/* The memory from sample to sample; ptsmc_init fills it.${filter_note} */
typedef struct {
    double t; /* of the last sample [s] */
    int started; /* 0 until the first sample */
    int tracking; /* 0: the sign of the attitude and the distance to the singularity are chosen again */
${state_members}
    ptsmc_out last; /* good one */
${derived_member}
} ptsmc_state;

/* The parameters of the scenario. */
extern const ptsmc_params ptsmc_parameters;

/* Before the first sample. */
void ptsmc_init(const ptsmc_params *p, ptsmc_state *state);

/* One sample, once a period: reads in, sets out, which is always finite, and returns a status.
 * No allocation, no global state.
 */
int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out);

#ifdef __cplusplus
}
#endif
#endif
