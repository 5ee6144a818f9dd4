"""How the time of a batch grows with trials, steps and the order of a chain."""

from ptsmc_jax.configure import configure

configure()

import numpy as np  # noqa: E402
from common import machine, medians, say, study  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402


def chain(order: int):
    """Return a sampled chain without noise."""
    return scenario.study(scenario.from_tables({
        "plant": {"kind": "chain", "order": order, "x0": [1.0] + [0.0] * (order - 1)},
        "controller": {"t_f": 35.0, "eta": order + 1.0, "delta": 1.0},
        "loop": {"mode": "sampled", "period": 0.05},
        "dispersion": {"x0": {"kind": "uniform", "half_width": [0.5] + [0.0] * (order - 1)}},
    }))  # fmt: skip


def grow(what: str, sizes: list[int], flights: dict) -> None:
    """Print times, and the exponent between neighbouring rows."""
    seconds = medians(flights)
    say(f"\n{what}")
    for k, (size, name) in enumerate(zip(sizes, flights, strict=True)):
        exponent = ""
        if k:
            before = list(flights)[k - 1]
            exponent = f"exponent {np.log(seconds[name] / seconds[before]) / np.log(size / sizes[k - 1]):.3f}"
        say(f"  {size:7d}  {seconds[name]:8.3f} s  {exponent}")
    whole = np.log(seconds[list(flights)[-1]] / seconds[next(iter(flights))]) / np.log(sizes[-1] / sizes[0])
    say(f"  from the first to the last: exponent {whole:.3f}")


def flight(ready, trials: int):
    """Return a function that simulates this number of trials."""
    return lambda: montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(trials)).metrics


if __name__ == "__main__":
    say(machine())
    noisy = study(True)
    trials = [4096, 16384, 65536, 262144]
    grow("trials, first flight with noise", trials, {str(n): flight(noisy, n) for n in trials})
    periods = [4000, 16000, 64000]
    longer = {n: study(True, loop__period=45.0 / n) for n in periods}
    grow("periods, 4 096 trials", periods, {str(n): flight(longer[n], 4096) for n in periods})
    orders = [2, 3, 4, 5]
    grow("order of a chain, 16 384 trials", orders, {str(n): flight(chain(n), 16384) for n in orders})
