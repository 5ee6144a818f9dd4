"""Intervals of the free gains; shares of them, from 0 to 1, <-> gains."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ptsmc_jax.numerics.pytrees import Leaf, pytree
from ptsmc_jax.scenario import free_gains
from ptsmc_jax.scenario.gain_bounds import wide
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import envelopes
from tuning.search import gains as gain_names

TIMES, TIME_DIGITS = ("delta", "t_f"), 12  # with fewer digits a hand-over may fall behind its sample

HALF = 0.5  # the lower bound of sign_width is at most this share of its upper one
NEAR = 0.01  # share of its interval by which a gain is on a bound


@pytree
@dataclass(frozen=True)
class Scale:
    """The map from shares of the bounds' intervals to gains, for compiled programs: other bounds, the same program."""

    lower: Leaf | np.ndarray  # (gains,)
    upper: Leaf | np.ndarray  # (gains,)
    hop: Leaf | np.ndarray  # see `Bounds`
    log: tuple[bool, ...] = field(metadata={"static": True})  # gains that are searched on a log scale
    width: int | None = field(metadata={"static": True})  # place of a sign_width whose lower bound moves with `hop`
    observers: tuple[int, ...] = field(metadata={"static": True})  # places of the observer's gains

    def gains(self, share: Any) -> Any:
        """Gains of shares of the intervals, (gains,), NumPy's or JAX's: 0 is the lower bound, 1 the upper one.

        Bounds enter by their ratio only, so that other units of the gains change no share.
        """
        xp, low, high, log = share.__array_namespace__(), self.lower, self.upper, np.asarray(self.log)
        ratio = xp.where(log, high, 1.0) / xp.where(log, low, 1.0)
        gains = xp.where(log, low * ratio**share, low + (high - low) * share)
        if self.width is None:
            return gains
        k, least = self.width, self.least_width(gains)
        return xp.where(np.arange(len(self.log)) == k, least * (high[k] / least) ** share[k], gains)

    def least_width(self, gains: Any) -> Any:
        """Lower bound of sign_width for these gains of the observer."""
        least = self.hop / gains[np.asarray(self.observers)].min()
        return gains.__array_namespace__().clip(least, self.lower[self.width], HALF * self.upper[self.width])


@dataclass(frozen=True)
class Bounds:
    """Intervals of the free gains, in order. A gain that may vary more than tenfold is searched on a log scale.

    The interval of sign_width begins at hop / observer_gain where that is more than its lower bound: K2, and with it
    the width below which the sampled sign hops from side to side, is inverse to that gain.
    """

    names: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    hop: float = 0.0  # in the units of s times those of the observer's gain

    @property
    def logarithmic(self) -> np.ndarray:
        """(gains,) bool: searched on a log scale."""
        return wide(np.asarray(self.lower), np.asarray(self.upper))

    @property
    def scale(self) -> Scale:
        """What turns shares into gains."""
        observers = tuple(k for k, name in enumerate(self.names) if gain_names.base(name) == "observer_gain")
        width = self.names.index("sign_width") if self.hop else None
        log = tuple(map(bool, self.logarithmic))
        return Scale(np.asarray(self.lower), np.asarray(self.upper), np.asarray(self.hop), log, width, observers)

    def gains(self, share: Any) -> Any:
        """Gains of shares of the intervals, see `Scale.gains`."""
        return self.scale.gains(share)

    def share(self, gains: np.ndarray) -> np.ndarray:
        """Shares of gains, (gains,); of those beyond a bound the bound's."""
        return np.clip(self._share(gains), 0.0, 1.0)

    def replaced(self, share: np.ndarray, gains: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Shares (gains,) where some gains, `which`, are others, (gains,), and the rest stay what they are.

        A share of sign_width is another width where the observer's gain is another one; a width that is then too narrow
        has a share below 0.
        """
        both = np.where(which, self.share(gains), share)
        if self.hop:
            width = self.names.index("sign_width")
            both[width] = self._share(np.where(which, gains, self.gains(share)))[width]
        return both

    def _share(self, gains: np.ndarray) -> np.ndarray:
        """Shares of gains, (gains,); of those beyond a bound below 0 or above 1."""
        scale = self.scale
        low, high, log = scale.lower.copy(), scale.upper, np.asarray(scale.log)
        if scale.width is not None:
            low[scale.width] = scale.least_width(gains)
        ratio = np.where(log, high, np.e) / np.where(log, low, 1.0)
        logarithms = np.log(np.maximum(np.where(log, gains, 1.0) / np.where(log, low, 1.0), 1e-300))
        return np.where(log, logarithms / np.log(ratio), (gains - low) / (high - low))

    def at_bound(self, gains: np.ndarray) -> dict[str, str]:
        """Gains that ended within the share `NEAR` of their interval from a bound: name to "lower" or "upper"."""
        shares = dict(zip(self.names, self.share(gains).tolist(), strict=True))
        return {name: "lower" if share < NEAR else "upper" for name, share in shares.items()
                if not NEAR <= share <= 1.0 - NEAR}  # fmt: skip

    def rounded(self, gains: np.ndarray, digits: int) -> dict[str, float]:
        """Gains by name with so many digits, none of them beyond its bounds; times stay on their samples."""
        within = zip(self.names, gains, self.lower, self.upper, strict=True)
        shown = {name: TIME_DIGITS if name in TIMES else digits for name in self.names}
        return {name: min(max(float(f"{gain:.{shown[name]}g}"), low), high) for name, gain, low, high in within}


def of_scenario(scenario: Scenario, parts: Parts) -> Bounds:
    """The bounds of a checked scenario's free gains; its parts."""
    names = gain_names.named(scenario)
    intervals = {name: scenario.search.bounds[gain_names.base(name)] for name in names}
    hop = 0.0
    if "sign_width" in names and _hops(scenario, parts):
        hop = envelopes.narrowest_sign(parts, scenario.loop.period) / 2
        if parts.observer.linear and any(gain_names.base(name) == "observer_gain" for name in names):
            hop *= float(parts.observer.gain.min())
        else:  # it does not move with a gain
            low, high = intervals["sign_width"]
            intervals["sign_width"], hop = (min(max(low, hop), HALF * high), high), 0.0
    lower, upper = zip(*intervals.values(), strict=True)
    return Bounds(names, lower, upper, hop)


def _hops(scenario: Scenario, parts: Parts) -> bool:
    """Whether the sign may be so narrow that it hops, by a bound that is nobody's but the usual one."""
    if not scenario.sampled or not parts.controller.prescribed:
        return False
    return scenario.search.bounds["sign_width"][0] == free_gains.usual(scenario, "sign_width")[0]
