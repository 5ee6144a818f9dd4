/* check.c: replays vectors.csv through ptsmc_step and compares every output, state and status.
 *
 * A row contains trial, sample, status, inputs, outputs, and state after the sample. Sample -1 is the initial state.
 * Each sample starts from the state of the row before it.
 * A number is compared relative to the largest number of its group in the file. The groups are: each array, all torques
 * and all rates, because an estimated disturbance or bias is a difference of these. Exit status 0: all agree.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ptsmc_${name}_flat.h"

enum {
    HEAD = 3,
    CHECKED = PTSMC_OUT_SIZE + PTSMC_STATE_SIZE,
    COLUMNS = HEAD + PTSMC_IN_SIZE + CHECKED,
    LINE = 32 * COLUMNS + 2
};

static const struct {
    const char *name;
    int group;
} checked[CHECKED] = {
${compared}
};

/* Read a row of numbers. Return 0 at the end of the file and -1 if the line is not a row. */
static int row(FILE *file, double *v)
{
    static char line[LINE];
    char *at = line;

    if (fgets(line, LINE, file) == NULL) {
        return 0;
    }
    for (int k = 0; k < COLUMNS; k++) {
        char *end = at;
        v[k] = strtod(at, &end);
        if (end == at || (*end != ',' && k + 1 < COLUMNS)) {
            return -1;
        }
        at = end + 1;
    }
    return 1;
}

static int skip_heading(FILE *file)
{
    int c = 0;
    do {
        c = fgetc(file);
    } while (c != '\n' && c != EOF);
    return c == EOF;
}

int main(int count, char **given)
{
    const int single = sizeof(ptsmc_real) == 4;
    /* effect of the attitude's rounding error on the torque just before the hand-over, relative to the largest torque */
    const double rounding = (single ? 4.8e-7 : 8.9e-16) * ${rounding_growth};
    const double tolerance = count > 2 ? strtod(given[2], NULL) : fmax(single ? 1e-3 : 1e-12, fmin(rounding, 0.1));
    static double v[COLUMNS], largest[CHECKED], off[CHECKED], found[CHECKED];
    FILE *const file = fopen(count > 1 ? given[1] : "vectors.csv", "r");
    ptsmc_state state;
    ptsmc_in in;
    ptsmc_out out;
    long rows = 0, statuses = 0;
    int worst = 0, read = 0;

    if (file == NULL || skip_heading(file)) {
        fprintf(stderr, "check: there is no vectors.csv\n");
        return 2;
    }
    while ((read = row(file, v)) == 1) {
        for (int k = 0; k < CHECKED; k++) {
            double *const most = &largest[checked[k].group];
            *most = fmax(*most, fabs(v[HEAD + PTSMC_IN_SIZE + k]));
        }
    }
    rewind(file);
    ptsmc_init(&ptsmc_parameters, &state);
    if (read < 0 || skip_heading(file)) {
        fprintf(stderr, "check: vectors.csv has other columns\n");
        fclose(file);
        return 2;
    }
    while (row(file, v) == 1) {
        int status = 0;
        if (v[1] < 0.0) {
            ptsmc_init(&ptsmc_parameters, &state);
            ptsmc_state_from(v + HEAD + PTSMC_IN_SIZE + PTSMC_OUT_SIZE, &state);
            continue;
        }
        ptsmc_in_from(v + HEAD, &in);
        status = ptsmc_step(&ptsmc_parameters, &state, &in, &out);
        ptsmc_out_to(&out, found);
        ptsmc_state_to(&state, found + PTSMC_OUT_SIZE);
        statuses += status != (int)v[2];
        for (int k = 0; k < CHECKED; k++) {
            const double most = largest[checked[k].group];
            const double error = fabs(found[k] - v[HEAD + PTSMC_IN_SIZE + k]) / (most > 0.0 ? most : 1.0);
            if (!(error <= off[k])) {
                off[k] = error;
            }
        }
        /* start from the simulated state: in this open loop the rounding errors of all samples would add up */
        ptsmc_state_from(v + HEAD + PTSMC_IN_SIZE + PTSMC_OUT_SIZE, &state);
        rows++;
    }
    fclose(file);
    for (int k = 1; k < CHECKED; k++) {
        worst = off[k] > off[worst] || off[k] != off[k] ? k : worst;
    }
    printf("%ld samples; other status: %ld; largest difference %.2e of %s, allowed %.2g\n", rows, statuses, off[worst],
           checked[worst].name, tolerance);
    return rows > 0 && statuses == 0 && off[worst] <= tolerance ? 0 : 1;
}
