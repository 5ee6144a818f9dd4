"""Numbers in sentences: none is told with an exponent that it need not have."""

import numpy as np
import pytest

from tuning.output import pointing_sentences, sentences


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
