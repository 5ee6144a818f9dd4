"""Intervals of the free gains; shares of them, from 0 to 1, <-> gains."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.tables import Scenario
from tuning import gains as gain_names

TIMES, TIME_DIGITS = ("delta", "t_f"), 12  # with fewer digits a hand-over may fall behind its sample


@dataclass(frozen=True)
class Bounds:
    """Intervals of the free gains, in order. A gain that may vary more than tenfold is searched on a log scale."""

    names: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    def logarithmic(self) -> np.ndarray:
        """(gains,) bool: searched on a log scale."""
        return np.asarray(self.upper) > 10.0 * np.asarray(self.lower)

    def _scaled(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        log = self.logarithmic
        return np.where(log, np.log(lower), lower), np.where(log, np.log(upper), upper)

    def gains(self, share: Float[Array, " gains"]) -> Float[Array, " gains"]:
        """Gains of shares of the intervals: 0 is the lower bound, 1 the upper one."""
        low, high = self._scaled()
        inner = low + (high - low) * share
        return jnp.where(self.logarithmic, jnp.exp(inner), inner)

    def share(self, gains: np.ndarray) -> np.ndarray:
        """Shares of gains, (gains,); of those beyond a bound the bound's."""
        low, high = self._scaled()
        inner = np.where(self.logarithmic, np.log(np.maximum(gains, 1e-300)), gains)
        return np.clip((inner - low) / (high - low), 0.0, 1.0)

    def at_bound(self, gains: np.ndarray, near: float = 0.01) -> dict[str, str]:
        """Gains that ended within this share of the interval from a bound: name to "lower" or "upper"."""
        sides = {name: "lower" if share < near else "upper"
                 for name, share in zip(self.names, self.share(gains), strict=True)
                 if not near <= share <= 1.0 - near}  # fmt: skip
        return sides

    def rounded(self, gains: np.ndarray, digits: int) -> dict[str, float]:
        """Gains by name with so many digits, none of them beyond its bounds; times stay on their samples."""
        within = zip(self.names, gains, self.lower, self.upper, strict=True)
        shown = {name: TIME_DIGITS if name in TIMES else digits for name in self.names}
        return {name: min(max(float(f"{gain:.{shown[name]}g}"), low), high) for name, gain, low, high in within}


def of_scenario(scenario: Scenario) -> Bounds:
    """The bounds of a checked scenario's free gains."""
    assert scenario.tune is not None
    names = gain_names.named(scenario)
    intervals = [scenario.tune.bounds[gain_names.base(name)] for name in names]
    return Bounds(names, tuple(low for low, _ in intervals), tuple(high for _, high in intervals))
