/* Drive an FMU under sanitizers: two instances, saved states, errors of use, and a reset. VERSION: 2 or 3, of FMI. */
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if VERSION == 2
typedef char byte;
typedef int unsigned32;
#define FMI(name) fmi2##name
#define GET_REAL fmi2GetReal
#define SET_REAL fmi2SetReal
#define SET_UNSIGNED fmi2SetInteger
#define STATE(name) fmi2##name##FMUstate
#define DESERIALIZE fmi2DeSerializeFMUstate
#define STATE_SIZE fmi2SerializedFMUstateSize
#define COUNT
#define COUNT_ARGUMENT
void *fmi2Instantiate(const char *, int, const char *, const char *, void *, int, int);
int fmi2SetupExperiment(void *, int, double, double, int, double);
int fmi2EnterInitializationMode(void *);
int fmi2DoStep(void *, double, double, int);
#else
typedef uint8_t byte;
typedef uint32_t unsigned32;
#define FMI(name) fmi3##name
#define GET_REAL fmi3GetFloat64
#define SET_REAL fmi3SetFloat64
#define SET_UNSIGNED fmi3SetUInt32
#define STATE(name) fmi3##name##FMUState
#define DESERIALIZE fmi3DeserializeFMUState
#define STATE_SIZE fmi3SerializedFMUStateSize
#define COUNT , 1
#define COUNT_ARGUMENT , size_t
void *fmi3InstantiateCoSimulation(const char *, const char *, const char *, bool, bool, bool, bool, const unsigned *,
                                  size_t, void *, void *, void *);
int fmi3EnterInitializationMode(void *, bool, double, double, bool, double);
int fmi3DoStep(void *, double, double, bool, bool *, bool *, bool *, double *);
#endif
int FMI(ExitInitializationMode)(void *);
int GET_REAL(void *, const unsigned *, size_t, double * COUNT_ARGUMENT);
int SET_REAL(void *, const unsigned *, size_t, const double * COUNT_ARGUMENT);
int SET_UNSIGNED(void *, const unsigned *, size_t, const unsigned32 * COUNT_ARGUMENT);
int STATE(Get)(void *, void **);
int STATE(Set)(void *, void *);
int STATE(Free)(void *, void **);
int STATE_SIZE(void *, void *, size_t *);
int STATE(Serialize)(void *, void *, byte *, size_t);
int DESERIALIZE(void *, const byte *, size_t, void **);
int FMI(Reset)(void *);
int FMI(Terminate)(void *);
void FMI(FreeInstance)(void *);

static void *instantiate(const char *name, const char *token)
{
#if VERSION == 2
    static void *callbacks[5]; /* no logger */
    return fmi2Instantiate(name, 1, token, "", callbacks, 0, 0);
#else
    return fmi3InstantiateCoSimulation(name, token, "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
#endif
}

static int enter_initialization(void *unit, double start)
{
#if VERSION == 2
    return fmi2SetupExperiment(unit, 0, 0.0, start, 0, 0.0) + fmi2EnterInitializationMode(unit);
#else
    return fmi3EnterInitializationMode(unit, false, 0.0, start, false, 0.0);
#endif
}

static int step(void *unit, double t, double length)
{
#if VERSION == 2
    return fmi2DoStep(unit, t, length, 1);
#else
    bool event, end, early;
    double last = 0.0;
    return fmi3DoStep(unit, t, length, true, &event, &end, &early, &last);
#endif
}

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
    double value = 0.0, first_run[40], second_run[40];
    byte *bytes = NULL;
    size_t size = 0;
    void *saved = NULL, *again = NULL;
    void *const a = instantiate("a", given[1]);
    void *const b = instantiate("b", given[1]);

    if (a == NULL || b == NULL || instantiate("c", "other")) {
        return 1;
    }
    CHECK(step(a, 0.0, period), 3)
    for (int run = 0; run < 2; run++) {
        CHECK(enter_initialization(a, 0.0), 0)
        CHECK(FMI(ExitInitializationMode)(a), 0)
        CHECK(step(a, 0.5, period), 3)
        CHECK(step(a, 0.0, -period), 3)
        CHECK(step(a, 0.0, period / 0.0), 3)
        for (int k = 0; k < 40; k++) {
            const unsigned output = inputs + (unsigned)k % outputs;
            for (unsigned j = 0; j < inputs; j++) {
                value = k % 10 == 7 ? 0.0 / 0.0 : j % 4 == 3 ? 1.0 : 1e-3 * (double)k; /* sometimes not a number */
                if (SET_REAL(a, &j, 1, &value COUNT) == 3 && k % 10 != 7) {
                    value = 0.0; /* a variable of another type */
                }
            }
            (void)step(a, period * k, period);
            (void)GET_REAL(a, &output, 1, &value COUNT);
            (run ? second_run : first_run)[k] = value;
        }
        CHECK(FMI(Reset)(a), 0)
    }
    if (memcmp(first_run, second_run, sizeof first_run) != 0) {
        printf("a reset instance behaves differently\n");
        return 1;
    }
    CHECK(enter_initialization(b, 2.0), 0)
    CHECK(FMI(ExitInitializationMode)(b), 0)
    CHECK(STATE(Get)(b, &saved), 0)
    CHECK(STATE_SIZE(b, saved, &size), 0)
    bytes = malloc(size);
    CHECK(STATE(Serialize)(b, saved, bytes, size - 1), 3)
    CHECK(STATE(Serialize)(b, saved, bytes, size), 0)
    CHECK(DESERIALIZE(b, bytes, size - 1, &again), 3)
    CHECK(DESERIALIZE(b, bytes, size, &again), 0)
    CHECK(STATE(Set)(b, again), 0)
    CHECK(step(b, 2.0, 0.4 * period) == 3, 0)
    CHECK(step(b, 2.0 + 0.4 * period, 3.0 * period) == 3, 0)
    {
        const unsigned beyond = 1000000;
        const unsigned32 seed = 7;
        CHECK(GET_REAL(b, &beyond, 1, &value COUNT), 3)
        CHECK(SET_REAL(b, &beyond, 1, &value COUNT), 3)
        CHECK(SET_REAL(b, &inputs, 1, &value COUNT), 3) /* an output */
        CHECK(SET_UNSIGNED(b, &beyond, 1, &seed COUNT), 3)
    }
    CHECK(STATE(Free)(b, &saved), 0)
    CHECK(STATE(Free)(b, &again), 0)
    CHECK(FMI(Terminate)(b), 0)
    free(bytes);
    FMI(FreeInstance)(a);
    FMI(FreeInstance)(b);
    return 0;
}
