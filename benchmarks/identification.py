"""Accuracy and time of `ptsmc identify` on synthetic logs of a CubeSat: 10 minutes at 10 Hz with three slews.

    python -m benchmarks.identification --logs 200
    python -m benchmarks.identification --logs 20 --rows 601 --spoiled
    python -m benchmarks.identification --logs 1 --rows 36001 --free inertia gyro_scale torque_lag gyro_bias

The logs come from `tests.identification.synthetic`, an independent simulation in NumPy with reaction wheels. The script
prints the RMS error of each number over its Cramer-Rao bound, the coverage of the 95 % intervals, the number of
converged searches, the time, and the largest memory of the process. Starting points are random: moments up to 30 % and
axes up to 17 deg off. It also counts the errors above 3 standard deviations, and the logs whose innovations are not
white. With --spoiled the logs have 1 % gross outliers, and 30 % of the samples of each sensor are missing.
"""

import argparse
import resource
import time

import numpy as np

from ptsmc_jax.configure import configure


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--rows", type=int, default=6001)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--spoiled", action="store_true")
    parser.add_argument("--free", nargs="+", default=["inertia", "gyro_bias"])
    arguments = parser.parse_args()
    configure()
    from ptsmc_jax import scenario
    from ptsmc_jax.identification import estimation, parameters, telemetry
    from tests.identification import synthetic

    rng = np.random.default_rng(arguments.seed)
    inertia = np.array([[0.05, 0.002, -0.001], [0.002, 0.09, 0.003], [-0.001, 0.003, 0.11]])
    slews = max(3, arguments.rows // 2000)  # longer slews would be faster than those of a CubeSat
    frames, _ = synthetic.logs(
        rng, inertia, arguments.logs, rows=arguments.rows, slews=slews, wheels=True, lag=0.05, walk=1e-6
    )
    if arguments.spoiled:
        frames = [synthetic.spoiled(frame, rng) for frame in frames]
    loaded = scenario.from_tables({
        "spacecraft": {"inertia": inertia.tolist()},
        "loop": {"mode": "sampled", "period": 0.1},
        "controller": {"t_f": 60.0},
        "disturbance": {"kind": "none"},
        "hardware": {
            "torque_lag": 0.05, "attitude_noise": 5e-5, "rate_noise": 1.4e-4, "rate_bias": 1e-4, "rate_bias_walk": 1e-6,
        },
        "wheels": {"kind": "axes"},
        "identify": {"free": arguments.free, "prior": "none"},
    })  # fmt: skip
    logs = [telemetry.measurements(loaded, frame, f"log {k}") for k, frame in enumerate(frames)]
    problem = parameters.build(loaded, logs)
    gate = estimation.innovation_gate(loaded.identify.outliers)
    search = estimation.Search(problem, [], gate, lambda text: None)
    zero = np.zeros(problem.size)
    truth = problem.numbers(zero)
    errors, bounds, inside, far, converged, not_white, seconds = [], [], [], [], 0, 0, []
    for k, log in enumerate(logs):
        one = estimation.prepare_log(problem, log)
        search.logs = [one]
        if k == 0:
            begun = time.perf_counter()
            search.derivatives(zero, search.logs)
            search.reject_outliers(zero, one)
            print(f"compiling and a first evaluation: {time.perf_counter() - begun:.1f} s", flush=True)
        begun, processor = time.perf_counter(), time.process_time()
        start = rng.uniform(-1.0, 1.0, problem.size)
        found = search.find_best(start, parameters.commanded_acceleration(problem.model, log), 3)
        seconds.append((time.perf_counter() - begun, time.process_time() - processor))
        good = search.reject_outliers(found.z, one)
        not_white += not estimation.Fit(
            log, one[0], *search.run_filter(found.z, good), acceleration_noise=found.acceleration_noise
        ).is_white
        _, _, information, _ = search.derivatives(zero, [search.reject_outliers(zero, one)])
        at_truth = problem.derivatives(zero)
        bound = np.sqrt(np.diag(at_truth @ np.linalg.inv(information) @ at_truth.T))
        at_estimate = problem.derivatives(found.z)
        std = np.sqrt(np.diag(at_estimate @ estimation.covariance(found.information) @ at_estimate.T))
        error = problem.numbers(found.z) - truth
        converged += found.converged
        errors.append(error / bound)
        bounds.append(bound)
        inside.append(np.abs(error) < 1.96 * std)
        far.append(np.abs(error) > 3.0 * std)
        if k % 5 == 4 or k == len(logs) - 1:
            ratio = np.sqrt(np.mean(np.square(errors), 0))
            elapsed, processor = np.mean(seconds, 0)
            print(f"{k + 1} logs: RMS error / bound {np.round(ratio, 3)}, coverage {np.mean(inside):.3f}", flush=True)
            print(f"  {np.sum(far)} of {np.size(far)} errors above 3 sigma; {not_white} logs not white", flush=True)
            print(f"  {converged} converged; {elapsed:.1f} s each, {processor:.1f} s of processor time", flush=True)
    print(f"bounds of {', '.join(problem.labels)}: {np.mean(bounds, 0)}")
    print(f"largest memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")


if __name__ == "__main__":
    main()
