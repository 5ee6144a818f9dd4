"""Numbers as text, without an exponent that they need not have."""

import numpy as np
import pytest

from tuning.output import formats


@pytest.mark.parametrize(
    ("times", "text"),
    [(0.98765, "0.988"), (999.4, "999"), (999.7, "1000"), (1234.4, "1234"), (999_999.7, "1000000"), (1.5e6, "1.5e+06")],
)
def test_ratio_below_a_million_has_no_exponent(times, text):
    assert formats.ratio(times) == text


@pytest.mark.parametrize(
    ("arcsec", "text"),
    [(20.64, "20.6 arcsec"), (-999.4, "-999 arcsec"), (999.7, "1000 arcsec"), (3599.4, "3599 arcsec"), (3601, "1 deg")],
)
def test_angle_has_no_exponent(arcsec, text):
    assert formats.angle(np.deg2rad(arcsec / 3600.0)) == text
