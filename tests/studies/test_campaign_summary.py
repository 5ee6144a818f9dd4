"""Shares of time in what is said of a campaign."""

import numpy as np
import pytest

from tuning.studies import campaign_summary


def test_a_failed_trial_has_no_share_of_time():
    told = campaign_summary._of_share(np.array([0.9, np.nan, 0.5, 0.8]), np.array([True, False, True, True]))
    assert (told["min"], told["max"], told["without_value"]) == (0.5, 0.9, 1)
    assert (told["0.0027"]["value"], told["0.1"]["value"], told["0.5"]["value"]) == (0.0, 0.0, 0.8)
    shares, ended = np.linspace(0.0, 1.0, 200), np.arange(200) % 50 > 0
    told, mirrored = campaign_summary._of_share(shares, ended), campaign_summary._of_metric(1.0 - shares, ended)
    assert told["0.1"]["value"] == pytest.approx(1.0 - mirrored["0.9"]["value"])
    assert told["0.1"]["low"] == pytest.approx(1.0 - mirrored["0.9"]["high"])
    assert told["0.1"]["high"] == pytest.approx(1.0 - mirrored["0.9"]["low"])
    assert told["0.1"]["low"] < told["0.1"]["value"] < told["0.1"]["high"]
    none = campaign_summary._of_share(np.array([np.nan]), np.array([False]))
    assert none["0.5"]["value"] == 0.0
