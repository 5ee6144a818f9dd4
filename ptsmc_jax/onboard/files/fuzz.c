/* fuzz.c: random inputs between the samples of vectors.csv. Every output must be finite, a rejected input must not change
 * the state, and good samples must be accepted again at the end. Exit status 0: all of this is true.
 */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "ptsmc_${name}_flat.h"

enum {
    HEAD = 3,
    COLUMNS = HEAD + PTSMC_IN_SIZE + PTSMC_OUT_SIZE + PTSMC_STATE_SIZE,
    LINE = 32 * COLUMNS + 2,
    MOST = 20000
};

static double rows[MOST][PTSMC_IN_SIZE];

static uint64_t drawn = 88172645463325252u;

/* Xorshift (Marsaglia, Journal of Statistical Software 8(14), 2003). */
static uint64_t bits(void)
{
    drawn ^= drawn << 13;
    drawn ^= drawn >> 7;
    drawn ^= drawn << 17;
    return drawn;
}

static double uniform(void)
{
    return (double)(bits() >> 11) / 9007199254740992.0;
}

/* Return a random number, which may be infinite, NaN or very large. */
static double anything(void)
{
    const double sign = bits() % 2 != 0 ? 1.0 : -1.0;
    double made = 0.0;
    uint64_t raw = 0;

    switch (bits() % 8) {
    case 0:
        return (double)NAN;
    case 1:
        return sign * (double)INFINITY;
    case 2:
        return 0.0;
    case 3:
        return sign * pow(10.0, 600.0 * uniform() - 300.0);
    case 4:
        raw = bits();
        memcpy(&made, &raw, sizeof made);
        return made;
    default:
        return sign * pow(10.0, 8.0 * uniform() - 6.0);
    }
}

static long read_rows(const char *name)
{
    static char line[LINE];
    FILE *const file = fopen(name, "r");
    long count = 0;

    if (file == NULL || fgets(line, LINE, file) == NULL) {
        if (file != NULL) {
            fclose(file);
        }
        return 0;
    }
    while (count < MOST && fgets(line, LINE, file) != NULL) {
        char *at = line;
        double v[HEAD + PTSMC_IN_SIZE];
        for (int k = 0; k < HEAD + PTSMC_IN_SIZE; k++) {
            v[k] = strtod(at, &at);
            at += *at == ',';
        }
        if (v[1] >= 0.0) {
            memcpy(rows[count], v + HEAD, sizeof rows[count]);
            count++;
        }
    }
    fclose(file);
    return count;
}

static int all_finite(const double *v, int count)
{
    for (int k = 0; k < count; k++) {
        if (!isfinite(v[k])) {
            return 0;
        }
    }
    return 1;
}

int main(int count, char **given)
{
    const long rounds = count > 1 ? strtol(given[1], NULL, 10) : 1000000;
    const long known = read_rows(count > 2 ? given[2] : "vectors.csv");
    const double period = (double)ptsmc_parameters.period;
    static double before[PTSMC_STATE_SIZE], after[PTSMC_STATE_SIZE], out[PTSMC_OUT_SIZE];
    long statuses[PTSMC_OVERFLOW + 1] = {0};
    ptsmc_state state;
    int last = PTSMC_OK;

    if (known == 0) {
        fprintf(stderr, "fuzz: there is no vectors.csv\n");
        return 2;
    }
    ptsmc_init(&ptsmc_parameters, &state);
    for (long k = 0; k < rounds; k++) {
        const int calm = k + 2000 >= rounds; /* from here on only good samples */
        double v[PTSMC_IN_SIZE];
        ptsmc_in in;
        ptsmc_out found;

        memcpy(v, rows[k % known], sizeof v);
        v[0] = period * (double)k;
        if (!calm && bits() % 2 != 0) {
            const uint64_t what = bits() % 6;
            if (what == 0) {
                v[0] = bits() % 2 != 0 ? anything() : v[0] + period * (uniform() - 0.5) * 10.0;
            } else if (what == 1) {
                for (int j = 1; j < PTSMC_IN_SIZE; j++) {
                    v[j] = anything();
                }
            } else if (what == 2) {
                for (int j = 1; j < PTSMC_IN_SIZE; j++) {
                    v[j] = 0.0;
                }
            } else if (what == 3) {
                continue; /* a missed sample */
            } else if (PTSMC_IN_SIZE > 1) {
                v[1 + bits() % (PTSMC_IN_SIZE - 1)] = anything();
            }
        }
${flags}
        ptsmc_in_from(v, &in);
        ptsmc_state_to(&state, before);
        last = ptsmc_step(&ptsmc_parameters, &state, &in, &found);
        ptsmc_out_to(&found, out);
        ptsmc_state_to(&state, after);
        if (last < PTSMC_OK || last > PTSMC_OVERFLOW || !all_finite(out, PTSMC_OUT_SIZE) ||
            !all_finite(after, PTSMC_STATE_SIZE)) {
            printf("sample %ld: status %d, and not finite\n", k, last);
            return 1;
        }
        if (last >= PTSMC_INPUT && memcmp(before, after, sizeof after) != 0) {
            printf("sample %ld: status %d, and the state has changed\n", k, last);
            return 1;
        }
        if (last >= PTSMC_INPUT && state.t > period * (double)k) { /* the time jumped ahead: start again */
            ptsmc_init(&ptsmc_parameters, &state);
        }
        statuses[last]++;
    }
    printf("%ld rounds:", rounds);
    for (int k = 0; k <= PTSMC_OVERFLOW; k++) {
        printf(" %ld of status %d%s", statuses[k], k, k < PTSMC_OVERFLOW ? "," : "\n");
    }
    return last == PTSMC_OK || last == PTSMC_SATURATED ? 0 : 1;
}
