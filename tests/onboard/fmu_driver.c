/* Drive an FMU of FMI 3.0 under sanitizers: two instances, saved states, errors of use, and a reset. */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void *fmi3InstantiateCoSimulation(const char *, const char *, const char *, bool, bool, bool, bool, const unsigned *,
                                  size_t, void *, void *, void *);
int fmi3EnterInitializationMode(void *, bool, double, double, bool, double);
int fmi3ExitInitializationMode(void *);
int fmi3DoStep(void *, double, double, bool, bool *, bool *, bool *, double *);
int fmi3GetFloat64(void *, const unsigned *, size_t, double *, size_t);
int fmi3SetFloat64(void *, const unsigned *, size_t, const double *, size_t);
int fmi3SetUInt32(void *, const unsigned *, size_t, const uint32_t *, size_t);
int fmi3GetFMUState(void *, void **);
int fmi3SetFMUState(void *, void *);
int fmi3FreeFMUState(void *, void **);
int fmi3SerializedFMUStateSize(void *, void *, size_t *);
int fmi3SerializeFMUState(void *, void *, uint8_t *, size_t);
int fmi3DeserializeFMUState(void *, const uint8_t *, size_t, void **);
int fmi3Reset(void *);
int fmi3Terminate(void *);
void fmi3FreeInstance(void *);

#define CHECK(call, status)                                                                                            \
    if ((call) != (status)) {                                                                                          \
        printf("%s is not %d\n", #call, status);                                                                       \
        return 1;                                                                                                      \
    }

/* arguments: token, period, inputs, first and last value reference of the real variables to read */
int main(int count, char **given)
{
    const double period = count > 2 ? strtod(given[2], NULL) : 0.0;
    const unsigned inputs = (unsigned)atoi(given[3]), outputs = (unsigned)atoi(given[4]);
    double value = 0.0, last = 0.0, first_run[40], second_run[40];
    bool event, end, early;
    uint8_t *bytes = NULL;
    size_t size = 0;
    void *saved = NULL, *again = NULL;
    void *const a = fmi3InstantiateCoSimulation("a", given[1], "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    void *const b = fmi3InstantiateCoSimulation("b", given[1], "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);

    if (a == NULL || b == NULL || fmi3InstantiateCoSimulation("c", "other", "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL)) {
        return 1;
    }
    CHECK(fmi3DoStep(a, 0.0, period, true, &event, &end, &early, &last), 3)
    for (int run = 0; run < 2; run++) {
        CHECK(fmi3EnterInitializationMode(a, false, 0.0, 0.0, false, 0.0), 0)
        CHECK(fmi3ExitInitializationMode(a), 0)
        CHECK(fmi3DoStep(a, 0.5, period, true, &event, &end, &early, &last), 3)
        CHECK(fmi3DoStep(a, 0.0, -period, true, &event, &end, &early, &last), 3)
        CHECK(fmi3DoStep(a, 0.0, period / 0.0, true, &event, &end, &early, &last), 3)
        for (int k = 0; k < 40; k++) {
            const unsigned output = inputs + (unsigned)k % outputs;
            for (unsigned j = 0; j < inputs; j++) {
                value = k % 10 == 7 ? 0.0 / 0.0 : j % 4 == 3 ? 1.0 : 1e-3 * (double)k; /* sometimes not a number */
                if (fmi3SetFloat64(a, &j, 1, &value, 1) == 3 && k % 10 != 7) {
                    value = 0.0; /* a variable of another type */
                }
            }
            (void)fmi3DoStep(a, period * k, period, true, &event, &end, &early, &last);
            (void)fmi3GetFloat64(a, &output, 1, &value, 1);
            (run ? second_run : first_run)[k] = value;
        }
        CHECK(fmi3Reset(a), 0)
    }
    if (memcmp(first_run, second_run, sizeof first_run) != 0) {
        printf("a reset instance behaves differently\n");
        return 1;
    }
    CHECK(fmi3EnterInitializationMode(b, false, 0.0, 2.0, false, 0.0), 0)
    CHECK(fmi3ExitInitializationMode(b), 0)
    CHECK(fmi3GetFMUState(b, &saved), 0)
    CHECK(fmi3SerializedFMUStateSize(b, saved, &size), 0)
    bytes = malloc(size);
    CHECK(fmi3SerializeFMUState(b, saved, bytes, size - 1), 3)
    CHECK(fmi3SerializeFMUState(b, saved, bytes, size), 0)
    CHECK(fmi3DeserializeFMUState(b, bytes, size - 1, &again), 3)
    CHECK(fmi3DeserializeFMUState(b, bytes, size, &again), 0)
    CHECK(fmi3SetFMUState(b, again), 0)
    CHECK(fmi3DoStep(b, 2.0, 0.4 * period, true, &event, &end, &early, &last) == 3, 0)
    CHECK(fmi3DoStep(b, 2.0 + 0.4 * period, 3.0 * period, true, &event, &end, &early, &last) == 3, 0)
    {
        const unsigned beyond = 1000000;
        const uint32_t seed = 7;
        CHECK(fmi3GetFloat64(b, &beyond, 1, &value, 1), 3)
        CHECK(fmi3SetFloat64(b, &beyond, 1, &value, 1), 3)
        CHECK(fmi3SetFloat64(b, &inputs, 1, &value, 1), 3) /* an output */
        CHECK(fmi3SetUInt32(b, &beyond, 1, &seed, 1), 3)
    }
    CHECK(fmi3FreeFMUState(b, &saved), 0)
    CHECK(fmi3FreeFMUState(b, &again), 0)
    CHECK(fmi3Terminate(b), 0)
    free(bytes);
    fmi3FreeInstance(a);
    fmi3FreeInstance(b);
    return 0;
}
