"""The intervals of a run, as clocks make them and devices use them."""

from typing import NamedTuple

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
    partial: Array  # bool: the first period of an anchored clock, whose length moves with the hand-over
