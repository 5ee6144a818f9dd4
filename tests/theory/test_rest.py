"""Nominal runs that do not come to rest in hold: their closed form, and what must not be taken for them."""

import json
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.theory import linear, margins, rest
from tests.helpers import short

K, C, H = 0.02, 1.0, 0.05  # bound on the disturbance [1/s^2], slope of the surface [1/s], period [s]
CHAIN = {
    "plant": {"kind": "chain", "order": 2},
    "controller": {"t_f": 4.0, "delta": 0.5, "disturbance_bound": K, "surface_rate": C, "k1": 1.0},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": H, "t_end": 24.0},
}


def swing(**changes):
    return rest.swing(scenario.study(scenario.replace(scenario.from_tables(CHAIN), **changes)).parts)


@pytest.mark.parametrize("k1", short([1.0, 4.0, 8.0], [1.0, 8.0]))
def test_a_sign_that_is_too_narrow_swings_as_its_closed_form_says(k1):
    """From s = a > 0 to -a in a period, a = h K / (2 - h K1), by s+ = s + h (c v + u), u = -c v - K1 s - K sign(s).

    The command swings by 2 (K + K1 a) every second period, but for a share of c h / 2 for what v does within one.
    """
    found = swing(controller__k1=k1, controller__sign_width=1e-7)
    assert found is not None
    a = H * K / (2.0 - H * k1)
    np.testing.assert_allclose(found.size, 2.0 * (K + k1 * a), rtol=C * H)
    assert found.periods == 2.0  # it turns at every sample between the first and the last


@pytest.mark.parametrize("delay", short([1, 3, 8], [8]))
def test_a_slow_swing_is_told_from_peak_to_peak_too(delay):
    """Its commands change from one sample to the next by much less than from one peak to the other."""
    delayed = {"controller__sign_width": 1e-7, "hardware__delay": delay}
    parts = scenario.study(scenario.replace(scenario.from_tables(CHAIN), **delayed)).parts
    seen = rest.history(parts, linear.nominal_jit(parts))
    found = rest.swing(parts, seen)
    assert found is not None
    assert found.periods > 4 * delay
    last = np.asarray(seen.command)[np.flatnonzero(seen.in_hold)][-100:]
    np.testing.assert_allclose(found.size, np.ptp(last), rtol=0.05)


@pytest.mark.parametrize(("share", "swings"), [(0.5, True), (0.9, True), (1.2, False), (50.0, False)])
def test_it_swings_from_the_width_on_at_which_the_layer_is_unstable(share, swings):
    """The pole at 1 - h (K1 + K / width), but for c h, is at -1 where width = h K / (2 - h K1)."""
    border = H * K / (2.0 - H)
    assert (swing(controller__sign_width=share * border) is not None) == swings


def test_what_rings_as_slopes_say_is_none():
    """K1 h = 1.98: s changes its sign in every period and loses 2 % of itself, in a layer wide enough to be linear."""
    assert swing(controller__k1=1.98 / H, controller__sign_width=10.0) is None


def test_an_exact_sign_is_judged_without_it_and_a_short_hold_is_not_judged():
    assert swing(controller__sign_width=0.0) is None
    assert swing(controller__sign_width=1e-7, loop__t_end=4.2, loop__window=0.1) is None


@pytest.mark.parametrize(("whole", "judged"), [(15, False), (16, True)])
def test_a_hold_is_judged_from_sixteen_whole_periods_on(whole, judged):
    """Of a run that swings all along: its history told as if only so many of its last periods were in hold."""
    parts = scenario.study(scenario.replace(scenario.from_tables(CHAIN), controller__sign_width=1e-7)).parts
    seen = rest.history(parts, linear.nominal_jit(parts))
    in_hold = np.flatnonzero(seen.in_hold)
    told = np.isin(np.arange(len(seen.in_hold)), in_hold[-whole:])
    assert (rest.swing(parts, seen._replace(in_hold=told)) is not None) == judged


