"""Time of value and gradient in three gains relative to the forward run, and their memory for longer runs.

Reverse mode is measured with the options of `configure` and with those of batches, which are not made for it.
"""

import jax

from ptsmc_jax.configure import configure

configure()

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import machine, medians, say, study  # noqa: E402

from ptsmc_jax import programs  # noqa: E402
from ptsmc_jax.batching import lanes  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.simulation import rollout  # noqa: E402
from ptsmc_jax.simulation.requirements import Requirement  # noqa: E402
from tuning.search import objective  # noqa: E402
from tuning.search.gains import with_gains  # noqa: E402
from tuning.search.objective import Problem, measure  # noqa: E402

GAINS = ("eta", "delta", "observer_gain")
AT = jnp.asarray([2.9, 1.0, 100.0])
LENGTHS = (1_000, 10_000, 100_000)


def problem(ready, trials: int) -> Problem:
    """Return the first flight's tuning problem on this number of trials."""
    limit = Requirement("peak_torque", 0.5)
    return objective.problem(ready.parts, ready.dispersion, 0, np.arange(trials), GAINS, [limit])


@jax.jit
def value(problem: Problem, gains):
    """Return what tuning measures, without derivatives."""
    return measure(problem, gains)


@jax.jit
def value_and_gradient(problem: Problem, gains):
    """Return the value with its derivatives in the gains, in forward mode."""

    def twice(gains):
        measured = measure(problem, gains)
        return measured, measured

    return jax.jacfwd(twice, has_aux=True)(gains)


@jax.jit
def everything(problem: Problem):
    """Return the forward run with all its metrics, on the same device."""

    def one(trial):
        return montecarlo.one(problem.parts, problem.dispersion, problem.seed, trial)[0]

    return montecarlo.map_in_blocks(one, problem.trials)


def ratios() -> None:
    """Print times on one device."""
    for noise in (True, False):
        for trials in (128, 1024):
            some = problem(study(noise), trials)
            seconds = medians({
                "forward": lambda some=some: value(some, AT),
                "all metrics": lambda some=some: everything(some),
                "gradient": lambda some=some: value_and_gradient(some, AT),
            })  # fmt: skip
            cost = seconds["gradient"]
            say(f"noise {'on ' if noise else 'off'} {trials:5d} trials: value and gradient take {cost * 1e3:6.1f} ms, "
                f"{cost / seconds['forward']:.1f} times the value alone, "
                f"{cost / seconds['all metrics']:.1f} times a run with all metrics")  # fmt: skip


def memory() -> None:
    """Print the memory of the compiled gradient of 128 trials, as the compiler reports it."""
    say("\nmemory of value and gradient, 128 trials:")
    for steps in LENGTHS:
        some = problem(study(True, loop__period=45.0 / steps), 128)
        told = value_and_gradient.lower(some, AT).compile().memory_analysis()
        assert told is not None
        say(f"  {steps:7d} periods: {told.temp_size_in_bytes / 1e6:.2f} MB")


def reverse() -> None:
    """Print times of reverse mode of one run, and of 64 runs in lanes, on one device."""
    say("\nvalue and gradient by reverse mode:")

    def squares(ready, trials):
        def one(gains, trial):
            parts = with_gains(ready.parts, dict(zip(GAINS, gains, strict=True)))
            return rollout.simulate(parts, 0, trial).metrics.window_error ** 2

        many = trials is not None
        return lambda gains: jnp.sum(lanes.vmap(one, (None, 0))(gains, trials) if many else one(gains, 0))

    for steps, count in ((900, 1), (3600, 1), (900, 64)):
        ready = study(True, loop__period=45.0 / steps)
        error = squares(ready, np.arange(count, dtype=np.uint32) if count > 1 else None)
        ways = {
            "forward": jax.jit(error),
            "reverse": jax.jit(jax.value_and_grad(error)),
            "as batches are compiled": jax.jit(jax.value_and_grad(error), compiler_options=programs.BATCHED),
        }
        seconds = medians({name: lambda f=f: f(AT) for name, f in ways.items()})
        told = ", ".join(f"{name} {1e6 * s / steps:.2f}" for name, s in seconds.items())
        say(f"  {steps:5d} periods, {count:3d} trials, microseconds a period: {told}")


if __name__ == "__main__":
    say(machine())
    ratios()
    memory()
    reverse()
