"""Scenarios of integrator chains and custom second-order systems, whose initial state is x0 in [plant].

Start with `ChainScenario` and `SystemScenario`.
"""

import math
from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import msgspec
from jax import Array
from msgspec import Meta

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.plants.base import Plant
from ptsmc_jax.plants.integrator_chain import chain
from ptsmc_jax.plants.second_order import System
from ptsmc_jax.scenario import device_tables, dispersion_tables, errors, identify_tables, systems, tables
from ptsmc_jax.scenario.custom import SENSORS
from ptsmc_jax.scenario.disturbance_tables import DISTURBANCES
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.law_tables import LAWS, OBSERVERS
from ptsmc_jax.scenario.tables import Loop, Scenario, Tune
from ptsmc_jax.scenario.values import Kinds, Meaning, Numbers, Table
from ptsmc_jax.signals.references import CurrentTime, Origin
from ptsmc_jax.simulation.catalogues import STATE_CATALOGUE, Entry

_PRESCRIBED_TIME = "prescribed_time"


class ChainPlant(Table, frozen=True):
    """An integrator chain x_i' = x_(i+1), x_n' = u + d, equation (35) in Section 3 of the paper."""

    kind: Literal["chain"] = "chain"
    order: Annotated[
        Annotated[int, Meta(ge=2, le=20, description="a whole number from 2 to 20")],
        Meaning("number n of states; default: the length of x0"),
    ] = 2
    x0: Annotated[Numbers, Meaning("initial state x_1 to x_n")] = (5.0, 3.0)


class SystemPlant(Table, frozen=True):
    """A custom second-order system x_1' = F, x_2' = H + G u + D d, equation (25), in a Python file.

    A scenario with a custom system is a program: a run executes the file with your permissions. Read the file before
    you run a scenario of somebody else. Results that name such a file are run again with --trust only.
    """

    kind: Literal["system"] = "system"
    system: Annotated[
        Annotated[Any, Meta(description='"FILE.py:NAME", a system made with plants.system')],
        Meaning(
            'location of the system: "FILE.py:NAME" with the file in the folder of the scenario, or '
            '"package.module:NAME"; required'
        ),
    ] = None
    truth: Annotated[
        Annotated[Any, Meta(description='"FILE.py:NAME", a system with as many inputs')] | None,
        Meaning(
            "true plant, if it differs from the design model `system`: a system with the same number of "
            "inputs; it may have hidden states (Z, z0)"
        ),
    ] = None
    x0: Annotated[Numbers, Meaning("initial state, x_1 and then x_2")] = (1.0, 0.0)


def tables_by_name(plant: type[Table], kind: str) -> dict[str, type[Table] | Kinds]:
    """Return the tables of a scenario; kind: the key of its disturbances, laws and observers in their registries."""
    return {
        "plant": plant,
        "disturbance": DISTURBANCES[kind],
        "controller": LAWS[kind],
        "observer": OBSERVERS[kind],
        "loop": Loop,
        "hardware": device_tables.StateHardware,
        "sensors": SENSORS,
        "dispersion": dispersion_tables.StateDispersion,
        "tune": Tune,
        "telemetry": identify_tables.StateTelemetry,
        "identify": identify_tables.Identify,
    }


class StateScenario(Scenario, frozen=True, kw_only=True):
    """Base class of scenarios of chains and systems."""

    metrics: ClassVar[Mapping[str, Entry]] = STATE_CATALOGUE

    def fill_plant_defaults(self) -> Self:
        """Return the scenario with one width of the dispersed initial state for each state."""
        dispersed = getattr(self.dispersion, "x0", None)
        if dispersed is None:
            return self
        width = getattr(dispersed, dispersed.width_key) or (1.0,) * len(self.plant.x0)
        dispersed = msgspec.structs.replace(dispersed, **{dispersed.width_key: width})
        return msgspec.structs.replace(self, dispersion=msgspec.structs.replace(self.dispersion, x0=dispersed))

    def start_tangent(self) -> float:
        """Return |x_1| at t = 0, which determines the first acceleration."""
        return math.hypot(*self.plant.x0[: self.inputs])

    def largest_acceleration(self) -> float | None:
        """Return the limit on the input of a chain; None for a system, whose input matrix is not known here."""
        limits = [self.devices.torque_limit, tables.limit_of(self, "peak_torque")]
        known = [limit for limit in limits if limit is not None]
        return min(known) if known and self.plant.kind == "chain" else None

    def default_settling_angle(self) -> float:
        """Return the default of `loop.settling_angle` in units of x_1: 2e-4 |x_1(0)|, or five sigma of the noise."""
        noises = getattr(self.hardware, "state_noise", None) or (0.0,)
        return max(2e-4 * (self.start_tangent() or 5.0), 5.0 * max(noises[: self.inputs]))

    def check_devices(self) -> None:
        """Raise ScenarioError for lists whose length is not the number of inputs or states."""
        self.devices.check(self)
        m = self.inputs
        for place, table in {**self.terms_by_place, "observer": self.observer}.items():
            for key in table.keys_per_input:
                value = getattr(table, key)
                if value is not None and len(value) != m:
                    raise wrong(f"{place}.{key}", value, errors.list_of(m, "input"))

    def initial_state(self) -> Array:
        """Return the state x0."""
        return vector(self.plant.x0)


