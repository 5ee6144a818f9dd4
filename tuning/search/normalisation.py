"""Bounds of the free gains, and the map between gains and normalised gains. Read `Bounds` first.

A normalised gain is 0 at the lower bound and 1 at the upper bound.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.scenario import free_gains
from ptsmc_jax.scenario.gain_bounds import is_log_scaled
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import envelopes
from tuning.search import gains as gain_names

TIMES, TIME_DIGITS = ("delta", "t_f"), 12  # with fewer digits, a hand-over may move past its sample

MOST_OF_UPPER = 0.5  # largest lower bound of sign_width relative to its upper bound
BOUND_TOLERANCE = 0.01  # a gain within this fraction of its interval from a bound counts as on the bound


@pytree
@dataclass(frozen=True)
class Scale:
    """The map from normalised gains to gains. It is a pytree, so that the bounds are run-time arguments."""

    lower: Leaf | np.ndarray  # (gains,)
    upper: Leaf | np.ndarray  # (gains,)
    jump: Leaf | np.ndarray  # number that moves the lower bound of sign_width, see `Bounds`
    log: tuple[bool, ...] = field(metadata={"static": True})  # gains that are searched on a log scale
    width_index: int | None = field(
        metadata={"static": True}
    )  # index of a sign_width whose lower bound moves with `jump`
    observer_indices: tuple[int, ...] = field(metadata={"static": True})  # indices of the observer's gains

    def gains(self, normalised: Any) -> Any:
        """Convert normalised gains (gains,) to gains, as a NumPy or JAX array.

        Only the ratio of the bounds enters on a log scale, so the normalised gains do not depend on the units.
        """
        xp, low, high, log = normalised.__array_namespace__(), self.lower, self.upper, np.asarray(self.log)
        ratio = xp.where(log, high, 1.0) / xp.where(log, low, 1.0)
        gains = xp.where(log, low * ratio**normalised, low + (high - low) * normalised)
        if self.width_index is None:
            return gains
        k, least = self.width_index, self.least_width(gains)
        return xp.where(np.arange(len(self.log)) == k, least * (high[k] / least) ** normalised[k], gains)

    def least_width(self, gains: Any) -> Any:
        """Return the lower bound of sign_width for these gains (gains,). Only the gains of the observer change it."""
        least = self.jump / gains[np.asarray(self.observer_indices)].min()
        return gains.__array_namespace__().clip(
            least, self.lower[self.width_index], MOST_OF_UPPER * self.upper[self.width_index]
        )


@dataclass(frozen=True)
class Bounds:
    """Bounds of the free gains. A gain that may vary more than tenfold is searched on a log scale.

    The lower bound of sign_width is raised to jump / observer_gain if that is larger. Below this boundary-layer
    thickness, the sampled switching term jumps from one side of s = 0 to the other. The thickness is proportional to
    K2, which is inversely proportional to the observer's gain.
    """

    names: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    jump: float = 0.0  # [unit of s times unit of observer_gain]; 0: the lower bound of sign_width is fixed

    @property
    def scale(self) -> Scale:
        """The map from normalised gains to gains, for compiled programs."""
        observers = tuple(k for k, name in enumerate(self.names) if gain_names.base(name) == "observer_gain")
        width = self.names.index("sign_width") if self.jump else None
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        log = tuple(map(bool, is_log_scaled(lower, upper)))
        return Scale(lower, upper, np.asarray(self.jump), log, width, observers)

    def gains(self, normalised: Any) -> Any:
        """Convert normalised gains (gains,) to gains, see `Scale.gains`."""
        return self.scale.gains(normalised)

    def normalise(self, gains: np.ndarray) -> np.ndarray:
        """Convert gains (gains,) to normalised gains. Gains beyond a bound are clipped to the bound."""
        return np.clip(self._normalise(gains), 0.0, 1.0)

    def with_gains(self, normalised: np.ndarray, gains: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return normalised gains, (gains,), with some of the gains replaced and all other gains unchanged.

        The lower bound of sign_width depends on the observer's gain. If the observer's gain is replaced, the normalised
        sign_width therefore changes, and it is below 0 if the same width is now below its lower bound.

        Args:
            normalised: (gains,) normalised gains.
            gains: (gains,) the new values.
            which: (gains,) bool, the gains to replace.
        """
        combined = np.where(which, self.normalise(gains), normalised)
        if self.jump:
            width = self.names.index("sign_width")
            combined[width] = self._normalise(np.where(which, gains, self.gains(normalised)))[width]
        return combined

    def _normalise(self, gains: np.ndarray) -> np.ndarray:
        """Convert gains (gains,) to normalised gains, without clipping."""
        scale = self.scale
        low, high, log = scale.lower.copy(), scale.upper, np.asarray(scale.log)
        if scale.width_index is not None:
            low[scale.width_index] = scale.least_width(gains)
        ratio = np.where(log, high, np.e) / np.where(log, low, 1.0)
        logarithms = np.log(np.maximum(np.where(log, gains, 1.0) / np.where(log, low, 1.0), 1e-300))
        return np.where(log, logarithms / np.log(ratio), (gains - low) / (high - low))

    def at_bound(self, gains: np.ndarray) -> dict[str, str]:
        """Return the gains that are on a bound to within `BOUND_TOLERANCE`, as {name: "lower" or "upper"}.

        Args:
            gains: values of all free gains, (gains,).
        """
        by_name = dict(zip(self.names, self.normalise(gains).tolist(), strict=True))
        return {name: "lower" if normalised < BOUND_TOLERANCE else "upper" for name, normalised in by_name.items()
                if not BOUND_TOLERANCE <= normalised <= 1.0 - BOUND_TOLERANCE}  # fmt: skip

    def rounded(self, gains: np.ndarray, digits: int) -> dict[str, float]:
        """Return gains (gains,) by name, rounded to significant digits and kept within the bounds.

        Times keep `TIME_DIGITS` digits, so that a hand-over stays on its sample.
        """
        within = zip(self.names, gains, self.lower, self.upper, strict=True)
        shown = {name: TIME_DIGITS if name in TIMES else digits for name in self.names}
        return {name: min(max(float(f"{gain:.{shown[name]}g}"), low), high) for name, gain, low, high in within}


def bounds_of_scenario(scenario: Scenario, parts: Parts) -> Bounds:
    """Return the bounds of the free gains of a validated scenario, which has these parts."""
    names = gain_names.free_gain_names(scenario)
    intervals = {name: scenario.search.bounds[gain_names.base(name)] for name in names}
    jump = 0.0
    if "sign_width" in names and _can_overshoot(scenario, parts):
        jump = envelopes.smallest_sign_width(parts, scenario.loop.period) / 2
        if parts.observer.linear and any(gain_names.base(name) == "observer_gain" for name in names):
            jump *= float(parts.observer.gain.min())
        else:  # the lower bound of sign_width does not depend on a free gain
            low, high = intervals["sign_width"]
            intervals["sign_width"], jump = (min(max(low, jump), MOST_OF_UPPER * high), high), 0.0
    lower, upper = zip(*intervals.values(), strict=True)
    return Bounds(names, lower, upper, jump)


def _can_overshoot(scenario: Scenario, parts: Parts) -> bool:
    """Return whether sign_width has the default lower bound and the sampled switching term can overshoot."""
    if not scenario.sampled or not parts.controller.prescribed:
        return False
    return scenario.search.bounds["sign_width"][0] == free_gains.usual_bounds(scenario, "sign_width")[0]
