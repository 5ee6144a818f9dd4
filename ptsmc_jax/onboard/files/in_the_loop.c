/* Steps of a controller, one for each row, for simulators and for XLA. */
#include <math.h>

#include "ptsmc_${name}_flat.h"
#include "xla/ffi/api/c_api.h"

const long ptsmc_sizes[4] = {PTSMC_IN_SIZE, PTSMC_OUT_SIZE, PTSMC_STATE_SIZE, PTSMC_PARAMS_SIZE};
double ptsmc_given[PTSMC_PARAMS_SIZE]; /* parameters that are used if a row has NaN */

void ptsmc_first(double *state);
void ptsmc_set(void);
void ptsmc_many(long count, const double *params, const double *state, const double *in, double *after, double *out,
                int *status);
XLA_FFI_Error *ptsmc_called(XLA_FFI_CallFrame *frame);

void ptsmc_first(double *state)
{
    ptsmc_params p;
    ptsmc_state x;
    ptsmc_params_from(ptsmc_given, &p);
    ptsmc_init(&p, &x);
    ptsmc_state_to(&x, state);
}

void ptsmc_set(void)
{
    ptsmc_params_to(&ptsmc_parameters, ptsmc_given);
}

/* Make one step for each row of parameters (NaN selects ptsmc_given), states and inputs. */
void ptsmc_many(long count, const double *params, const double *state, const double *in, double *after, double *out,
                int *status)
{
    ptsmc_params own;
    ptsmc_state first; /* contains the derived numbers, which have no columns */
    ptsmc_params_from(ptsmc_given, &own);
    ptsmc_init(&own, &first);
    for (long k = 0; k < count; k++) {
        ptsmc_params p = own;
        ptsmc_state x = first;
        ptsmc_in given;
        ptsmc_out found;
        double row[PTSMC_PARAMS_SIZE];
        int any = 0;
        for (long c = 0; c < PTSMC_PARAMS_SIZE; c++) {
            const double *const one = params + k * PTSMC_PARAMS_SIZE + c;
            row[c] = isnan(*one) ? ptsmc_given[c] : *one;
            any |= !isnan(*one);
        }
        if (any) {
            ptsmc_params_from(row, &p);
            ptsmc_init(&p, &x);
        }
        ptsmc_state_from(state + k * PTSMC_STATE_SIZE, &x);
        ptsmc_in_from(in + k * PTSMC_IN_SIZE, &given);
        status[k] = ptsmc_step(&p, &x, &given, &found);
        ptsmc_state_to(&x, after + k * PTSMC_STATE_SIZE);
        ptsmc_out_to(&found, out + k * PTSMC_OUT_SIZE);
    }
}

/* Read a row of floats as doubles. */
static void get(const XLA_FFI_Buffer *from, long k, long size, double *row)
{
    for (long c = 0; c < size; c++) row[c] = (double)((const float *)from->data)[k * size + c];
}

/* Write a row of doubles as floats. */
static void put(const double *row, long k, long size, XLA_FFI_Buffer *to)
{
    for (long c = 0; c < size; c++) ((float *)to->data)[k * size + c] = (float)row[c];
}

/* The function that XLA calls, for arrays of double or float. */
XLA_FFI_Error *ptsmc_called(XLA_FFI_CallFrame *frame)
{
    if (frame->extension_start != NULL && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
        XLA_FFI_Metadata *about = ((XLA_FFI_Metadata_Extension *)(void *)frame->extension_start)->metadata;
        about->api_version.major_version = XLA_FFI_API_MAJOR;
        about->api_version.minor_version = XLA_FFI_API_MINOR;
        about->traits = 0;
        return NULL;
    }
    XLA_FFI_Buffer **given = (XLA_FFI_Buffer **)frame->args.args, **found = (XLA_FFI_Buffer **)frame->rets.rets;
    long count = 1;
    for (int64_t d = 0; d < found[2]->rank; d++) count *= (long)found[2]->dims[d];
    if (given[0]->dtype == XLA_FFI_DataType_F64) {
        ptsmc_many(count, given[2]->data, given[0]->data, given[1]->data, found[0]->data, found[1]->data,
                   found[2]->data);
        return NULL;
    }
    for (long k = 0; k < count; k++) {
        double params[PTSMC_PARAMS_SIZE], state[PTSMC_STATE_SIZE], in[PTSMC_IN_SIZE], out[PTSMC_OUT_SIZE];
        get(given[0], k, PTSMC_STATE_SIZE, state);
        get(given[1], k, PTSMC_IN_SIZE, in);
        get(given[2], k, PTSMC_PARAMS_SIZE, params);
        ptsmc_many(1, params, state, in, state, out, (int *)found[2]->data + k);
        put(state, k, PTSMC_STATE_SIZE, found[0]);
        put(out, k, PTSMC_OUT_SIZE, found[1]);
    }
    return NULL;
}
