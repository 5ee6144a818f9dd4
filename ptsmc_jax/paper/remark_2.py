"""Simulate Remark 2: chattering, estimation error and settling time for each observer and both sign functions.

Start with `measure`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ptsmc_jax.campaigns import runs
from ptsmc_jax.scenario import from_tables, study

OBSERVERS = ("none", "nonlinear", "finite_time", "prescribed_time")
SIGNS = {"exact": 0.0, "smooth": 1e-3}
SETTLED = 0.2  # an estimate has settled if its error stays below this fraction of the largest disturbance
# Case II with eta = 3 in a sampled loop: 20 Hz, a hand-over 0.5 s before t_f, and a disturbance that is not zero at
# t = 0, when the estimate is still zero.
_TABLES: dict[str, Any] = {
    "controller": {"t_f": 35.0, "delta": 0.5, "initial_estimate_error": 0.01 * 3**0.5},
    "disturbance": {"phase": [np.pi / 2] * 3},
    "loop": {"mode": "sampled", "clock": "flight"},
}


@dataclass(frozen=True)
class Measured:
    """Measurements of a run with one observer and one sign function, sampled at 20 Hz, without noise."""

    observer: str
    sign: str
    chattering: float  # of the torque after t_f [N m/s]
    estimate_settled: float  # when the estimate has settled, NaN if never [s]
    estimate_error: float  # largest |d_hat - d|_2 after t_f [N m]
    settling_time: float  # of the attitude, NaN if never [s]
    window_error: float  # [-]
    peak_torque: float  # [N m]
    t: np.ndarray  # (time,) [s]
    error_history: np.ndarray  # (time,) |d_hat - d|_2 [N m]


def measure() -> list[Measured]:
    """Simulate each observer with the discontinuous and the smooth sign."""
    return [_measure_run(observer, sign) for observer in OBSERVERS for sign in SIGNS]


def _measure_run(observer: str, sign: str) -> Measured:
    table = {"kind": observer, "t_o": 1.0} if observer == "prescribed_time" else {"kind": observer}
    controller = {**_TABLES["controller"], "sign_width": SIGNS[sign]}
    run = runs.simulate(study(from_tables({**_TABLES, "observer": table, "controller": controller})))
    t, error_history = np.asarray(run.log.t), np.linalg.norm(run.log.d_hat - run.log.disturbance, axis=1)
    unsettled = np.flatnonzero(error_history > SETTLED * np.linalg.norm(run.log.disturbance, axis=1).max())
    settled = float("nan") if unsettled[-1] + 1 >= len(error_history) else float(t[unsettled[-1] + 1])
    largest_error = float(error_history[t >= float(run.parts.controller.t_f)].max())
    metrics = {name: run.metrics[name] for name in ("chattering", "settling_time", "window_error", "peak_torque")}
    return Measured(
        observer,
        sign,
        estimate_settled=settled,
        estimate_error=largest_error,
        t=t,
        error_history=error_history,
        **metrics,
    )


def format_table(measured: list[Measured]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return a table as text: a header, and a line for each measurement."""
    head = (
        "observer", "sign", "chattering [N m/s]", f"estimate within {SETTLED:.0%} from [s]",
        "estimation error after t_f [N m]", "attitude settled [s]", "RMS window error", "peak torque [N m]",
    )  # fmt: skip
    lines = [
        (
            run.observer, run.sign, f"{run.chattering:.2e}", _format_time(run.estimate_settled),
            f"{run.estimate_error:.1e}", _format_time(run.settling_time), f"{run.window_error:.1e}",
            f"{run.peak_torque:.3f}",
        )
        for run in measured
    ]  # fmt: skip
    return head, lines


def _format_time(time: float) -> str:
    return "never" if np.isnan(time) else f"{time:.2f}"
