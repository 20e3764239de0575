"""Heading and tilt of one baseline: closed forms, the paper's figures put right, Monte Carlo."""

from math import cos, degrees, isnan, pi, radians, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.attitude.baseline import Integrity, Mounting, baseline_attitude, direction, length_error_m, length_integrity, yaw_enu

MM2 = 1e-6


def baseline(azimuth_deg: float, elevation_deg: float, length_m: float) -> np.ndarray:
    a, e = radians(azimuth_deg), radians(elevation_deg)
    return length_m * np.array([sin(a) * cos(e), cos(a) * cos(e), sin(e)])


COV = np.array([[4.0, 2.5, -1.0], [2.5, 9.0, 2.0], [-1.0, 2.0, 25.0]]) * MM2


def test_sigmas_of_the_reference_case() -> None:
    """L 0.7 m, azimuth 30, elevation 10 degrees: full formula 0.1460 and 0.4020 degrees, correlation -0.197 (Monte Carlo agrees)."""
    _, _, _, cov = direction(baseline(30, 10, 0.7), COV)
    assert degrees(cov[0, 0] ** 0.5) == pytest.approx(0.1460, abs=5e-5)
    assert degrees(cov[1, 1] ** 0.5) == pytest.approx(0.4020, abs=1e-4)
    assert cov[0, 1] / (cov[0, 0] * cov[1, 1]) ** 0.5 == pytest.approx(-0.197, abs=0.003)


def test_sigmas_agree_with_monte_carlo() -> None:
    truth = baseline(200, -15, 1.2)
    mounting = Mounting(azimuth_rad=radians(70.0))
    draws = np.random.default_rng(3).multivariate_normal(truth, COV, 40_000)
    angles = np.array([[a.heading_rad, a.roll_rad] for a in (baseline_attitude(d, COV, mounting) for d in draws[:8000])])
    expected = baseline_attitude(truth, COV, mounting).cov_rad2[np.ix_([0, 2], [0, 2])]
    assert np.cov(angles.T) == pytest.approx(expected, rel=0.06, abs=0.03 * expected.max())


@given(st.floats(0.0, 359.99), st.floats(-60.0, 60.0), st.floats(0.2, 30.0))
def test_a_baseline_along_the_nose_gives_heading_and_pitch(azimuth_deg: float, elevation_deg: float, length_m: float) -> None:
    attitude = baseline_attitude(baseline(azimuth_deg, elevation_deg, length_m), COV, Mounting())
    assert cos(attitude.heading_rad - radians(azimuth_deg)) == pytest.approx(1.0, abs=1e-12)
    assert attitude.pitch_rad == pytest.approx(radians(elevation_deg), abs=1e-9)
    assert isnan(attitude.roll_rad)
    assert attitude.length_m == pytest.approx(length_m)
    assert 0.0 <= attitude.heading_rad < 2 * pi


@given(st.floats(0.0, 6.28), st.floats(-0.5, 0.5), st.floats(0.0, 6.28))
def test_mounting_is_undone(heading: float, tilt: float, azimuth: float) -> None:
    """A vehicle with only the tilt that its baseline sees: the angles come back exactly."""
    along = abs(cos(azimuth)) >= abs(sin(azimuth))
    pitch, roll = (tilt, 0.0) if along else (0.0, tilt)
    forward, right = cos(azimuth), sin(azimuth)
    north_h = cos(pitch) * forward + sin(pitch) * sin(roll) * right
    east_h, up = cos(roll) * right, sin(pitch) * forward - cos(pitch) * sin(roll) * right
    enu = np.array([sin(heading) * north_h + cos(heading) * east_h, cos(heading) * north_h - sin(heading) * east_h, up])
    attitude = baseline_attitude(enu, COV, Mounting(azimuth_rad=azimuth))
    assert cos(attitude.heading_rad - heading) == pytest.approx(1.0, abs=1e-9)
    assert (attitude.pitch_rad if along else attitude.roll_rad) == pytest.approx(tilt, abs=1e-7)


def test_the_quadrants_are_kept() -> None:
    """The paper's one-argument arctangent turns azimuth 30 into 60 and loses the half circle; ours keeps both."""
    for azimuth in (30.0, 150.0, 210.0, 330.0):
        assert degrees(baseline_attitude(baseline(azimuth, 0.0, 1.0), COV, Mounting()).heading_rad) == pytest.approx(azimuth)
    assert degrees(yaw_enu(radians(30.0))) == pytest.approx(60.0)
    assert degrees(yaw_enu(radians(210.0))) == pytest.approx(-120.0)


def test_length_decides_integrity() -> None:
    mounting = Mounting(length_m=1.0, tolerance_m=0.02)
    right, wrong = (baseline_attitude(baseline(10, 0, length), COV, mounting) for length in (1.01, 1.19))
    assert (length_integrity(right, mounting), length_integrity(wrong, mounting)) == (Integrity.OK, Integrity.FAILED)
    assert length_error_m(wrong, mounting) == pytest.approx(0.19)
    assert isnan(length_error_m(wrong, Mounting()))
    assert length_integrity(wrong, Mounting()) is Integrity.OK


def test_a_vertical_baseline_has_no_heading() -> None:
    attitude = baseline_attitude(np.array([0.0, 0.0, 1.0]), COV, Mounting())
    assert isnan(attitude.heading_rad)
    assert attitude.length_m == 1.0
    assert not np.isfinite(attitude.cov_rad2[0, 0])
