"""Layouts by name."""

from math import acos, degrees, sqrt

import numpy as np
import pytest

from rtkmesh.attitude.presets import BEST_APEX_RAD, PRESETS, preset
from rtkmesh.attitude.rigid_body import Shape
from rtkmesh.errors import OptionError


def test_the_best_angle_is_where_the_normals_variance_is_smallest():
    """(4 - 2 cos) / sin^2 has its minimum, 2 + sqrt(3), there (seed_systems.md 3.2)."""

    def variance(angle: float) -> float:
        return (4.0 - 2.0 * np.cos(angle)) / np.sin(angle) ** 2

    assert degrees(BEST_APEX_RAD) == pytest.approx(74.5, abs=0.05)
    assert variance(BEST_APEX_RAD) == pytest.approx(2.0 + sqrt(3.0))
    assert min(variance(BEST_APEX_RAD + 0.01), variance(BEST_APEX_RAD - 0.01)) > variance(BEST_APEX_RAD)


@pytest.mark.parametrize("name", PRESETS)
def test_layouts_are_as_large_as_they_are_said_to_be(name: str):
    places = preset(name, 2.0).positions_m
    assert places == pytest.approx(2.0 * preset(name, 1.0).positions_m)
    assert preset(name, 1.0).shape is (
        Shape.LINE if name in ("pair", "line") else Shape.SPACE if name in ("cube-corner", "raised") else Shape.PLANE
    )


def test_apexes_are_their_angles():
    for name, angle in (("triangle", 60.0), ("right-angle", 90.0), ("best-angle", degrees(BEST_APEX_RAD))):
        a, b, c = preset(name, 1.0).positions_m
        assert degrees(acos(float((b - a) @ (c - a)))) == pytest.approx(angle)


def test_unknown_layouts_are_told():
    with pytest.raises(OptionError, match="right-angle"):
        preset("rectangle", 1.0)
    with pytest.raises(OptionError, match="larger than 0"):
        preset("square", -1.0)
