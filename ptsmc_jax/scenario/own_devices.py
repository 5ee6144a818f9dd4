"""The tables of a scenario file for sensors, and for draws, of one's own."""

from typing import Any, ClassVar, Literal

from ptsmc_jax.scenario.own import Code, Own, build
from ptsmc_jax.scenario.values import Kinds, Table


class OwnSensors(Own, Table, kw_only=True, frozen=True):
    """Sensors of one's own, a class derived from ptsmc_jax.SampledSensor; its fields are further keys.

    They take the place of what [hardware] says of noise, and of [filter].
    """

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("see",)
    tuned: ClassVar[bool] = True
    prefix: ClassVar[str] = "sensors_"

    @classmethod
    def base(cls) -> type:
        """`devices.own_sensors.SampledSensor`."""
        from ptsmc_jax.devices.own_sensors import SampledSensor

        return SampledSensor

    def build(self, model: Any) -> Any:
        """What the code names, as the rollout asks for it."""
        from ptsmc_jax.devices.own_sensors import OwnSensors as Physics
        from ptsmc_jax.numerics.pytrees import vector

        made = build(self, model=model)
        type(made).tunable = tuple(name.removeprefix(self.prefix) for name in self.gains)
        return Physics(made, vector(1.0))


SENSORS: Kinds = {"own": OwnSensors}  # those that are built in are keys of [hardware] and [filter]


class OwnDraw(Own, Table, kw_only=True, frozen=True):
    """Anything of one's own, a class derived from ptsmc_jax.Draw; its fields are further keys."""

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("at",)

    @classmethod
    def base(cls) -> type:
        """`dispersions.base.Draw`."""
        from ptsmc_jax.dispersions.base import Draw

        return Draw

    def build(self) -> Any:
        """What the code names."""
        return build(self)
