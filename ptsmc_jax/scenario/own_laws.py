"""Laws of one's own in a scenario file."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from ptsmc_jax.scenario import gain_bounds
from ptsmc_jax.scenario.baseline_record import BaselineTable
from ptsmc_jax.scenario.gain_record import GainBounds
from ptsmc_jax.scenario.own import Code, Own, registered
from ptsmc_jax.scenario.values import Positive


class OwnLaw(Own, BaselineTable, kw_only=True, frozen=True):
    """A law of one's own, a class derived from ptsmc_jax.AccelerationLaw; its further fields are further keys.

    Attributes:
        delta: time from the hand-over to t_f, if the law hands over; default: one control period [s]
    """

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("acceleration", "__call__")
    tuned: ClassVar[bool] = True
    delta: Positive | None = None
    gains: ClassVar[Mapping[str, GainBounds]] = {"delta": gain_bounds.DELTA, "t_f": gain_bounds.T_F}

    @classmethod
    def base(cls) -> type:
        """`laws.base.AccelerationLaw`."""
        from ptsmc_jax.laws.base import AccelerationLaw

        return AccelerationLaw

    def physics(self, motion: str) -> Any:
        """Return the class that the code names, with the gains that tuning may move."""
        made = registered(self.made)
        made.tunable = tuple(self.gains)
        return made

    def turning(self, t_f: float) -> tuple[str, float]:
        """Twice the mean rate of half a turn: nothing is known of a law of one's own."""
        return "controller.t_f", 2.0 * math.pi / t_f


class OwnAttitudeLaw(OwnLaw, frozen=True):
    """A law of one's own, a class derived from ptsmc_jax.AccelerationLaw; its further fields are further keys.

    Attributes:
        error: what it drives to zero: the vector part of q_f* q, or the paper's q_1 - q_1f
    """

    error: Literal["multiplicative", "additive"] = "multiplicative"
