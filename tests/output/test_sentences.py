"""Numbers in sentences, without an exponent that they need not have, and what they are set beside."""

import numpy as np
import pytest

from tuning.output import law_sentences, pointing_sentences, sentences


@pytest.mark.parametrize(
    ("times", "said"),
    [(0.98765, "0.988"), (999.4, "999"), (999.7, "1000"), (1234.4, "1234"), (999_999.7, "1000000"), (1.5e6, "1.5e+06")],
)
def test_a_ratio_below_a_million_has_no_exponent(times, said):
    assert sentences.ratio(times) == said


@pytest.mark.parametrize(
    ("arcsec", "said"),
    [(20.64, "20.6 arcsec"), (-999.4, "-999 arcsec"), (999.7, "1000 arcsec"), (3599.4, "3599 arcsec"), (3601, "1 deg")],
)
def test_an_angle_has_no_exponent(arcsec, said):
    assert pointing_sentences.angle(np.deg2rad(arcsec / 3600.0)) == said


def test_the_floor_of_several_laws_is_what_none_of_them_can_beat():
    """The least of theirs, which differ a little from run to run; a limit is drawn where it is asked for."""
    laws = [{"floor": floor, "verdicts": []} for floor in (2e-6, 1e-6, None)]
    assert law_sentences._marks(law_sentences.QUESTIONS[0], laws) == {"floor": 1e-6}
    assert law_sentences._marks(law_sentences.QUESTIONS[0], laws[2:]) == {}
    torque = law_sentences.QUESTIONS[1]
    assert law_sentences._marks(torque, laws) == {}
    asked = {"verdicts": [{"metric": "peak_torque", "limit": 0.5}]}
    assert law_sentences._marks(torque, [*laws, asked]) == {"limit": 0.5}
