"""Compare the exported C with the simulator: commands of many trials, time of a step, accuracy in single precision.

`python benchmarks/exported_c.py [TRIALS] [FLIGHT ..]`; flights are those of tests/onboard/flights.py, by default six.
For single precision, the compiled C runs in the loop with the simulator's body, sensors and noise. The program compares
RMS window error and mean peak torque of the trials with those of the simulator's own flight software.
"""

import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))


def compared(name: str, count: int) -> None:
    """Print the differences of the commands of these trials, and the time of a step."""
    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import store
    from ptsmc_jax.onboard import folder, vectors
    from ptsmc_jax.onboard.library import Library
    from tests.onboard.compiled import step_many
    from tests.onboard.flights import FLIGHTS

    begin = time.perf_counter()
    made = folder.Controller(scenario.reading.complete(scenario.from_tables(FLIGHTS[name])), "flight", name)
    with tempfile.TemporaryDirectory() as place:
        store.write_folder(Path(place) / "c", lambda making: folder.write_program(making, made))
        generated = time.perf_counter() - begin
        library, single = (Library(Path(place) / "c", real) for real in ("double", "float"))
    trials, ready = jnp.arange(count, dtype=jnp.uint32), made.ready
    simulated = vectors.simulate_many(ready.parts, ready.dispersion, jnp.uint32(0), trials)
    simulated = jax.tree.map(np.asarray, simulated)
    worst, worst_of_peak, used = 0.0, 0.0, 0
    given = np.empty((0, 0))
    at = library.columns["out"].index("command[0]")
    for k in range(count):
        samples = vectors.single_trial(simulated, k)
        if not vectors.is_usable(samples):
            continue
        used += 1
        given, out, _ = vectors.rows(made.board, samples)
        state = vectors.first_state(made.board, samples)
        expected = out[:, at : at + samples.outputs["command"].shape[1]]
        found = np.empty_like(expected)
        for n, row in enumerate(given):
            state, outputs, _ = step_many(library, state, row)
            found[n] = outputs[at : at + expected.shape[1]]
        off = np.linalg.norm(found - expected, axis=1)
        size = np.linalg.norm(expected, axis=1)
        assert np.all(np.isfinite(found)), name
        worst = max(worst, float(np.max(off / np.maximum(size, 1e-300))))
        worst_of_peak = max(worst_of_peak, float(np.max(off) / np.max(size)))
    many = np.repeat(library.initial_state()[None], 100_000, axis=0), np.repeat(given[:1], 100_000, axis=0)
    seconds = []
    for _ in range(7):
        begin = time.perf_counter()
        step_many(library, *many)
        seconds.append((time.perf_counter() - begin) / 100_000)
    print(
        f"| {name} | {used} of {count} | {worst:.1e} | {worst_of_peak:.1e} | {1e6 * np.median(seconds):.2f} us "
        f"| {generated:.1f} s | {single_precision(made.ready, single, count)} |",
        flush=True,
    )


def single_precision(ready: Any, library: Any, count: int) -> str:
    """Return relative errors of single precision (RMS window error, mean peak torque) and numbers of trials."""
    from ptsmc_jax.onboard.library import InTheLoop
    from ptsmc_jax.simulation import rollout

    @partial(jax.jit, static_argnames="software")
    def fly(trials: jax.Array, software: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        def one(trial: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            parts = ready.dispersion.apply(ready.parts, jnp.uint32(0), trial)
            found = rollout.simulate(parts, jnp.uint32(0), trial, software=software)
            return found.status, found.metrics.window_error, found.metrics.peak_torque

        return jax.vmap(one)(trials)

    trials, said = jnp.arange(count, dtype=jnp.uint32), []
    for software in (rollout.PYTHON_SOFTWARE, InTheLoop(library, ready.parts).software):
        status, error, peak = (np.asarray(v) for v in fly(trials, software))
        simulated = np.isin(status, rollout.FINISHED)
        said.append((np.sqrt(np.mean(error[simulated] ** 2)), np.mean(peak[simulated]), int(simulated.sum())))
    (error, peak, simulated), (other, its_peak, its_simulated) = said
    return f"{abs(other / error - 1):.1e}, {abs(its_peak / peak - 1):.1e}, {its_simulated} of {simulated}"


def main() -> None:
    """Print a row for each flight."""
    from ptsmc_jax.configure import configure

    configure(keep_programs=True)
    from tests.onboard.flights import SIX

    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    print("| flight | trials | largest difference of a command, of its own size | of the trial's peak | a step, with "
          "copies of its rows | generation | single precision: RMS error and mean peak off by, trials |")  # fmt: skip
    for name in sys.argv[2:] or SIX:
        compared(name, count)


if __name__ == "__main__":
    main()
