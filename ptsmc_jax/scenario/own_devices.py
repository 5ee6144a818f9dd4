"""The tables of a scenario file for sensors, and for draws, of one's own."""

from typing import Any, ClassVar, Literal

from ptsmc_jax.scenario.errors import ScenarioError, show
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
        _check_count(made, "sensors", "draws", 0)
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
        from ptsmc_jax.numerics.draws import DISTRIBUTIONS

        made = build(self)
        _check_count(made, "dispersion.own", "count", 1)
        if made.drawn not in DISTRIBUTIONS:
            raise _unfit(made, "dispersion.own", "drawn", '"normal" or "uniform"')
        return made


def _check_count(made: Any, table: str, field: str, least: int) -> None:
    """Raise ScenarioError where a class says no whole number of what is drawn for it."""
    value = getattr(made, field)
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise _unfit(made, table, field, f"a whole number of at least {least}")


def _unfit(made: Any, table: str, field: str, must: str) -> ScenarioError:
    names = f"{table}.code names a class whose {field} is {show(getattr(made, field))}"
    return ScenarioError(f"{names}, but must be {must}")
