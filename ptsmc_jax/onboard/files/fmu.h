/* fmu.h: everything that both versions of the interface share; fmi2.c and fmi3.c include it.
 * The index of a variable is its value reference: inputs, outputs, status, start of the filter, parameters.
 */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "ptsmc_${name}.h"

#ifdef _WIN32
#define EXPORTED __declspec(dllexport)
#else
#define EXPORTED __attribute__((visibility("default")))
#endif

#define TOKEN "${token}"
#define NEAR 1e-3 /* communication points count as equal within this fraction of a period */

enum {
    INPUTS = ${inputs},
    OUTPUTS = ${outputs},
    PARAMETERS = ${parameters},
    STATUS = INPUTS + OUTPUTS,
    FIRST_START = STATUS + 1, /* state of the attitude filter before the first sample */
    FIRST_PARAMETER = FIRST_START + ${starts},
    VARIABLES = FIRST_PARAMETER + PARAMETERS,
    AT_END = ${at_end} /* 0: a sample happens at the start of its period, as in a controller; 1: at the end */
};

/* types of the variables: r real, i integer, u unsigned integer */
static const char kinds[] = {
${kinds}
};
/* i input, o output, f fixed parameter, t tunable parameter */
static const char roles[] = {
${roles}
};
static const double starts[] = {
${values}
};

enum mode { INSTANTIATED, INITIALISING, RUNNING, TERMINATED };

/* Everything that a saved state contains. */
typedef struct {
    double v[VARIABLES];
    double held[1 + INPUTS]; /* time [s] and inputs of the present sample */
    double start, end; /* first and present communication point [s] */
    double sample; /* number of the present sample */
    int taken; /* whether the inputs of the present sample have been read */
    int mode; /* value of enum mode */
    ptsmc_state state;
} memory;

static void read_inputs(const double *v, ptsmc_in *x)
{
${in_from}
}

static void read_parameters(const double *v, ptsmc_params *x)
{
${params_from}
}

static void write_outputs(const ptsmc_out *x, double *v)
{
${out_to}
}

static void clear(memory *m)
{
    static const memory none;
    *m = none;
    memcpy(m->v, starts, sizeof starts);
}

/* Begin a run with the present parameters. Return 0 if the period cannot be used. */
static int begin(memory *m)
{
    ptsmc_params p;

    read_parameters(m->v + FIRST_PARAMETER, &p);
    ptsmc_init(&p, &m->state);
${filter}
    write_outputs(&m->state.last, m->v + INPUTS);
    return p.period > 0.0;
}

static int step(memory *m, const ptsmc_params *p)
{
    ptsmc_in in;
    ptsmc_out out;
    int status = 0;

    m->held[0] = m->sample * p->period;
    read_inputs(m->held, &in);
    status = ptsmc_step(p, &m->state, &in, &out);
    write_outputs(&out, m->v + INPUTS);
    m->v[STATUS] = status;
    return status;
}

/* Advance to a communication point [s]; return the most severe status of the samples on the way. */
static int advance(memory *m, double end)
{
    ptsmc_params p;
    int status = PTSMC_OK, worst = PTSMC_OK;

    read_parameters(m->v + FIRST_PARAMETER, &p);
    m->end = end;
    end = (end - m->start) / p.period; /* in periods, from here on */
    for (;;) {
        if (!m->taken && m->sample < end - NEAR) {
            memcpy(m->held + 1, m->v, INPUTS * sizeof(double));
            m->taken = 1;
            status = AT_END ? status : step(m, &p);
        }
        worst = status > worst ? status : worst;
        if (!m->taken || m->sample + 1.0 > end + NEAR) {
            return worst;
        }
        status = AT_END ? step(m, &p) : status;
        worst = status > worst ? status : worst;
        m->sample += 1.0;
        m->taken = 0;
    }
}

/* Return the reason why a variable cannot be read or written as this type, or NULL if it can. */
static const char *unreadable(size_t k, char kind)
{
    return k < VARIABLES && (kinds[k] == kind || (kinds[k] == 'u' && kind == UNSIGNED)) ? NULL : "no variable of this type has this value reference";
}

static const char *unwritable(const memory *m, size_t k, char kind, double value)
{
    if (unreadable(k, kind) != NULL) {
        return unreadable(k, kind);
    }
    if (roles[k] == 'o') {
        return "an output cannot be set";
    }
    if (roles[k] == 'f' && m->mode > INITIALISING) {
        return "a fixed parameter cannot be set after the initialization";
    }
    if (kinds[k] == 'u' && value < 0.0) {
        return "this variable must not be negative";
    }
    return roles[k] != 'i' && !isfinite(value) ? "a parameter must be finite" : NULL;
}

/* Return the reason why a step is not possible, or NULL if it is. */
static const char *unsteppable(const memory *m, double t, double length)
{
    const double period = m->v[${period}];

    if (m->mode != RUNNING) {
        return "a step needs an initialized instance";
    }
    if (!(length > 0.0 && length < 1e9 * period)) {
        return "a communication step must be positive and finite";
    }
    return fabs(t - m->end) <= NEAR * period ? NULL : "a step must begin where the last step ended";
}

typedef enum { OK, WARNING, DISCARD, FAILED } result; /* with the values of fmi2Status and fmi3Status */

