/* fmi3.c: FMI 3.0 for co-simulation (fmi-standard.org). */
#include <stdbool.h>

#define FMI(name) fmi3##name
#define STATE(before, after) STATE_(before, after)
#define STATE_(before, after) fmi3##before##FMUState##after
#define DESERIALIZE Deserialize
#define UNSIGNED 'u' /* type of the functions for unsigned integers */
#define VALUES , size_t values
#define ONE_EACH (count == values)
typedef bool fmi_bool;

#include "fmu.h"

typedef void (*logger3)(void *, result, const char *, const char *);

static result say(instance *c, result status, const char *text)
{
    if (c->logger != NULL) {
        ((logger3)c->logger)(c->environment, status, status == FAILED ? "logStatusError" : "logStatusWarning", text);
    }
    return status;
}

EXPORTED const char *fmi3GetVersion(void)
{
    return "3.0";
}

EXPORTED instance *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                               bool logging, bool events, bool early, const unsigned between[],
                                               size_t count, void *environment, logger3 logger, void (*update)(void))
{
    (void)resources;
    (void)visible;
    (void)logging;
    (void)events;
    (void)early;
    (void)between;
    (void)count;
    (void)update;
    return instantiate(name, token, environment, (void (*)(void))logger);
}

EXPORTED instance *fmi3InstantiateModelExchange(void)
{
    return NULL;
}

EXPORTED instance *fmi3InstantiateScheduledExecution(void)
{
    return NULL;
}

EXPORTED result fmi3EnterInitializationMode(instance *c, bool tolerant, double tolerance, double start, bool stops,
                                            double stop)
{
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    if (c->m.mode != INSTANTIATED || !isfinite(start)) {
        return say(c, FAILED, "an instance is initialized once, with a finite start time; reset it first");
    }
    c->m.start = c->m.end = start;
    c->m.mode = INITIALISING;
    return OK;
}

ACCESS(Float64, double, 'r')
ACCESS(Int32, int32_t, 'i')
ACCESS(UInt32, uint32_t, 'u')
ACCESS(Float32, float, ' ')
ACCESS(Int8, int8_t, ' ')
ACCESS(UInt8, uint8_t, ' ')
ACCESS(Int16, int16_t, ' ')
ACCESS(UInt16, uint16_t, ' ')
ACCESS(Int64, int64_t, ' ')
ACCESS(UInt64, uint64_t, ' ')
ACCESS(Boolean, bool, ' ')

EXPORTED result fmi3DoStep(instance *c, double t, double length, bool no_earlier_state, bool *event, bool *terminate,
                           bool *early, double *last)
{
    const result found = do_step(c, t, length);

    (void)no_earlier_state;
    *event = *terminate = *early = false;
    *last = c->m.end;
    return found;
}

UNSUPPORTED(GetString)
UNSUPPORTED(SetString)
UNSUPPORTED(GetBinary)
UNSUPPORTED(SetBinary)
UNSUPPORTED(GetClock)
UNSUPPORTED(SetClock)
UNSUPPORTED(EnterConfigurationMode)
UNSUPPORTED(ExitConfigurationMode)
UNSUPPORTED(EnterEventMode)
UNSUPPORTED(EnterStepMode)
UNSUPPORTED(EvaluateDiscreteStates)
UNSUPPORTED(UpdateDiscreteStates)
UNSUPPORTED(GetDirectionalDerivative)
UNSUPPORTED(GetAdjointDerivative)
UNSUPPORTED(GetOutputDerivatives)
UNSUPPORTED(GetNumberOfVariableDependencies)
UNSUPPORTED(GetVariableDependencies)
UNSUPPORTED(GetIntervalDecimal)
UNSUPPORTED(SetIntervalDecimal)
UNSUPPORTED(GetIntervalFraction)
UNSUPPORTED(SetIntervalFraction)
UNSUPPORTED(GetShiftDecimal)
UNSUPPORTED(SetShiftDecimal)
UNSUPPORTED(GetShiftFraction)
UNSUPPORTED(SetShiftFraction)
UNSUPPORTED(ActivateModelPartition)
UNSUPPORTED(EnterContinuousTimeMode)
UNSUPPORTED(CompletedIntegratorStep)
UNSUPPORTED(SetTime)
UNSUPPORTED(SetContinuousStates)
UNSUPPORTED(GetContinuousStateDerivatives)
UNSUPPORTED(GetEventIndicators)
UNSUPPORTED(GetContinuousStates)
UNSUPPORTED(GetNominalsOfContinuousStates)
UNSUPPORTED(GetNumberOfEventIndicators)
UNSUPPORTED(GetNumberOfContinuousStates)
