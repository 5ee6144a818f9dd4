"""Compare gains tuned for the rigid body and gains tuned with flexible modes, on the flexible body.

    python benchmarks/flexible_tuning.py [scenarios/flexible_panels.toml] [TRIALS STARTS]

Both searches meet the scenario's requirements; the margins of the first search belong to the rigid loop. Then 1 000
held-out trials of the flexible body are simulated with each set of gains and with the scenario's gains.
"""

import sys
import time

import numpy as np

from ptsmc_jax.configure import configure


def main() -> None:
    """Print a row for each set of gains."""
    configure()
    from ptsmc_jax import scenario
    from tuning.search import gains
    from tuning.studies import judging, stability, tuner

    path = sys.argv[1] if len(sys.argv) > 1 else "scenarios/flexible_panels.toml"
    loaded = scenario.read(path)
    loaded = loaded if loaded.tune is not None else scenario.replace(loaded, tune={})
    if len(sys.argv) > 3:
        loaded = scenario.replace(loaded, tune__trials=int(sys.argv[2]), tune__starts=int(sys.argv[3]))
    quiet = [name for name in loaded.requirements if "modal" in name]
    rigid = scenario.replace(loaded, flexible=None, **{f"requirements__{name}": None for name in quiet})
    found = {"the scenario's": {}}
    for name, one in (("tuned rigid", rigid), ("tuned flexible", loaded)):
        started = time.monotonic()
        found[name] = tuner.tune(one, 0, with_checks=False).gains
        said = ", ".join(f"{key} {value:.4g}" for key, value in found[name].items())
        print(f"{name} ({time.monotonic() - started:.0f} s): {said}", flush=True)
    for name, chosen in found.items():
        made = gains.in_scenario(loaded, chosen) if chosen else loaded
        simulated = judging.judge(made, judging.derive_held_out_seed(0))
        done, metrics = simulated.finished, simulated.metrics
        print(
            f"{name} on the flexible body: {done.sum()} of {done.size} runs complete, "
            f"RMS window error {np.sqrt(np.mean(metrics.window_error[done] ** 2)):.3e}, "
            f"largest peak torque {metrics.peak_torque[done].max():.3f} N m, "
            f"largest residual_modal {metrics.residual_modal[done].max():.3e}"
        )
        for truth, body in (("flexible", made), ("rigid", scenario.replace(made, flexible=None))):
            for where, margins in (stability.worst_margins(scenario.study(body)) or {}).items():
                print(
                    f"    {truth} loop, {where}: "
                    + ", ".join(f"{k} {v:.3g}" for k, v in margins.items() if v is not None)
                )


if __name__ == "__main__":
    main()
