"""Compare the sampled loop with the same loop written by hand in C.

    python benchmarks/against_c.py [first_flight] [cubesat]

`loop.c` is the first flight without noise: 16 384 trials, and one. `cubesat.c` is the CubeSat with its noise: 4 096
trials, with pointing metrics and without. Each C program must return the library's metrics. Rates of batches are per
second of two cores, from CPU time.
"""

import os
import sys
import time

import jax
import numpy as np

from ptsmc_jax.configure import configure

configure()
os.environ["OMP_WAIT_POLICY"] = "passive"  # idle threads of the C programs must not count as CPU time

from collections.abc import Callable, Sequence  # noqa: E402
from functools import partial  # noqa: E402

from common import (  # noqa: E402
    C_METRICS,
    CUBESAT,
    CUBESAT_METRICS,
    POINTING_METRICS,
    CubesatProgram,
    Program,
    machine,
    medians,
    row,
    say,
    steps,
    study,
)

from ptsmc_jax import scenario  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.programs import BATCHED  # noqa: E402
from ptsmc_jax.simulation import rollout  # noqa: E402

TRIALS = 16384


def check_same(name: str, out: np.ndarray, trials: montecarlo.Trials, metrics: Sequence[str]) -> None:
    """Print how far the metrics of a C program are from the library's; raise AssertionError if it is too far."""
    expected = [np.asarray(getattr(trials.metrics, metric)) for metric in metrics]
    largest = [max(np.nanmax(np.abs(e)), 1e-300) for e in expected]
    off = [np.nanmax(np.abs(out[:, k] - e)) / most for k, (e, most) in enumerate(zip(expected, largest, strict=True))]
    say(f"{name}: metrics differ from the library's by at most {max(off):.1e} of the largest")
    assert max(off) < 1e-9, "not the same loop"


def cpu_medians(runs: dict[str, Callable]) -> dict[str, float]:
    """Return the CPU time of each run over the number of cores [s], medians of 7 rounds by turns."""
    cores = len(jax.local_devices())
    return {name: seconds / cores for name, seconds in medians(runs, clock=time.process_time).items()}


def batch(metrics: bool) -> None:
    """Print rates and ratios of many trials without noise."""
    quiet, noisy = study(), study(noise=True)
    numbers = np.arange(TRIALS)
    simulated = montecarlo.run(quiet.parts, quiet.dispersion, 0, numbers)
    programs = {"C, any inertia": Program(metrics=metrics), "C, principal axes": Program(metrics=metrics, full=False)}
    fly = {name: program.prepare(quiet.parts, simulated.vectors("initial_q")) for name, program in programs.items()}
    if metrics:
        for name, run in fly.items():
            check_same(name, run(), simulated, C_METRICS)

    @partial(jax.jit, static_argnames=("devices",), compiler_options=BATCHED)
    def peaks(parts, dispersion, trials, devices):
        def one(trial):
            return montecarlo.one(parts, dispersion, np.uint32(0), trial)[0].peak_torque

        return montecarlo.map_over_devices(lambda mine: montecarlo.map_in_blocks(one, mine), trials, devices)

    def ours(ready):
        if metrics:
            return lambda: montecarlo.run(ready.parts, ready.dispersion, 0, numbers).metrics
        return lambda: peaks(ready.parts, ready.dispersion, numbers.astype(np.uint32), len(jax.local_devices()))

    runs = {**fly, "ptsmc_jax": ours(quiet), "ptsmc_jax, noise on": ours(noisy)}
    seconds = cpu_medians(runs)
    total = TRIALS * steps(quiet.parts)
    say(f"\n{TRIALS} trials of {steps(quiet.parts)} periods, {'all metrics' if metrics else 'largest torque only'}")
    for name, s in seconds.items():
        say(f"  {name:22s} {total / s / 1e6:7.1f} M trial-steps/s")
    for name in fly:
        row(f"{name}, {'all metrics' if metrics else 'largest torque only'}",
            total / seconds[name] / 1e6, total / seconds["ptsmc_jax"] / 1e6)  # fmt: skip
    say(f"  noise on takes {seconds['ptsmc_jax, noise on'] / seconds['ptsmc_jax']:.2f} times noise off")


def single() -> None:
    """Print the times of one run on one core."""
    quiet = study()
    fly = Program(lanes=1).prepare(quiet.parts, np.asarray(quiet.parts.initial.q)[None])
    run = partial(rollout.simulate_parts, quiet.parts, np.uint32(0), np.uint32(0))
    seconds = medians({"scalar C": fly, "ptsmc_jax": lambda: run().metrics.peak_torque}, 51)
    each = {name: s / steps(quiet.parts) * 1e9 for name, s in seconds.items()}
    say(f"\none run: {each['ptsmc_jax']:.0f} ns a step, scalar C {each['scalar C']:.0f} ns: "
        f"{each['ptsmc_jax'] / each['scalar C']:.2f} times")  # fmt: skip


def cubesat(pointing: bool) -> None:
    """Print rates and ratios of many trials of the CubeSat."""
    scene = scenario.read(CUBESAT)
    if not pointing:
        scene = scenario.replace(scene, pointing=None, requirements__ape_boresight=None)
    ready, numbers = scenario.study(scene), np.arange(TRIALS // 4)
    programs = {
        "CubeSat in C, any inertia": CubesatProgram(pointing=pointing),
        "CubeSat in C, principal axes": CubesatProgram(pointing=pointing, full=False),
    }
    fly = {name: program.prepare(ready, numbers) for name, program in programs.items()}
    trials = montecarlo.run(ready.parts, ready.dispersion, 0, numbers)
    assert trials.ok.all()
    for name, run in fly.items():
        check_same(name, run(), trials, CUBESAT_METRICS + (POINTING_METRICS if pointing else []))
    seconds = cpu_medians(
        {**fly, "ptsmc_jax": lambda: montecarlo.run(ready.parts, ready.dispersion, 0, numbers).metrics}
    )
    total, what = numbers.size * steps(ready.parts), f"pointing metrics {'on' if pointing else 'off'}"
    say(f"\n{numbers.size} trials of {steps(ready.parts)} periods, {what}")
    for name in fly:
        row(f"{name}, {what}", total / seconds[name] / 1e6, total / seconds["ptsmc_jax"] / 1e6)


if __name__ == "__main__":
    say(machine())
    asked = sys.argv[1:] or ["first_flight", "cubesat"]
    for everything in (True, False):
        if "first_flight" in asked:
            batch(everything)
        if "cubesat" in asked:
            cubesat(everything)
    if "first_flight" in asked:
        single()