class ChainScenario(StateScenario, frozen=True, kw_only=True):
    """A scenario of an integrator chain."""

    TABLES: ClassVar[Mapping[str, type[Table] | Kinds]] = tables_by_name(ChainPlant, "chain")
    motion: ClassVar[str] = "chain"

    @classmethod
    def plant_defaults(cls, plant: Any, given: Collection[str], law: object) -> dict[str, Mapping[str, object]]:
        """Return the defaults of a chain: the published cases of Figs. 1 and 2 for the orders 2 and 3.

        All laws have the published t_f. Surfaces of all orders have their poles at -1. If the order is absent, it is
        the length of x0.

        Args:
            plant: the table [plant].
            given: keys of [plant] in the file.
            law: kind of the law.

        Raises:
            ScenarioError: x0 has fewer than two numbers.
        """
        order = len(plant.x0) if "x0" in given and "order" not in given else plant.order
        if order < 2:
            raise wrong("plant.x0", plant.x0, "a list of at least 2 numbers")
        x0 = [*(5.0, 3.0, 2.0)[:order], *[0.0] * (order - 3)]
        poles_at_minus_one = [float(math.comb(order - 1, i)) for i in range(order - 1)]  # (p + 1)^(n-1); order 2: (9)
        law_gains = {"eta": order + 1.0, "a": poles_at_minus_one} if law == _PRESCRIBED_TIME else {}
        return {"plant": {"x0": x0, "order": order}, "controller": {"t_f": 5.0, **law_gains}}

    @property
    def inputs(self) -> int:
        """One: a chain has one input."""
        return 1

    @property
    def order(self) -> int:
        """The number of states."""
        return self.plant.order

    def check_body(self) -> None:
        """Raise ScenarioError if the length of x0 is not the order of the chain."""
        n = self.plant.order
        if len(self.plant.x0) != n:
            raise wrong("plant.x0", self.plant.x0, f"a list of plant.order = {n} numbers")

    def design_model(self) -> Plant:
        """Return the chain."""
        return chain(self.plant.order)

    def build_reference(self) -> Origin:
        """Return the reference, rest at the origin."""
        return Origin()


class SystemScenario(StateScenario, frozen=True, kw_only=True):
    """A scenario of a custom system."""

    TABLES: ClassVar[Mapping[str, type[Table] | Kinds]] = tables_by_name(SystemPlant, "system")
    motion: ClassVar[str] = "system"

    @classmethod
    def plant_defaults(cls, plant: Any, given: Collection[str], law: object) -> dict[str, Mapping[str, object]]:
        """Return the published t_f of a chain; raise ScenarioError if x0 has an odd length."""
        if len(plant.x0) % 2:
            raise wrong("plant.x0", plant.x0, "a list of x_1 followed by x_2, as many numbers each")
        return {"controller": {"t_f": 5.0}}

    @property
    def inputs(self) -> int:
        """The number of components of x_1."""
        return len(self.plant.x0) // 2

    def check_plant(self) -> None:
        """Raise ScenarioError for invalid names of systems. Files are not run, since the user may only read them."""
        plant = self.plant
        if plant.system is None:
            raise ScenarioError(f"plant.system is absent, but must be given: {systems.SYSTEM_NAME_FORMS}")
        for key, value in (("system", plant.system), ("truth", plant.truth)):
            if isinstance(value, str):
                try:
                    systems.split_name(value, systems.SYSTEM_NAME_FORMS)
                except ValueError as error:
                    raise ScenarioError(f"plant.{key} is {errors.brief(value)}: {error}") from None
            elif value is not None:
                self._load_system(key)

    def design_model(self) -> System:
        """Return the design model, plant.system; raise ScenarioError if it cannot be loaded."""
        return self._load_system("system")

    def true_plant(self, model: Plant) -> Plant:
        """Return the true plant, plant.truth or the design model; raise ScenarioError if it cannot be loaded."""
        return model if self.plant.truth is None else self._load_system("truth")

    def _load_system(self, key: str) -> System:
        """Return the system of a key, and run its file if the key names one."""
        value = getattr(self.plant, key)
        try:
            system = systems.load(value)
        except ValueError as error:
            raise ScenarioError(f"plant.{key} is {errors.brief(value)}: {error}") from None
        if key == "system" and hasattr(system, "z0"):
            raise ScenarioError(
                f"plant.system is {errors.brief(value)}, which has states that no law knows (Z, z0); "
                "allowed is one without, and this one as plant.truth"
            )
        n, expected = system.inputs, len(self.plant.x0) // 2
        if n != expected and key == "truth":  # x0 fits plant.system, which is loaded before plant.truth
            shown = errors.brief(value)
            raise ScenarioError(
                f"plant.truth is {shown}, which has n = {n}; allowed is n = {expected}, as plant.system"
            )
        if n * 2 != len(self.plant.x0):
            raise wrong("plant.x0", self.plant.x0, f"a list of {2 * n} numbers, since plant.{key} has n = {n}")
        return system

    def build_reference(self) -> CurrentTime:
        """Return the time as the reference: x_1 is already an error."""
        return CurrentTime()
