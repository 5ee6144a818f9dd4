"""Which gains are free and their intervals; free reals <-> gains inside the bounds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.rollout import Parts

_STATE_UNITS = {"eta": "-", "delta": "s", "observer_gain": "1/s", "k1": "1/s", "sign_width": "x1"}
# gain: unit, by the kind of the plant
UNITS = {
    "spacecraft": {"eta": "-", "delta": "s", "observer_gain": "N m s", "k1": "1/s", "sign_width": "-"},
    "chain": {**_STATE_UNITS, "sign_width": "s"},
    "system": _STATE_UNITS,
}


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


def with_gains(parts: Parts, gains: Mapping[str, Array | float]) -> Parts:
    """The parts with other gains, by name; `observer_gain` is set on all axes."""
    controller = {k: jnp.asarray(v, float) for k, v in gains.items() if k != "observer_gain"}
    parts = replace(parts, controller=replace(parts.controller, **controller))
    if "observer_gain" in gains:
        gain = jnp.full(parts.plant.inputs, jnp.asarray(gains["observer_gain"], float))
        parts = replace(parts, observer=replace(parts.observer, gain=gain))
    return parts


def gains_of(parts: Parts) -> dict[str, float]:
    """Every tunable gain of the parts by name (the observer's, if there is one: the mean over the axes)."""
    controller = parts.controller
    gains = {"eta": float(controller.eta), "delta": float(controller.delta)}
    if hasattr(parts.observer, "gain"):
        gains["observer_gain"] = float(jnp.mean(parts.observer.gain))
    return {**gains, "k1": float(controller.k1), "sign_width": float(controller.sign_width)}
