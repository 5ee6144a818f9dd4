#include "ptsmc_${name}.h"

#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "inputs are checked for NaN and infinity: compile without -ffast-math, -Ofast and -ffinite-math-only"
#endif

typedef ptsmc_real real;

/* A number, and a function of math.h, of the type in use. */
#define R(x) ((real)(x))
#define PTSMC_IS_double 0
#define PTSMC_IS_float 1
#define PTSMC_JOIN(a, b) a##b
#define PTSMC_IS(type) PTSMC_JOIN(PTSMC_IS_, type)
#if PTSMC_IS(PTSMC_REAL)
#define M(function) function##f
#else
#define M(function) function
#endif

${functions}

static int all_finite(const real *v, int count)
{
    for (int k = 0; k < count; k++) {
        if (!isfinite(v[k])) {
            return 0;
        }
    }
    return 1;
}
