"""Batched evaluation of a function of one trial over many trials: `lanes.vmap` on CPUs, and a GPU kernel for loops."""
