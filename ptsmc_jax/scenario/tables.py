"""The tables of a scenario file, all in one place; here those that say how a run is closed, judged and tuned.

A table is a struct whose docstring says what each key means, with its unit; its type says what is allowed and the
default. Errors, `ptsmc new` and the scenario reference are made from them.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta

from ptsmc_jax.scenario.device_tables import (
    AxesWheels,
    Hardware,
    NoFilter,
    PyramidWheels,
    StateHardware,
    SteadyStateFilter,
)
from ptsmc_jax.scenario.dispersion_tables import Dispersion, StateDispersion
from ptsmc_jax.scenario.law_tables import LAWS
from ptsmc_jax.scenario.plant_tables import ChainPlant, Spacecraft, SpacecraftPlant, SystemPlant
from ptsmc_jax.scenario.reference_tables import Initial
from ptsmc_jax.scenario.values import Interval, NotNegative, Positive, Quantile, Table, Truth


class Loop(Table, frozen=True):
    """How the loop is closed, and until when a run goes.

    Attributes:
        mode: the law inside the integrator, or computed and held once a period
        period: control period, sampled loop only [s]
        clock: a sample at t_f - delta, for tuning, or at whole periods, as a flight computer has them
        t_end: end of the run; default: t_f + 10, or + window if that is longer [s]
        window: time after t_f over which window_error is taken [s]
        settling_angle: angle to the reference that counts as settled; of other plants |x_1| [rad]
    """

    mode: Literal["continuous", "sampled"] = "continuous"
    period: Positive = 0.05
    clock: Literal["anchored", "flight"] = "anchored"
    t_end: Positive | None = None
    window: Positive = 1.0
    settling_angle: Positive = 1e-3


class Limit(Table, frozen=True):
    """A requirement in full: metric <= limit in a share of the trials.

    Attributes:
        limit: the largest value allowed
        quantile: the share of the trials in which it must hold; default: all that are flown
        confidence: of the one-sided bound (Clopper and Pearson) by which that share must be shown; default: none asked
    """

    limit: Positive
    quantile: Quantile | None = None
    confidence: Quantile | None = None


FREE = (*dict.fromkeys(name for laws in LAWS.values() for law in laws.values() for name in law.gains),
        "observer_gain", "filter_bandwidth")  # besides those of a law of one's own  # fmt: skip
FREE_TOLD = f"a list of some of {', '.join(FREE)}"
FreeGains = Annotated[tuple[str, ...], Meta(min_length=1, description=FREE_TOLD)]


class Tune(Table, frozen=True):
    """What `tune`, `pareto` and `compare` search for: the smallest window error that keeps every requirement.

    Attributes:
        free: the gains to find; default: all but surface_rate and t_f, of k1 and sign_width only if sampled
        bounds: two numbers for each gain; by default from law, period, t_f and body: see scenario.toml of a run
        per_axis: observer_gain as one number for each axis
        objective: minimised: RMS window error, the largest one, its CVaR, or t_f, the shortest for the requirements
        level: the CVaR is the RMS of the worst 1 - level of the trials; with "cvar" only, default: 0.9
        torque_weight: weight of ln(RMS peak torque) beside ln(error), Remark 1's trade-off
        worst_case: keep the requirements in the worst case inside the dispersions too, not only where drawn
        trials: trials to tune on; more where a quantile with a confidence takes more to be shown at all
        starts: points to search from, most of them a few steps: the scenario's, and the best of a sweep
        steps: points looked at from a start, at most, with slopes
    """

    free: FreeGains | None = None
    bounds: Annotated[dict[str, Interval], Meta(description="a table of two numbers for each gain")] = {}  # noqa: RUF012
    per_axis: Truth = False
    objective: Literal["rms", "worst", "cvar", "t_f"] = "rms"
    level: Quantile | None = None
    torque_weight: NotNegative = 0.0
    worst_case: Truth = False
    # all trials are flown at once and held in memory
    trials: Annotated[int, Meta(ge=1, le=10**6, description="a whole number from 1 to 1000000")] = 256
    starts: Annotated[int, Meta(ge=1, le=100, description="a whole number from 1 to 100")] = 32
    steps: Annotated[int, Meta(ge=1, le=10**5, description="a whole number from 1 to 100000")] = 40


class Scenario(Table, frozen=True, kw_only=True):
    """A scenario as its file says it, every key resolved; tables that are None are off, or not of this plant's."""

    plant: SpacecraftPlant | ChainPlant | SystemPlant
    spacecraft: Spacecraft | None = None
    initial: Initial | None = None
    # the tables of their kinds, see `layouts.TABLES`
    reference: Any = None  # `reference_tables.ReferenceTable`
    disturbance: Any  # `disturbance_tables.DisturbanceTable`, or several
    controller: Any  # `law_tables.LawTable`
    observer: Any  # `observer_tables.ObserverTable`
    loop: Loop
    hardware: Hardware | StateHardware | None = None
    wheels: PyramidWheels | AxesWheels | None = None
    filter: NoFilter | SteadyStateFilter | None = None
    dispersion: Dispersion | StateDispersion | None = None
    requirements: dict[str, float | Limit] = {}  # noqa: RUF012
    tune: Tune | None = None
