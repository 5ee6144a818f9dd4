"""The sampled loop of 16 384 trials, and of one, against the same loop by hand in C (`loop.c`)."""

import jax
import numpy as np

from ptsmc_jax.configure import configure

configure()

from functools import partial  # noqa: E402

from common import C_METRICS, Program, machine, medians, row, say, steps, study  # noqa: E402

from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.programs import BATCHED  # noqa: E402
from ptsmc_jax.simulation import rollout  # noqa: E402

TRIALS = 16384


def batch(metrics: bool) -> None:
    """Many trials, noise off: rates and ratios."""
    quiet, noisy = study(), study(noise=True)
    numbers = np.arange(TRIALS)
    flown = montecarlo.run(quiet.parts, quiet.dispersion, 0, numbers)
    programs = {"C, any inertia": Program(metrics=metrics), "C, principal axes": Program(metrics=metrics, full=False)}
    fly = {name: program.prepare(quiet.parts, flown.vectors("initial_q")) for name, program in programs.items()}
    if metrics:
        for name, run in fly.items():
            out = run()
            expected = [getattr(flown.metrics, name) for name in C_METRICS]
            off = [np.nanmax(np.abs(out[:, k] - e)) / np.nanmax(np.abs(e)) for k, e in enumerate(expected)]
            say(f"{name}: metrics differ from the library's by at most {max(off):.1e} of the largest")
            assert max(off) < 1e-9, "not the same loop"

    @partial(jax.jit, static_argnames=("devices",), compiler_options=BATCHED)
    def peaks(parts, dispersion, trials, devices):
        def one(trial):
            return montecarlo.one(parts, dispersion, np.uint32(0), trial)[0].peak_torque

        return montecarlo.spread(lambda mine: montecarlo.blocks(one, mine), trials, devices)

    def ours(ready):
        if metrics:
            return lambda: montecarlo.run(ready.parts, ready.dispersion, 0, numbers).metrics
        return lambda: peaks(ready.parts, ready.dispersion, numbers.astype(np.uint32), len(jax.local_devices()))

    runs = {**fly, "ptsmc_jax": ours(quiet), "ptsmc_jax, noise on": ours(noisy)}
    seconds = medians(runs)
    total = TRIALS * steps(quiet.parts)
    say(f"\n{TRIALS} trials of {steps(quiet.parts)} periods, {'all metrics' if metrics else 'largest torque only'}")
    for name, s in seconds.items():
        say(f"  {name:22s} {total / s / 1e6:7.1f} M trial-steps/s")
    for name in fly:
        row(f"{name}, {'all metrics' if metrics else 'largest torque only'}",
            total / seconds[name] / 1e6, total / seconds["ptsmc_jax"] / 1e6)  # fmt: skip
    say(f"  noise on takes {seconds['ptsmc_jax, noise on'] / seconds['ptsmc_jax']:.2f} times noise off")


def single() -> None:
    """One run, on one core."""
    quiet = study()
    fly = Program(lanes=1).prepare(quiet.parts, np.asarray(quiet.parts.initial.q)[None])
    run = partial(rollout.simulate_jit, quiet.parts, np.uint32(0), np.uint32(0))
    seconds = medians({"scalar C": fly, "ptsmc_jax": lambda: run().metrics.peak_torque}, 51)
    each = {name: s / steps(quiet.parts) * 1e9 for name, s in seconds.items()}
    say(f"\none run: {each['ptsmc_jax']:.0f} ns a step, scalar C {each['scalar C']:.0f} ns: "
        f"{each['ptsmc_jax'] / each['scalar C']:.2f} times")  # fmt: skip


if __name__ == "__main__":
    say(machine())
    for everything in (True, False):
        batch(everything)
    single()
