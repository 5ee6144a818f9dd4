"""Effect of sampling, noise and an attitude filter with fixed gains, a table of docs/results.md: `make table`."""

import numpy as np
from rich.console import Console
from rich.table import Table

from ptsmc_jax.configure import configure

# eta, delta [s], observer gain [N m s]; the first two are the paper's
GAINS = ((3.0, 0.05, 10.0), (5.0, 0.05, 10.0), (3.0, 0.5, 10.0), (5.0, 0.5, 10.0), (4.0, 1.0, 40.0))
TRIALS = 1000


def main() -> None:
    """Print the table: each row without noise, with noise, and with noise and the filter."""
    configure(keep_programs=True)
    from ptsmc_jax import scenario
    from ptsmc_jax.campaigns import montecarlo
    from tuning.search.gains import in_scenario

    base = scenario.from_tables(
        {
            "controller": {"t_f": 35.0},
            "loop": {"mode": "sampled", "clock": "flight"},
            "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6},
            "dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 140.0}},
        }
    )
    quiet = scenario.replace(base, hardware={"attitude_noise": 0.0, "rate_noise": 0.0})
    filtered = scenario.replace(base, filter={"kind": "steady_state"})
    gains, peaks = ("eta", "delta [s]", "l [N m s]"), ("mean peak, quiet [N m]", "noisy [N m]", "filtered [N m]")
    columns = (*gains, "RMS, quiet", "RMS, noisy", "RMS, filtered", *peaks)
    table = Table(*columns, box=None, pad_edge=False)
    for eta, delta, gain in GAINS:
        rms, peak = [], []
        for case in (quiet, base, filtered):
            ready = scenario.study(in_scenario(case, {"eta": eta, "delta": delta, "observer_gain": gain}))
            trials = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(TRIALS))
            assert np.all(trials.ok)
            rms.append(float(np.sqrt(np.mean(trials.metrics.window_error**2))))
            peak.append(float(np.mean(trials.metrics.peak_torque)))
        table.add_row(*(f"{v:g}" for v in (eta, delta, gain)), *(f"{v:.1e}" for v in rms), *(f"{v:.2f}" for v in peak))
    console = Console(highlight=False, width=130)
    console.print(f"window error and peak torque over {TRIALS} trials, flight clock, t_f = 35 s, period 0.05 s")
    console.print(table)


if __name__ == "__main__":
    main()
