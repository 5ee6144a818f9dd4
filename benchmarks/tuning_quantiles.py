"""Test on held-out trials whether tuned gains meet quantile requirements: five scenarios, twenty seeds each.

    python benchmarks/tuning_quantiles.py [SEEDS [SCENARIO ...]]

Each run prints a line: whether the search reports every limit as met and confirmed, and how many held-out trials
violate each limit. The last line counts the reported results, and those that held-out trials confirm.
"""

import sys
import time

from ptsmc_jax.configure import configure

SENSED = {"attitude_noise": 3e-5, "rate_noise": 3e-6}
COMMON = {
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 22.0},
    "hardware": SENSED,
    "dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 140.0}},
}
SHOWN = {"quantile": 0.99, "confidence": 0.95}
TUNE = {"trials": 64, "starts": 8}
CUBESAT = {
    "spacecraft": {"inertia": [0.05, 0.08, 0.11]},
    "observer": {"gain": [0.05, 0.05, 0.05]},
    "disturbance": {"kind": "sinusoid", "amplitude": [1e-6, 1e-6, 1e-6]},
}


def law(t_f: float, **more: object) -> dict:
    """Return the table of a controller."""
    return {"controller": {"t_f": t_f, "delta": 0.5, "error": "multiplicative", **more}}


SCENARIOS = {
    "torque, 99 % with 95 %": {**COMMON, **law(20.0), "requirements": {"peak_torque": {"limit": 1.0, **SHOWN}}},
    "error, 99 % with 95 %": {**COMMON, **law(20.0), "requirements": {"window_error": {"limit": 2.5e-5, **SHOWN}}},
    "CubeSat, error and torque": {
        **COMMON, **CUBESAT, **law(20.0, disturbance_rate_bound=1e-6),
        "requirements": {
            "window_error": {"limit": 1.6e-4, **SHOWN}, "peak_torque": {"limit": 0.01, **SHOWN}
        },
    },
    "uniform attitudes, torque 90 %": {
        **COMMON, **law(20.0), "dispersion": {"attitude": {"kind": "uniform"}},
        "requirements": {"peak_torque": {"limit": 3.5, "quantile": 0.9}},
    },
    "inertia and phase, error 95 % with 90 %, every torque": {
        **COMMON, **law(20.0),
        "dispersion": {
            **COMMON["dispersion"], "inertia": {"kind": "relative_normal", "std": 0.05},
            "disturbance_phase": {"kind": "uniform"},
        },
        "requirements": {
            "window_error": {"limit": 3e-5, "quantile": 0.95, "confidence": 0.9}, "peak_torque": 1.2
        },
    },
}  # fmt: skip


def main() -> None:
    """Print a line for each run, and the counts."""
    configure()
    from ptsmc_jax import scenario
    from tuning.studies import tuner

    seeds, names = int(sys.argv[1]) if len(sys.argv) > 1 else 20, sys.argv[2:]
    said = kept = runs = 0
    for name, tables in SCENARIOS.items():
        if names and not any(one in name for one in names):
            continue
        loaded = scenario.from_tables({**tables, "tune": TUNE})
        for seed in range(seeds):
            started = time.monotonic()
            found = tuner.tune(loaded, seed, with_checks=False, tries=1)
            search = found.search
            training = bool((search.worst <= 1.0).all()) and all(one.confirmed for one in search.counts)
            fresh = all(verdict.met for verdict in found.verdicts)
            runs, said, kept = runs + 1, said + training, kept + (training and fresh)
            counts = "; ".join(f"{v.metric} {v.failures} of {v.trials}" for v in found.verdicts)
            words = "met" if training else "not met", "met" if fresh else "NOT met"
            took = f"{search.rounds} rounds, {time.monotonic() - started:.0f} s"
            print(f"{name}, seed {seed}: training {words[0]}, fresh {words[1]} ({counts}), {took}", flush=True)
    print(f"of {runs} runs training called {said} met; {kept} of them are met on fresh trials")


if __name__ == "__main__":
    main()
