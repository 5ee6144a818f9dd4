/* Numbers that are derived from parameters, and copies of these parameters. ptsmc_init computes them, and ptsmc_step
 * computes them again after a parameter has changed.
 */
typedef struct {
${derived_members}
} ptsmc_derived;

