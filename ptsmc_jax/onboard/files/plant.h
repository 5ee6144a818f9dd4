/* ptsmc_${name}.h: the true plant of ${scenario}: actuators, disturbance, motion and sensors.
 * Made by ptsmc export; scenario SHA-256 ${checksum}.
 */

#ifndef PTSMC_${upper}_H
#define PTSMC_${upper}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef PTSMC_REAL
#define PTSMC_REAL double
#endif
typedef PTSMC_REAL ptsmc_real;

enum ptsmc_status {
    PTSMC_OK = 0, /* new output */
    PTSMC_INPUT = 4, /* an input is not finite; the state does not change */
    PTSMC_OVERFLOW = 5 /* a result is not finite; the state does not change */
};

/* Nominal values, seed and trial. They must not change after ptsmc_init. */
typedef struct {
${params_members}
} ptsmc_params;

/* The command that acts from this sample on. */
typedef struct {
    double t; /* time of the sample [s]; not used, because the plant counts its samples */
${in_members}
} ptsmc_in;

/* The readings at a sample, and the true values. */
typedef struct {
${out_members}
} ptsmc_out;

${derived_struct}
typedef struct {
${state_members}
    ptsmc_out last;
${derived_member}
} ptsmc_state;

extern const ptsmc_params ptsmc_parameters;

/* Draw the dispersions and begin a run; state->last has the readings at the first sample. */
void ptsmc_init(const ptsmc_params *p, ptsmc_state *state);

/* Advance by a control period; `out` has the readings at its end. */
int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out);

#ifdef __cplusplus
}
#endif
#endif
