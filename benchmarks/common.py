"""Functions of several benchmarks: the study, the C programs, medians of interleaved runs."""

import ctypes
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from ptsmc_jax import scenario
from ptsmc_jax.batching import kernel, lanes
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.scenario import Study
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.clock import Sampled
from ptsmc_jax.simulation.control_period import first_period
from ptsmc_jax.simulation.rollout import Parts

HERE = Path(__file__).parent
SCENARIO = HERE.parent / "scenarios" / "first_flight.toml"
CUBESAT = HERE.parent / "scenarios" / "cubesat.toml"
MOVES = {"broadcast_in_dim", "convert_element_type", "get", "pjit", "jit"}  # equations that compute nothing
C_METRICS = (
    "peak_torque terminal_error terminal_angle window_error hold_error effort settling_time chattering peak_rate "
    "peak_momentum"
).split()
CUBESAT_METRICS = (
    "terminal_error terminal_angle window_error hold_error window_angle hold_angle peak_torque peak_torque_delivered "
    "saturated effort settling_time chattering peak_rate peak_momentum peak_wheel_momentum peak_wheel_torque"
).split()
POINTING_METRICS = [f"{index}_{axis}" for index in catalogues.INDICES for axis in catalogues.AXES]


def study(noise: bool = False, **changes) -> Study:
    """Return the first flight's study, with or without sensor noise."""
    quiet = {} if noise else {"hardware__attitude_noise": None, "hardware__rate_noise": None}
    return scenario.study(scenario.replace(scenario.read(SCENARIO), **quiet, **changes))


def machine() -> str:
    """Return a line that describes this machine."""
    cores = len(os.sched_getaffinity(0))
    name = next((x.split(":")[1].strip() for x in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in x),
                platform.processor())  # fmt: skip
    wide = "AVX-512" if "avx512f" in Path("/proc/cpuinfo").read_text() else "no AVX-512"
    return f"{cores} cores of {name} ({wide}), Python {platform.python_version()}, jax {jax.__version__}, float64"


def medians(
    runs: dict[str, Callable], repeats: int = 7, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the seconds of each run: the median over rounds, without the first. In a round all runs take turns.

    clock: `time.process_time` counts CPU time, of all threads, which other work on the machine disturbs less.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1):
        for name, run in runs.items():
            start = clock()
            jax.block_until_ready(run())
            if turn:
                times[name].append(clock() - start)
    return {name: float(np.median(seconds)) for name, seconds in times.items()}


def steps(parts: Parts) -> int:
    """Return the number of control periods of a run, those of length zero included."""
    assert isinstance(parts.clock, Sampled)
    return parts.clock.count


def step_operations(ready: Study) -> int:
    """Return the smallest number of operations of a control period: the whole-run kernel with its shorter branches."""

    def loops(jaxpr) -> Iterator:
        for eqn in jaxpr.eqns:
            inner = [value for v in eqn.params.values() for value in (v if isinstance(v, tuple | list) else (v,))]
            bodies = [b for b in (getattr(value, "jaxpr", value) for value in inner) if hasattr(b, "eqns")]
            if eqn.primitive.name == "scan" and eqn.params["length"] == steps(ready.parts):
                yield from bodies
            for body in bodies:
                yield from loops(body)

    def count(jaxpr) -> int:
        branches = [eqn.params["branches"] for eqn in jaxpr.eqns if eqn.primitive.name == "cond"]
        mine = sum(eqn.primitive.name not in MOVES for eqn in jaxpr.eqns) - len(branches)
        return mine + sum(min(count(branch.jaxpr) for branch in each) for each in branches)

    def fly(trial):
        return montecarlo.one(ready.parts, ready.dispersion, jnp.uint32(0), trial).metrics

    traced = jax.make_jaxpr(lanes.vmap(fly, kernel=True))(jnp.arange(kernel.BLOCK, dtype=jnp.uint32))
    (body,) = loops(traced.jaxpr)
    return count(body)


