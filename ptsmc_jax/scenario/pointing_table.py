"""The table [pointing] of scenario files: the observation of pointing errors after t_f. Start with `Pointing`."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np

from ptsmc_jax.declare import Scaled
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.values import ABSENT, Meaning, NotNegative, ResolvedPositive, Table, Three
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.pointing import Pointing as PointingPart
from ptsmc_jax.simulation.pointing import boresight_frame

LONGEST_STEP = 0.02  # largest step of the continuous loop in the hold phase / t_f, see `clock`


class Pointing(Table, frozen=True):
    """Observation of pointing error indices (ECSS-E-ST-60-10C) in windows, from t_f + `after` to t_end."""

    boresight: Annotated[
        Three,
        Meaning(
            "direction of an instrument in body axes, of any length; the indices of its half-cone "
            "angle are then computed too"
        ),
    ] = (0.0, 0.0, 1.0)
    window: Annotated[
        ResolvedPositive,
        Meaning("length of the windows for mean errors (MPE, RPE, PDE); default: t_f / 30", "s"),
    ] = ABSENT
    after: Annotated[NotNegative, Meaning("time from t_f to the start of the observation", "s")] = 0.0
    scaled: ClassVar[Mapping[str, Scaled]] = {"window": Scaled(1.0, time=1)}

    def check(self, scenario: Any) -> None:
        """Raise ScenarioError for a zero boresight or a window that is too short or too long.

        Two windows must fit into the observation, and one control period into a window.
        """
        if not np.linalg.norm(self.boresight) > 0.0:
            raise wrong("pointing.boresight", self.boresight, "a direction, not all zero")
        available, needed = scenario.end - scenario.controller.t_f, 2.0 * self.window * (1 - 1e-9)
        if not available >= needed:
            raise wrong("pointing.window", self.window, f"at most half of loop.t_end - controller.t_f, {available:.6g}")
        if not available - self.after >= needed:
            latest = f"at most {available - 2.0 * self.window:.6g}, two windows of {self.window:g} s before loop.t_end"
            raise wrong("pointing.after", self.after, latest)
        sampled = scenario.sampled
        longest_step = LONGEST_STEP * scenario.controller.t_f
        shortest, source = (scenario.loop.period, "loop.period") if sampled else (longest_step, "the longest step")
        jitter = getattr(scenario.dispersion, "timing_jitter", None)
        if sampled and jitter is not None:  # a period may begin early and end late
            shortest, source = shortest * (1.0 + 2.0 * jitter.largest), "the longest control period with its jitter"
        if self.window < shortest * (1 - 1e-9):
            raise wrong("pointing.window", self.window, f"at least {source}, {shortest:.9g}")

    def build(self, scenario: Any) -> Any:
        """Return `pointing.Pointing`, with the limits whose requirements concern a fraction of the time."""
        limits = {
            name: vector(limit.limit)
            for name, limit in scenario.requirements.items()
            if getattr(limit, "interpretation", None) not in (None, "ensemble")
        }
        # if no limit needs samples in a window, their number is 0, so that one program serves all control periods
        needs_samples = scenario.sampled and any(name.startswith(catalogues.RELATIVE_INDICES) for name in limits)
        # both ends of a window may be samples, and jitter of half a period may move one more sample into it
        samples = math.ceil(self.window / scenario.loop.period) + 2 if needs_samples else 0
        return PointingPart(
            vector(boresight_frame(self.boresight)), vector(self.after), vector(self.window), limits, samples
        )
