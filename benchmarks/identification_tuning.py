"""Compare gains tuned with the true inertia, with an identified inertia and with an inertia that is 20 % off.

    python benchmarks/identification_tuning.py [scenarios/first_flight.toml]

The scenario's inertia is the true one. A model with moments that are 20 % off controls the true body in one slew. Its
telemetry is the input of `identify`, which starts from this model. Then the gains are tuned with each of the three
models. The law has the inertia of its model, and 1 000 held-out trials have the true body.
"""

import sys
import time
from typing import Any

import numpy as np

from ptsmc_jax.configure import configure

OFF = [0.8, 1.2, 0.8]  # wrong over true principal moment


def main() -> None:
    """Print the identified inertia, and a row for each model."""
    configure()
    from ptsmc_jax import explore, scenario
    from ptsmc_jax.identification import results
    from tuning.search import gains
    from tuning.studies import judging, tuner

    true: Any = scenario.read(sys.argv[1] if len(sys.argv) > 1 else "scenarios/first_flight.toml")
    body = true.spacecraft.inertia
    off = scenario.replace(true, spacecraft__inertia=(np.array(body) * OFF).tolist())
    slew = explore.simulate(scenario.replace(off, spacecraft__true_inertia=body)).to_polars()
    free = scenario.replace(off, identify={"free": ["inertia"], "prior": "none"})
    found = explore.identify(free, slew)
    print(f"{found}\nwhite: {found.fits[0].is_white}", flush=True)
    print("| model | RMS terminal error | RMS window error | largest torque [N m] | complete trials |", flush=True)
    for name, model in (("true", true), ("identified", results.identified_scenario(found)), ("20 % off", off)):
        started = time.monotonic()
        tuned = gains.in_scenario(model, tuner.tune(model, 0, with_checks=False).gains)
        on_body = scenario.replace(tuned, spacecraft__true_inertia=body, dispersion__inertia=None)
        simulated = judging.judge(on_body, judging.derive_held_out_seed(0))
        done, metrics = simulated.finished, simulated.metrics
        rms = [np.sqrt(np.mean(v[done] ** 2)) for v in (metrics.terminal_error, metrics.window_error)]
        print(f"| {name} | {rms[0]:.4g} | {rms[1]:.4g} | {metrics.peak_torque[done].max():.4f} | "
              f"{done.sum()} of {done.size} |", flush=True)  # fmt: skip
        print(f"    {time.monotonic() - started:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
