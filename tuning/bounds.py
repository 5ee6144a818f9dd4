"""Intervals of the free gains; free reals <-> gains inside the bounds."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.tables import Scenario
from tuning import gains as gain_names


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

    def gains(self, z: Float[Array, " gains"]) -> Float[Array, " gains"]:
        """Gains of free reals: the logistic function between the bounds, so every z gives admissible gains."""
        low, high = self._scaled()
        inner = low + (high - low) * jax.nn.sigmoid(z)
        return jnp.where(self.logarithmic, jnp.exp(inner), inner)

    def free(self, gains: np.ndarray, edge: float = 0.02) -> np.ndarray:
        """Free reals of gains, (gains,); those nearer to a bound than `edge` of the interval are moved inside."""
        low, high = self._scaled()
        inner = np.where(self.logarithmic, np.log(np.maximum(gains, 1e-300)), gains)
        share = np.clip((inner - low) / (high - low), edge, 1.0 - edge)
        return np.log(share / (1.0 - share))

    def at_bound(self, gains: np.ndarray, share: float = 0.01) -> dict[str, str]:
        """Gains that ended within `share` of the interval from a bound: name to "lower" or "upper"."""
        low, high = self._scaled()
        inner = (np.where(self.logarithmic, np.log(gains), gains) - low) / (high - low)
        sides = {name: "lower" if u < share else "upper" for name, u in zip(self.names, inner, strict=True)
                 if not share <= u <= 1.0 - share}  # fmt: skip
        return sides


def of_scenario(scenario: Scenario) -> Bounds:
    """The bounds of a checked scenario's free gains."""
    assert scenario.tune is not None
    names = gain_names.named(scenario)
    intervals = [scenario.tune.bounds[gain_names.base(name)] for name in names]
    return Bounds(names, tuple(low for low, _ in intervals), tuple(high for _, high in intervals))
