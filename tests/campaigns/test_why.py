"""Why trials are the worst: their inputs as percentiles of all trials, beside the median one."""

import inspect
from typing import Any

import numpy as np
import polars as pl

from ptsmc_jax.numerics import statistics
from tuning.studies import campaign_summary


class Rows:
    """A campaign of 101 trials, whose torque follows the angle that is drawn."""

    own_names = ()
    trials = 101
    path = "rows"

    def whole_parts(self):
        return [self]


def test_each_input_of_a_worst_trial_is_a_percentile_beside_the_median(monkeypatch):
    angle = np.linspace(0.0, 2.0, 101)
    rate = np.random.default_rng(0).permutation(101) / 100.0
    table = pl.DataFrame({
        "trial": np.arange(101), "status": ["ok"] * 101, "peak_torque": angle**2, "initial_angle": angle,
        "initial_q4": np.cos(angle / 2), "initial_w1": rate, "always": np.ones(101),
    })  # fmt: skip
    monkeypatch.setattr(campaign_summary.pl, "read_parquet_schema", lambda path: dict(table.schema))
    monkeypatch.setattr(campaign_summary.rows, "read", lambda parts, names: table.select(names))
    why: Any = inspect.unwrap(campaign_summary.why)  # which would refuse these rows by their type
    told = why(Rows(), ["peak_torque"], 1)
    assert [one["input"] for one in told] == ["initial_angle", "initial_w1"]  # q4 says what the angle does
    assert told[0] == {"metric": "peak_torque", "trial": 100, "value": 4.0, "input": "initial_angle", "drawn": 2.0,
                       "percentile": 100.0, "median": 1.0}  # fmt: skip
    assert told[1]["percentile"] == 100.0 * np.mean(rate <= rate[100])
    assert statistics.distinct({"a": angle, "b": -angle, "c": rate}) == ["a", "c"]
