"""What every law of a scenario file is: a table of keys, the gains among them, and what they are made into."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from ptsmc_jax.scenario import disturbance_bounds, gain_bounds, mission
from ptsmc_jax.scenario.gain_record import GainBounds
from ptsmc_jax.scenario.values import Kind


class LawTable(Kind, frozen=True):
    """A law, whatever it is for; each has t_f, and bounds of Assumption 1 on the disturbance."""

    prefix: ClassVar[str] = ""  # with the key it makes the name of a gain
    gains: ClassVar[Mapping[str, GainBounds]] = {}  # all that tuning may move
    # those that are free where a scenario does not say; the second ones in the sampled loop only, since without samples
    # a larger K1 and a narrower sign cost nothing but steps
    free_by_default: ClassVar[tuple[str, ...]] = ()
    free_if_sampled: ClassVar[tuple[str, ...]] = ()
    switches: ClassVar[bool] = True  # against the bound on what is not estimated, which some laws have no use for
    prescribed: ClassVar[bool] = False  # hands over at t_f - delta, and flies in either loop; others when sampled only

    def physics(self, motion: str) -> Any:
        """Return the class of `laws` for plants of this `Scenario.motion`; its fields are named as the keys."""
        raise NotImplementedError

    def kinematics(self, motion: str) -> Any:
        """Return the class of the error kinematics for plants of this `Scenario.motion`."""
        from ptsmc_jax.laws import kinematics

        if motion == "spacecraft":
            additive = getattr(self, "error", "multiplicative") == "additive"
            return kinematics.AdditiveKinematics if additive else kinematics.MultiplicativeKinematics
        return {"chain": kinematics.ChainKinematics, "system": kinematics.SecondOrderKinematics}[motion]

    def free(self, *, sampled: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Its gains that are free where a scenario does not say, those before and those after the observer's."""
        return self.free_by_default, self.free_if_sampled if sampled else ()

    def filled(self, scenario: Any) -> Any:
        """Fill absent bounds of Assumption 1 from the disturbance, then absent gains by `designed`."""
        found = disturbance_bounds.of(scenario)
        if found is not None:
            self = self._with(dict(zip(("disturbance_bound", "disturbance_rate_bound"), found, strict=True)))
        made = self._with(self.designed(msgspec.structs.replace(scenario, controller=self)))
        made = made._with(made.published_in(mission.scales(scenario)))
        delta, by_default = getattr(made, "delta", None), getattr(self, "delta", 0.0) is None
        if scenario.sampled and by_default and delta is not None:
            made = msgspec.structs.replace(made, delta=max(delta, scenario.loop.period))
        return made

    def _with(self, follows: Mapping[str, Any]) -> Any:
        """Return the table with these values for its absent keys."""
        return msgspec.structs.replace(self, **{k: v for k, v in follows.items() if getattr(self, k) is None})

    def designed(self, scenario: Any) -> dict[str, float]:
        """Return the gains that the mission suggests; none if those of the paper's case stay, scaled or not."""
        if not scenario.sampled or mission.published(scenario):
            return {}
        return self.gains_of(mission.design(scenario), scenario)

    def published_in(self, units: mission.Scales) -> dict[str, Any]:
        """Return the gains of the paper's case, by key, in the units of a mission."""
        return {key: units.of(scaled) for key, scaled in self.scaled.items()}

    def gains_of(self, design: mission.Design, scenario: Any) -> dict[str, float]:
        """Return this law's gains for a design of the sampled loop, by key: published ones within the bandwidth."""
        return self.published_in(mission.scales(scenario)._replace(time=1.0 / design.rate))

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of the sliding variable (1 sigma) for noise of the error and of its rate [1/s]."""
        law: Any = self
        return math.hypot(velocity, (getattr(law, "surface_rate", None) or 1.0 / law.t_f) * position)

    def turning(self, t_f: float) -> tuple[str, float]:
        """How fast it turns the body [rad/s], at most, and the key that says so."""
        raise NotImplementedError

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError where its keys contradict each other, or the scenario's."""

    def build(self, scenario: Any, model: Any) -> Any:
        """The law of a plant's model."""
        from ptsmc_jax.numerics.pytrees import vector

        made = self.physics(scenario.motion)
        names = [f.name for f in dataclasses.fields(made) if f.name != "kinematics" and not f.metadata.get("static")]
        own = {name: gain_bounds.hand_over(scenario) if name == "delta" else getattr(self, name) for name in names}
        return made(self.kinematics(scenario.motion)(model), **{name: vector(value) for name, value in own.items()})


def common_keys(law: LawTable) -> dict[str, Any]:
    """The keys that every law has, with this one's values."""
    names = ("t_f", "disturbance_rate_bound", "disturbance_bound", "initial_estimate_error")
    return {name: getattr(law, name) for name in names}
