"""The intervals of a run, as clocks make them and devices use them."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array


class Ticks(NamedTuple):
    """Control periods, or steps of integration: (N,) arrays; in the loop those of one, scalars."""

    t: Array  # start [s]
    t_next: Array  # end [s]
    hold: Array  # bool: after the hand-over
    sample: Array  # int32: number of the sample, from the hand-over (anchored) or from t = 0 (others)
    noise_weight: (
        Array  # share of this sample's own noise, the rest is the next one's; below 1 in a partial first period
    )


def rounding(period: Any, t: Any) -> Any:
    """By how much times about t [s] may differ and still count as equal [s]: 1e-9 of a period, and what numbers lose.

    With 64 bits the latter is less; with 32 a period of 0.01 s is known to 4e-5 of it after half a minute. Times may be
    negative, of samples that are counted from the hand-over.
    """
    return 1e-9 * period + 4.0 * jnp.finfo(jnp.result_type(float)).eps * jnp.abs(t)