def peak_rate(interpret: bool = False, rounds: int = 4096, blocks: int = 16_384) -> float:
    """Return the operations per second of a kernel of multiply-adds, two operations each, in the current precision."""
    chains, unrolled = 8, 16

    def body(given, result):
        x = [given[...] + k for k in range(chains)]

        def step(_, x):
            for _ in range(unrolled):
                x = [v * 0.999 + 0.001 for v in x]
            return x

        result[...] = sum(jax.lax.fori_loop(0, rounds, step, x))

    across = pl.BlockSpec((kernel.BLOCK,), lambda k: (k,))
    x = jnp.ones(blocks * kernel.BLOCK)
    run = jax.jit(pl.pallas_call(body, out_shape=jax.ShapeDtypeStruct(x.shape, x.dtype), grid=(blocks,),
                                 in_specs=[across], out_specs=across, interpret=interpret,
                                 compiler_params=triton.CompilerParams(num_warps=kernel.BLOCK // 32)))  # fmt: skip
    return 2.0 * x.size * chains * unrolled * rounds / medians({"": lambda: run(x)}, repeats=5)[""]


def compiled(source: str, options: list[str]) -> ctypes.CDLL:
    """Return a C source of this folder, compiled with these options."""
    flags = "-O3 -march=native -ffast-math -fopenmp -shared -fPIC".split()
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "loop.so"
        subprocess.run(["gcc", *flags, *options, str(HERE / source), "-o", str(library), "-lm"], check=True)
        return ctypes.CDLL(str(library))


def at(array: np.ndarray) -> ctypes.c_void_p:
    """Return the address of an array, for a C function."""
    return ctypes.c_void_p(array.ctypes.data)


def flat(values: list) -> np.ndarray:
    """Return the numbers of these arrays, one after the other in memory."""
    return np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in values])


@dataclass
class Program:
    """`loop.c`, compiled with these settings."""

    lanes: int = 16
    metrics: bool = True
    full: bool = True

    def __post_init__(self):
        options = [f"-DLANES={self.lanes}", f"-DMETRICS={int(self.metrics)}", f"-DFULL={int(self.full)}"]
        self.library = compiled("loop.c", options if self.lanes > 1 else [*options, "-fno-openmp"])

    def prepare(self, parts: Parts, q0: np.ndarray) -> Callable[[], np.ndarray]:
        """Return a function () -> (trials, columns) that simulates initial attitudes (trials, 4) with these parts."""
        clock, law, d, watch = parts.clock, parts.controller, parts.disturbance, parts.observer
        ticks = clock.ticks(law.t_f, law.delta)
        nodes = np.ascontiguousarray(np.concatenate([ticks.t, ticks.t_next[-1:]]))
        k2 = watch.error_bound()
        target = np.asarray(parts.reference(jnp.zeros(())).q)
        first = jnp.sum(jnp.where(ticks.partial, ticks.t_next - ticks.t, 0.0))
        assert isinstance(clock, Sampled)
        values = [
            parts.plant.inertia, parts.plant.inertia_inverse, target,
            law.t_f, law.eta, law.delta, law.k1, law.sign_width, k2.rate, k2.start, k2.floor,
            d.amplitude, d.frequency, d.phase, clock.period, parts.t_end, parts.window, parts.settling_angle,
            watch.update_matrix(clock.period), watch.update_matrix(first),
        ]  # fmt: skip
        constants = flat(values)
        aligned = np.ascontiguousarray(np.where((q0[:, 3] * target[3] < 0)[:, None], -q0, q0))
        out = np.zeros((len(q0), len(C_METRICS) + 2 if self.metrics else 1))

        def fly() -> np.ndarray:
            self.library.simulate(at(constants), at(nodes), len(nodes) - 1, at(aligned), len(q0), at(out))
            return out

        return fly


@dataclass
class CubesatProgram:
    """`cubesat.c`, compiled with these settings; full: any inertia and wheel axes of the model."""

    pointing: bool = True
    full: bool = True

    def __post_init__(self):
        options = ["-DLANES=16", f"-DPOINTING={int(self.pointing)}", f"-DFULL={int(self.full)}"]
        self.library = compiled("cubesat.c", options)

    def prepare(self, ready: Study, trials: np.ndarray) -> Callable[[], np.ndarray]:
        """Return a function () -> (trials, columns) that simulates these trials of a scenario, seed 0."""
        parts = ready.parts
        clock, law, watch, sensors = parts.clock, parts.controller, parts.observer, parts.sensors
        actuators, d = parts.actuators, parts.disturbance
        assert isinstance(clock, Sampled)
        assert actuators.wheels is not None
        ticks, k2, device = clock.ticks(law.t_f, law.delta), watch.error_bound(), actuators.wheels
        frame = (np.eye(3), 0.0, 1.0)
        if parts.pointing is not None:
            frame = parts.pointing.frame, parts.pointing.after, parts.pointing.window
        first = jnp.sum(jnp.where(ticks.partial, ticks.t_next - ticks.t, 0.0))
        start = first_period(ticks)
        constants = flat([
            law.model.inertia, law.model.inertia_inverse, parts.reference(jnp.zeros(())).q,
            law.t_f, law.eta, law.k1, law.surface_rate, law.sign_width, law.layer_time, k2.rate, k2.start, k2.floor,
            d.amplitude, d.frequency, d.bias, clock.period, parts.t_end, parts.window, parts.settling_angle,
            watch.update_matrix(clock.period), watch.update_matrix(first),
            sensors.attitude_noise, sensors.rate_noise, sensors.bias_rate,
            sensors.filter.attitude_gain, sensors.filter.bias_gain,
            actuators.lag, device.axes, device.allocation, device.torque_limit, device.momentum_limit, *frame,
        ])  # fmt: skip
        rows = np.ascontiguousarray(np.stack([np.asarray(v, float) for v in (*ticks[:5], ticks.partial)], axis=1))

        def begun(trial: jax.Array) -> tuple[jax.Array, jax.Array]:
            drawn = ready.dispersion.apply(parts, np.uint32(0), trial)
            x0 = drawn.aligned_initial
            memory = drawn.sensors.begin(np.uint32(0), trial, x0, start)
            values = [
                x0.q, x0.w, drawn.plant.inertia, drawn.plant.inertia_inverse, drawn.disturbance.phase, memory.bias,
                *memory.estimate,
            ]  # fmt: skip
            keys = jnp.stack([word for key in memory.keys for word in key])
            return jnp.concatenate([jnp.ravel(v) for v in values]), keys

        drawn, keys = (np.ascontiguousarray(v) for v in jax.jit(jax.vmap(begun))(trials.astype(np.uint32)))
        out = np.zeros((len(trials), len(CUBESAT_METRICS) + self.pointing * len(POINTING_METRICS)))

        def simulate() -> np.ndarray:
            self.library.simulate_cubesat(at(constants), at(rows), len(rows), at(drawn), at(keys), len(trials), at(out))
            return out

        return simulate


def row(other: str, theirs: float, ours: float) -> None:
    """Print a row of the table of `speed_table.py`: million trial-steps per second, measured in one run."""
    say(f"| {other} | {theirs:.3g} | {ours:.3g} | {ours / theirs:.3g} |")


def say(text: str) -> None:
    """Print at once."""
    print(text)
    sys.stdout.flush()
