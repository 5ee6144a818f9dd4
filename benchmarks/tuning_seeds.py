"""Compare twenty seeds of the search with differential evolution on the same problem.

    python benchmarks/tuning_seeds.py scenarios/first_flight.toml [SEEDS | FIRST:END] [FREE,FREE,...]

The training trials are those of seed 0; only the starting points depend on the seed. The gains of every seed are
simulated on 1 000 held-out trials of three seeds, and compared with the lower bound. The best gains are also compared
with the published gains. Names of gains select the free gains; differential evolution is then omitted.
"""

import sys
import time

import numpy as np

from ptsmc_jax.configure import configure


def held_out_trials(loaded, names, values) -> str:
    """Return RMS on held-out trials of three seeds, its ratio to the lower bound, and the largest peak torque."""
    from tuning.search import gains
    from tuning.studies import judging

    made = gains.in_scenario(loaded, dict(zip(names, values.tolist(), strict=True)))
    rms, above, off, peaks = [], [], [], []
    for seed in range(3):
        simulated = judging.judge(made, judging.derive_held_out_seed(seed))
        squares = simulated.metrics.window_error[simulated.finished] ** 2
        rms.append(float(np.sqrt(squares.mean())))
        error = squares.std() / np.sqrt(squares.size) / (2 * rms[-1])  # 1 sigma of the RMS
        bound = judging.rms_lower_bound(made, judging.derive_held_out_seed(seed))
        if bound:
            above.append(rms[-1] / bound)
            off.append((rms[-1] - bound) / error)
        peaks.append(float(simulated.metrics.peak_torque.max()))
    told = f"RMS {', '.join(f'{v:.4g}' for v in rms)}, largest peak torque {max(peaks):.4g}"
    if off:
        told += f"; {min(above):.3f} to {max(above):.3f} times the lower bound, {min(off):.0f} sigma above it at least"
    return told


def main() -> None:
    """Print a line for each seed."""
    configure()
    from ptsmc_jax import scenario
    from tuning.search import gains, global_check, optimise
    from tuning.studies import judging, posing

    path, (first, end) = sys.argv[1], (0, 20)
    if len(sys.argv) > 2:
        *some, last = map(int, sys.argv[2].split(":"))
        first, end = (*some, 0)[0], last
    loaded = scenario.read(path)
    loaded = loaded if loaded.tune is not None else scenario.replace(loaded, tune={})
    if len(sys.argv) > 3:
        loaded = scenario.replace(loaded, tune__free=sys.argv[3].split(","), tune__bounds=None)
    table = loaded.tune
    assert table is not None
    posed = posing.set_up_tuning(loaded, 0)
    ready, problem, evaluate, scenario_gains, found = (
        posed.ready,
        posed.problem,
        posed.evaluate,
        posed.scenario_gains,
        [],
    )
    for seed in range(first, end):
        started, before = time.monotonic(), (evaluate.rollouts, evaluate.gradients)
        settings = optimise.Settings(
            table.starts, table.steps, seed, posed.settings.with_gradients, table.worst_case, judged=False
        )
        one = optimise.search(evaluate, problem, ready.requirements, scenario_gains, settings)
        took = time.monotonic() - started
        simulated, slopes = evaluate.rollouts - before[0], evaluate.gradients - before[1]
        found.append(one)
        gained = ", ".join(f"{gain:.4g}" for gain in one.gains)
        print(f"seed {seed:2}: goal {one.value:.5e}, largest metric/limit {one.worst.max(initial=0.0):.5f}, "
              f"{one.rounds} rounds, {simulated} rollouts, {slopes} gradients, {took:.0f} s, gains {gained}",
              flush=True)  # fmt: skip
        print(f"         fresh: {held_out_trials(loaded, problem.names, one.gains)}", flush=True)
    best = min(found, key=lambda one: one.value if one.worst.max(initial=0.0) <= 1.0 else np.inf)
    started = time.monotonic()
    if len(sys.argv) > 3:
        return
    check = global_check.check(evaluate, best, 1, with_gradients=posed.settings.with_gradients)
    print(f"differential evolution: goal {check.value:.5e}, {check.rollouts} rollouts, "
          f"{time.monotonic() - started:.0f} s, gains {check.gains}")  # fmt: skip
    references = {"differential evolution's": check.value, "the better of both": min(check.value, best.value)}
    for name, reference in references.items():
        near = [one.value <= 1.01 * reference for one in found]
        print(f"within 1 % of {name}: {sum(near)} of {len(near)}; "
              f"largest distance {100 * (max(one.value for one in found) / reference - 1):+.2f} %")  # fmt: skip
    fresh = judging.derive_held_out_seed(0)
    paper = judging.judge(gains.published_scenario(loaded), fresh)
    named = dict(zip(problem.names, best.gains.tolist(), strict=True))
    tuned = judging.judge(gains.in_scenario(loaded, named), fresh)
    rms = [float(np.sqrt(np.mean(one.metrics.window_error[one.finished] ** 2))) for one in (paper, tuned)]
    peak = [float(np.mean(one.metrics.peak_torque[one.finished])) for one in (paper, tuned)]
    bound = judging.rms_lower_bound(gains.in_scenario(loaded, named), fresh) or np.nan
    print(f"on {tuned.status.size} fresh trials: {rms[1]:.4e}, {rms[1] / bound:.3f} times the lower bound; "
          f"{rms[0] / rms[1]:.2f} times the paper's accuracy at {peak[1] / peak[0]:.3f} of its mean peak torque, "
          f"largest {np.max(tuned.metrics.peak_torque[tuned.finished]):.4f} N m")  # fmt: skip


if __name__ == "__main__":
    main()
