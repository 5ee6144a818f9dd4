"""The tables of scenario files for custom sensors and custom dispersions."""

from typing import Any, ClassVar

from ptsmc_jax.devices import custom_sensors
from ptsmc_jax.dispersions.base import Draw
from ptsmc_jax.numerics.draws import DISTRIBUTIONS
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario.custom import custom_kind
from ptsmc_jax.scenario.errors import ScenarioError, show
from ptsmc_jax.scenario.schema import PartTable
from ptsmc_jax.scenario.values import Kinds


class SensorTable(PartTable, frozen=True):
    """Custom sensors. They replace the noise of [hardware] and the table [filter]."""

    prefix: ClassVar[str] = "sensors_"

    def build(self, model: Any, period: float) -> Any:
        """Return the sensors for the rollout; `model`: the design model of the plant, `period`: control period [s]."""
        part = self.part(model=model)
        _check_count(part, "sensors", "draws", 0)
        return custom_sensors.CustomSensors(part, vector(1.0))


class DrawTable(PartTable, frozen=True):
    """Custom random quantities."""

    def build(self) -> Any:
        """Return the dispersion, an instance of `ptsmc_jax.Draw`."""
        part = self.part()
        _check_count(part, "dispersion.custom", "count", 1)
        if part.drawn not in DISTRIBUTIONS:
            raise _field_error(part, "dispersion.custom", "drawn", '"normal" or "uniform"')
        return part


def _check_count(part: Any, table: str, field: str, smallest: int) -> None:
    """Raise ScenarioError if the number of random numbers that a class declares is not a whole number >= `smallest`."""
    value = getattr(part, field)
    if not isinstance(value, int) or isinstance(value, bool) or value < smallest:
        raise _field_error(part, table, field, f"a whole number of at least {smallest}")


def _field_error(part: Any, table: str, field: str, allowed: str) -> ScenarioError:
    beginning = f"{table}.code is a class whose {field} is {show(getattr(part, field))}"
    return ScenarioError(f"{beginning}, but must be {allowed}")


SENSORS: Kinds = {  # kinds of the table [sensors]; built-in sensors are set by [hardware] and [filter] instead
    "custom": custom_kind(
        SensorTable, custom_sensors.SampledSensor, ("see",), has_gains=True,
        summary="Custom sensors, a class derived from ptsmc_jax.SampledSensor; its fields are further keys. They "
        "replace the noise of [hardware] and the table [filter].",
    )
}  # fmt: skip
CUSTOM_DRAW: Any = custom_kind(
    DrawTable, Draw, ("at",), "A custom dispersion, a class derived from ptsmc_jax.Draw; its fields are further keys."
)
