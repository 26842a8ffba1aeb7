"""Angles as text, compared with astropy."""

import numpy as np
import pytest
from astropy.coordinates import Angle
from hypothesis import given
from hypothesis import strategies as st

from wpdc_gwcs.sexagesimal import read_angles

parts = st.tuples(st.booleans(), st.integers(0, 359), st.integers(0, 59), st.floats(0, 59.9994))


@given(parts, st.sampled_from(["{}:{:02d}:{:06.3f}", "{} {:02d} {:06.3f}"]), st.booleans())
def test_without_unit(angle, form, hours):
    negative, whole, *rest = angle
    text = "-" * negative + form.format(whole % 24 if hours else whole, *rest)
    expected = Angle(text, unit="hourangle" if hours else "deg").deg
    assert read_angles([text], hours=hours)[0] == pytest.approx(expected, rel=1e-14, abs=1e-14)


@pytest.mark.parametrize(
    "text",
    ["12h34m56.7s", "12h 34m 56.7s", "+12h34m", "-1d2m3s", "-0d00m01s", "10d30m", "10d30.5m"]
    + ["1.5h", "188.74d", "-45.5 deg", "41°16'9\"", "-41°16′9.5″", "12H34M56S", ".5d", "\u221210d"],
)
@pytest.mark.parametrize("hours", [True, False])
def test_units_decide(text, hours):
    plain = text.lower().translate(str.maketrans("\u2212°′″'\"", "-dmsms"))
    expected = Angle(plain).deg
    assert read_angles([text], hours=hours)[0] == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    "text",
    ["", "10.5", "nan", "12:60:00", "12:34:60", "12.5:30:00", "1234:00:00", "12:34:56:78", "a:b:c"]
    + ["12h34d", "12m", "5s", "12:34h", "--1:2:3", "1:-2:3", "12:3.5:4", "10x", "12h34m56.7sec x"],
)
def test_other_text_is_no_angle(text):
    assert np.isnan(read_angles([text], hours=True)[0])


def test_many():
    found = read_angles(np.array(["10:30:00", "", "10d30m", "x"]), hours=True)
    np.testing.assert_array_equal(found, [157.5, np.nan, 10.5, np.nan])
    assert read_angles([], hours=True).shape == (0,)
