/* fmi2.c: FMI 2.0 for co-simulation (fmi-standard.org). */
#define FMI(name) fmi2##name
#define STATE(before, after) STATE_(before, after)
#define STATE_(before, after) fmi2##before##FMUstate##after
#define DESERIALIZE DeSerialize
#define UNSIGNED 'i' /* type of the functions for unsigned integers */
#define VALUES
#define ONE_EACH 1
typedef int fmi_bool;

#include "fmu.h"

typedef void (*logger2)(void *, const char *, result, const char *, const char *, ...);

/* fmi2CallbackFunctions */
typedef struct {
    logger2 logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void (*finished)(void *, result);
    void *environment;
} callbacks;

static result say(instance *c, result status, const char *text)
{
    if (c->logger != NULL) {
        ((logger2)c->logger)(c->environment, c->name, status, status == FAILED ? "logStatusError" : "logStatusWarning",
                             "%s", text);
    }
    return status;
}

EXPORTED const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORTED const char *fmi2GetVersion(void)
{
    return "2.0";
}

EXPORTED instance *fmi2Instantiate(const char *name, int type, const char *token, const char *resources,
                                   const callbacks *call, int visible, int logging)
{
    (void)resources;
    (void)visible;
    (void)logging;
    return type == 1 ? instantiate(name, token, call->environment, (void (*)(void))call->logger) : NULL;
}

EXPORTED result fmi2SetupExperiment(instance *c, int tolerant, double tolerance, double start, int stops, double stop)
{
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    if (c->m.mode != INSTANTIATED || !isfinite(start)) {
        return say(c, FAILED, "the start time must be finite and set before the initialization");
    }
    c->m.start = c->m.end = start;
    return OK;
}

EXPORTED result fmi2EnterInitializationMode(instance *c)
{
    if (c->m.mode != INSTANTIATED) {
        return say(c, FAILED, "an instance is initialized once; reset it first");
    }
    c->m.mode = INITIALISING;
    return OK;
}

ACCESS(Real, double, 'r')
ACCESS(Integer, int, 'i')
ACCESS(Boolean, int, ' ')

EXPORTED result fmi2DoStep(instance *c, double t, double length, int no_earlier_state)
{
    (void)no_earlier_state;
    return do_step(c, t, length);
}

EXPORTED result fmi2GetRealStatus(instance *c, int kind, double *value)
{
    *value = c->m.end;
    return kind == 2 ? OK : DISCARD; /* fmi2LastSuccessfulTime */
}

EXPORTED result fmi2GetBooleanStatus(instance *c, int kind, int *value)
{
    (void)c;
    *value = 0;
    return kind == 3 ? OK : DISCARD; /* fmi2Terminated: the FMU does not end a simulation */
}

UNSUPPORTED(GetString)
UNSUPPORTED(SetString)
UNSUPPORTED(GetDirectionalDerivative)
UNSUPPORTED(SetRealInputDerivatives)
UNSUPPORTED(GetRealOutputDerivatives)
UNSUPPORTED(CancelStep)
UNSUPPORTED(GetStatus)
UNSUPPORTED(GetIntegerStatus)
UNSUPPORTED(GetStringStatus)