typedef struct {
    memory m;
    void *environment; /* argument of the logger */
    void (*logger)(void);
    char name[64];
} instance;

static result say(instance *c, result status, const char *text); /* log a message */

EXPORTED result FMI(SetDebugLogging)(instance *c, fmi_bool on, size_t count, const char *const categories[])
{
    (void)c;
    (void)on;
    (void)count;
    (void)categories;
    return OK;
}

static instance *instantiate(const char *name, const char *token, void *environment, void (*logger)(void))
{
    instance *const c = token != NULL && strcmp(token, TOKEN) == 0 ? calloc(1, sizeof *c) : NULL;

    if (c != NULL) {
        clear(&c->m);
        c->environment = environment;
        c->logger = logger;
        strncpy(c->name, name == NULL ? "" : name, sizeof c->name - 1);
    }
    return c;
}

EXPORTED void FMI(FreeInstance)(instance *c)
{
    free(c);
}

EXPORTED result FMI(ExitInitializationMode)(instance *c)
{
    if (c->m.mode != INITIALISING || !begin(&c->m)) {
        return say(c, FAILED, "the initialization needs a positive period, and begins with EnterInitializationMode");
    }
    c->m.mode = RUNNING;
    return OK;
}

EXPORTED result FMI(Terminate)(instance *c)
{
    if (c->m.mode != RUNNING) {
        return say(c, FAILED, "the instance does not run");
    }
    c->m.mode = TERMINATED;
    return OK;
}

EXPORTED result FMI(Reset)(instance *c)
{
    clear(&c->m);
    return OK;
}

/* Functions that read and write variables of a type. */
#define ACCESS(Type, type, kind)                                                                                      \
    EXPORTED result FMI(Get##Type)(instance * c, const unsigned vr[], size_t count, type value[] VALUES)               \
    {                                                                                                                  \
        if (c->m.mode == INITIALISING) {                                                                               \
            begin(&c->m);                                                                                              \
        }                                                                                                              \
        for (size_t k = 0; k < count; k++) {                                                                           \
            const char *const wrong = ONE_EACH ? unreadable(vr[k], kind) : "each variable has one value";              \
            if (wrong != NULL) {                                                                                       \
                return say(c, FAILED, wrong);                                                                          \
            }                                                                                                          \
            value[k] = (type)c->m.v[vr[k]];                                                                            \
        }                                                                                                              \
        return OK;                                                                                                     \
    }                                                                                                                  \
    EXPORTED result FMI(Set##Type)(instance * c, const unsigned vr[], size_t count, const type value[] VALUES)         \
    {                                                                                                                  \
        for (size_t k = 0; k < count; k++) {                                                                           \
            const char *const wrong = ONE_EACH ? unwritable(&c->m, vr[k], kind, (double)value[k])                      \
                                               : "each variable has one value";                                        \
            if (wrong != NULL) {                                                                                       \
                return say(c, FAILED, wrong);                                                                          \
            }                                                                                                          \
            c->m.v[vr[k]] = (double)value[k];                                                                          \
        }                                                                                                              \
        return OK;                                                                                                     \
    }

EXPORTED result STATE(Get, )(instance *c, void **saved)
{
    *saved = *saved == NULL ? malloc(sizeof c->m) : *saved;
    if (*saved == NULL) {
        return say(c, FAILED, "there is no memory for the state");
    }
    memcpy(*saved, &c->m, sizeof c->m);
    return OK;
}

EXPORTED result STATE(Set, )(instance *c, const void *saved)
{
    memcpy(&c->m, saved, sizeof c->m);
    return OK;
}

EXPORTED result STATE(Free, )(instance *c, void **saved)
{
    (void)c;
    free(*saved);
    *saved = NULL;
    return OK;
}

EXPORTED result STATE(Serialized, Size)(instance *c, const void *saved, size_t *size)
{
    (void)saved;
    *size = sizeof c->m;
    return OK;
}

EXPORTED result STATE(Serialize, )(instance *c, const void *saved, char bytes[], size_t size)
{
    if (size < sizeof c->m) {
        return say(c, FAILED, "the array is too short for the state");
    }
    memcpy(bytes, saved, sizeof c->m);
    return OK;
}

EXPORTED result STATE(DESERIALIZE, )(instance *c, const char bytes[], size_t size, void **saved)
{
    if (size != sizeof c->m || STATE(Get, )(c, saved) != OK) {
        return say(c, FAILED, "the bytes are not a state of this FMU");
    }
    memcpy(*saved, bytes, size);
    return OK;
}

static result do_step(instance *c, double t, double length)
{
    const char *const wrong = unsteppable(&c->m, t, length);

    if (wrong != NULL) {
        return say(c, FAILED, wrong);
    }
    return advance(&c->m, t + length) < PTSMC_INPUT ? OK : say(c, WARNING, "a sample was rejected, see the output status");
}

/* Functions of capabilities that the FMU does not have. The caller removes further arguments. */
#define UNSUPPORTED(function)                                                                                          \
    EXPORTED result FMI(function)(instance * c)                                                                        \
    {                                                                                                                  \
        return say(c, FAILED, "the FMU does not support " #function);                                                  \
    }
