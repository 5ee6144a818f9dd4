
static int same(const real *v, const real *w, int count)
{
    for (int k = 0; k < count; k++) {
        if (!(v[k] <= w[k] && v[k] >= w[k])) {
            return 0;
        }
    }
    return 1;
}

/* Return whether the derived numbers belong to these parameters. */
static int current(const ptsmc_params *p, const ptsmc_derived *d)
{
    return ${same};
}
