"""Dilution of precision against a geometry that has it in closed form."""

from math import isnan, pi, radians, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.models.dilution import dilution


@given(st.floats(0.0, 2.0 * pi), st.integers(3, 8), st.floats(5.0, 60.0))
def test_a_ring_and_the_zenith(turn_rad: float, count: int, elevation_deg: float) -> None:
    """n satellites around at elevation e and one overhead: east and north are 2 / (n cos^2 e); up and clock follow from two unknowns."""
    e, n = radians(elevation_deg), count
    azimuth = np.append(turn_rad + 2.0 * pi * np.arange(n) / n, 0.0)
    found = dilution(azimuth, np.append(np.full(n, e), pi / 2.0))
    horizontal = 2.0 / (n * np.cos(e) ** 2)
    s = np.sin(e)
    determinant = (n * s * s + 1.0) * (n + 1.0) - (n * s + 1.0) ** 2
    up, clock = (n + 1.0) / determinant, (n * s * s + 1.0) / determinant
    assert found.hdop == pytest.approx(sqrt(2.0 * horizontal), rel=1e-6)
    assert found.vdop == pytest.approx(sqrt(up), rel=1e-6)
    assert found.pdop == pytest.approx(sqrt(2.0 * horizontal + up), rel=1e-6)
    assert found.gdop == pytest.approx(sqrt(2.0 * horizontal + up + clock), rel=1e-6)


@pytest.mark.parametrize("azimuth", [[], [0.0, 1.0, 2.0], [0.5] * 6])
def test_a_geometry_that_gives_no_position_has_none(azimuth: list[float]) -> None:
    assert all(isnan(value) for value in dilution(np.array(azimuth), np.full(len(azimuth), 0.5)))
