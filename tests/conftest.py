"""Strictness for the tests alone: 64 bit, two host devices, no silent rank promotion, shapes checked at run time."""

from jaxtyping import install_import_hook

from ptsmc_jax.configure import configure

configure(devices=2)

import jax  # noqa: E402

jax.config.update("jax_numpy_rank_promotion", "raise")
hook = install_import_hook(["ptsmc_jax", "tuning"], "beartype.beartype")
