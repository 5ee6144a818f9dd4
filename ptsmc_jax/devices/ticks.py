"""Time intervals of a run, which clocks create and devices use."""

from typing import NamedTuple

from jaxtyping import Array


class Ticks(NamedTuple):
    """Control periods or integration steps, as (N,) arrays; inside a loop a single one, with scalars."""

    t: Array  # start [s]
    t_next: Array  # end [s]
    hold: Array  # bool: after the hand-over
    sample: Array  # int32: number of the sample, from the hand-over (anchored) or from t = 0 (others)
    noise_weight: (
        Array  # fraction of this sample's own noise, the rest is the next sample's; below 1 in a partial first period
    )
    partial: Array  # bool: the first period of an anchored clock, whose length depends on the hand-over time
