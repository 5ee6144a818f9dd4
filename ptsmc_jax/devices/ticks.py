"""Time intervals of a run, which clocks create and devices use."""

from typing import NamedTuple

from jaxtyping import Array


class Ticks(NamedTuple):
    """Control periods or integration steps, as (N,) arrays; inside a loop a single one, with scalars."""

    t: Array  # start [s]
    t_next: Array  # end [s]
    hold: Array  # bool: after the hand-over
    sample: Array  # int32: number of the sample, from the hand-over (anchored) or from t = 0 (others)
    # weight of this sample's own noise, below 1 in a partial first period; the rest is the weight of the next noise
    noise_weight: Array
    partial: Array  # bool: the first period of an anchored clock, whose length depends on the hand-over time