def test_where_a_run_swings_none_is_left_but_of_loops_that_are_unstable_anyway():
    stable = np.array([[True], [True], [False]])
    values: Any = {name: np.array([[3.0], [3.0], [-3.0]]) for name in margins.Margins._fields} | {"stable": stable}
    left = rest.none_left(margins.Margins(**values), [False, True, True])
    for name, of in left._asdict().items():
        none = {"modulus": 100.0, "stable": False, "crossover": np.nan}.get(name, 0.0)  # as of an unstable loop's peak
        np.testing.assert_array_equal(of, [values[name][0], [none], values[name][2]], err_msg=name)


REFERENCES = {
    "moving": {"reference": {"kind": "sinusoid", "amplitude": [0.3, 0.2, 0.1], "frequency": [0.5, 0.3, 0.2]}},
    "moving fast": {"reference": {"kind": "sinusoid", "amplitude": [0.03, 0.02, 0.01], "frequency": [3.0, 2.0, 2.5]}},
    "quantised": {"hardware": {"torque_step": 2e-2}},  # larger than all that the law commands in hold
}


@pytest.mark.parametrize("kind", short(REFERENCES, ["moving fast", "quantised"]))
def test_a_moving_reference_and_quantisation_are_none(kind):
    tables = {
        "controller": {"t_f": 10.0, "delta": 0.5, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "sign_width": 1e-3},
        "observer": {"gain": [10.0] * 3},
        "disturbance": {"amplitude": [0.01] * 3, "frequency": [0.1] * 3},
        "loop": {"mode": "sampled", "period": 0.05, "t_end": 20.0, "window": 1.0},
        **REFERENCES[kind],
    }
    assert rest.swing(scenario.study(scenario.from_tables(tables)).parts) is None


OWN = """
import jax.numpy as jnp
import ptsmc_jax as ptsmc


class Relay(ptsmc.AccelerationLaw):
    width: float = 1e-6

    def acceleration(self, now, error, error_rate, bound):
        s = error_rate + error
        return -error_rate - s - bound * jnp.tanh(s / self.width), s
"""


def test_a_law_without_a_width_of_its_sign_is_judged_as_others(monkeypatch):
    """As one's own: of commands that turn at every sample, of which slopes explain a tenth or all."""
    turning = np.where(np.arange(40) % 2, 0.5, -0.5)[:, None]
    law: Any = SimpleNamespace(controller=SimpleNamespace())
    run = SimpleNamespace(command=turning)
    monkeypatch.setattr(linear, "nominal_jit", lambda _: run)
    seen = rest.History(jnp.asarray(turning), jnp.ones(40, bool))
    for left, found in ((0.9, rest.Swing(1.0, 2.0)), (0.0, None)):
        monkeypatch.setattr(rest, "_unexplained", lambda *_, left=left: (left * turning, turning))
        assert rest.swing(law, seen) == found


@pytest.mark.long  # above, and of a chain in studies/test_stability.py
def test_an_own_law_that_swings_has_no_margins_left(command, tmp_path):
    (tmp_path / "relay.py").write_text(OWN)
    (tmp_path / "relay.toml").write_text(
        'plant = { kind = "chain", order = 2 }\nobserver = { kind = "none" }\n'
        'controller = { kind = "own", code = "relay.py:Relay", t_f = 8.0, delta = 0.5, disturbance_bound = 0.02 }\n'
        'loop = { mode = "sampled", period = 0.05, t_end = 12.0 }\nrequirements = { gain_margin = 6.0 }\n'
    )
    status, said, _ = command("margins", "relay.toml", "--no-figures")
    assert status == 1
    assert "the nominal run does NOT come to rest in hold" in said
    found = json.loads((tmp_path / "out/margins-relay/summary.json").read_text())
    assert found["worst"]["gain_margin"] == found["worst"]["delay_margin"] == 0.0
    assert not found["stable"]
    status, said, _ = command("simulate", "relay.toml", "--no-figures")
    assert status == 1
    assert "gain_margin" in said
    verdict = json.loads((tmp_path / "out/simulate-relay/summary.json").read_text())["verdicts"]["gain_margin"]
    assert (verdict["met"], verdict["worst"]) == (False, 0.0)
