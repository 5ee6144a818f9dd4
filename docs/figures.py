"""Draw the figure of the README from the code: `python docs/figures.py` writes docs/slew.png.

It needs the result of `make tune` in out/tune-first_flight.
"""

from pathlib import Path

from ptsmc_jax.configure import configure

configure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

import ptsmc_jax as ptsmc  # noqa: E402
from ptsmc_jax.batching import lanes  # noqa: E402
from ptsmc_jax.figures import style  # noqa: E402
from ptsmc_jax.formulas import ARCSEC, pointing_angle  # noqa: E402
from ptsmc_jax.numerics import attitude  # noqa: E402
from ptsmc_jax.scenario import Scenario  # noqa: E402
from ptsmc_jax.simulation import rollout  # noqa: E402

ROOT = Path(__file__).parent.parent
SEED, TRIALS = 7, 100


def errors(scenario: Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return times (times,) [s] and angles to the reference (trials, times) [arcsec] of simulated trials."""
    ready = ptsmc.study(scenario)

    def one(trial: jnp.ndarray) -> tuple[jnp.ndarray, jnp.ndarray]:
        parts = ready.dispersion.apply(ready.parts, jnp.uint32(SEED), trial)
        log = rollout.simulate(parts, jnp.uint32(SEED), trial, record=True).log
        assert log is not None
        return log.t, jax.vmap(attitude.angle)(log.x.q, log.reference.q)

    t, angle = lanes.vmap(one)(jnp.arange(TRIALS, dtype=jnp.uint32))
    return np.asarray(t[0]), np.asarray(angle) * ARCSEC


@style.styled
def slew(published: Scenario, tuned: Scenario) -> Figure:
    """Return the pointing error over time with published and with tuned gains, and the lower bound."""
    figure = Figure(figsize=(8.0, 4.2), layout="constrained")
    axes = figure.subplots()
    lines = {"published gains": published, "tuned gains": tuned}
    for (color, line), (name, scenario) in zip(style.STYLES, lines.items(), strict=False):
        t, angle = errors(scenario)
        low, middle, high = np.quantile(angle, (0.05, 0.5, 0.95), axis=0)
        axes.fill_between(t, low, high, color=color, alpha=0.2, lw=0)
        axes.plot(t, middle, line, color=color, label=name)
    parts, bound = ptsmc.study(tuned).parts, ptsmc.lower_bound(tuned)
    t_f, t_end = float(parts.controller.t_f), float(parts.t_end)
    assert bound is not None
    axes.hlines(float(ARCSEC * pointing_angle(bound)), t_f, t_end, **style.LOWER_BOUND, label="lower bound")
    axes.axvline(t_f, **style.LIMIT)
    axes.text(t_f, 1.0, "$t_f$", transform=axes.get_xaxis_transform(), ha="center", va="bottom")
    axes.set(yscale="log", xlabel=style.TIME, ylabel="pointing error [arcsec]", xlim=(0.0, t_end))
    axes.set_title("Tuned gains point 100 times as accurately with the same sensors", loc="left", pad=19)
    axes.legend(loc="lower left")
    return figure


def main() -> None:
    """Write docs/slew.png."""
    published, tuned = (ROOT / path for path in ("scenarios/first_flight.toml", "out/tune-first_flight/tuned.toml"))
    slew(ptsmc.read(published), ptsmc.read(tuned)).savefig(ROOT / "docs/slew.png", dpi=130)


if __name__ == "__main__":
    main()
