static ${kind} larger${suffix}(${kind} a, ${kind} b)
{
    return a > b ? a : b;
}

static ${kind} smaller${suffix}(${kind} a, ${kind} b)
{
    return a < b ? a : b;
}

static ${kind} sign_of${suffix}(${kind} x)
{
    return ${sign};
}

/* The integer part of a real number; the nearest integer of this type if it has none, 0 for NaN. */
static ${kind} whole${suffix}(real x)
{
    if (isnan(x)) {
        return 0;
    }
    return x >= R(${beyond}) ? ${high} : (x <= R(${low}) ? ${low} : (${kind})x);
}
