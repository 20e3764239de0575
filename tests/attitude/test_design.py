"""Planned layouts: the closed form, the paper's optimal layouts, the smallest faults by simulation."""

from dataclasses import astuple
from math import degrees, inf, isfinite, isinf, isnan, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.attitude.draws import compiled_only

from rtkmesh.attitude.chi_square import chi_square_limit
from rtkmesh.attitude.design import Noise, design, noncentrality_for
from rtkmesh.attitude.integrity import Finding, detection_power, judged, noncentral_tail
from rtkmesh.attitude.protection import Guarding
from rtkmesh.attitude.rigid_body import Layout, Shape, positions

SQUARE = Layout(("a", "b", "c", "d"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]))
TRIANGLE = SQUARE.only(("a", "b", "c"))
CENTRE = np.array([0.5, 0.5, 0.0])


@given(st.integers(3, 7), st.integers(0, 10_000), st.floats(0.002, 0.05), st.floats(0.002, 0.05))
def test_sigmas_of_flat_layouts_have_a_closed_form(n: int, seed: int, horizontal_m: float, vertical_m: float):
    """Heading by the polar moment, roll and pitch by the inverse of the 2x2 moments of inertia."""
    places = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 3)) * [1.0, 1.0, 0.0]
    free = places - places.mean(axis=0)
    moments = free[:, :2].T @ free[:, :2]
    if moments[0, 0] * moments[1, 1] - moments[0, 1] ** 2 < 1e-3 * (moments[0, 0] + moments[1, 1]) ** 2:
        return
    found = design(Layout(tuple("abcdefg"[:n]), places), Noise(horizontal_m, vertical_m), np.zeros(3)).whole
    tilt = vertical_m * np.sqrt(np.diag(np.linalg.inv(moments)))
    assert found.heading_rad == pytest.approx(horizontal_m / sqrt(np.trace(moments)), rel=1e-9)
    assert (found.pitch_rad, found.roll_rad) == pytest.approx(tuple(tilt), rel=1e-9)


def test_the_papers_layouts():
    """A right angle and a square of a metre, 10 mm: 0.81 and 0.573 degrees of tilt, 0.496 and 0.405 of heading."""
    for layout, tilt, heading, redundancy in ((TRIANGLE, 0.810, 0.496, 3), (SQUARE, 0.573, 0.405, 6)):
        found = design(layout, Noise(0.01, 0.01), CENTRE).whole
        assert degrees(found.roll_rad) == pytest.approx(tilt, rel=0.01)
        assert degrees(found.heading_rad) == pytest.approx(heading, rel=0.01)
        assert found.redundancy == redundancy
        assert found.shape is Shape.PLANE


def test_a_lost_antenna_of_two_or_three_is_told():
    """Three become a line, whose turn is not seen; two become a point."""
    found = design(TRIANGLE, Noise(), CENTRE)
    assert {name: s.shape for name, s in found.without.items()} == dict.fromkeys("abc", Shape.LINE)
    assert isnan(found.without["b"].pitch_rad)
    assert not isnan(found.without["b"].roll_rad)
    two = design(SQUARE.only(("a", "b")), Noise(), np.zeros(3))
    assert (two.whole.shape, two.whole.redundancy) == (Shape.LINE, 1)
    assert isnan(two.whole.roll_rad)
    assert not isnan(two.whole.heading_rad)
    assert two.without["a"].shape is Shape.POINT


def test_a_common_error_is_in_the_position_and_not_in_the_attitude():
    """The base's error cancels in attitude and does not average out in position."""
    alone, common = design(SQUARE, Noise(0.01, 0.02), CENTRE).whole, design(SQUARE, Noise(0.01, 0.02, 0.01, 0.02), CENTRE).whole
    assert common.heading_rad == pytest.approx(alone.heading_rad)
    assert common.horizontal_m == pytest.approx(0.01 * sqrt(1.0 + 0.25))
    assert common.vertical_m == pytest.approx(0.02 * sqrt(1.0 + 0.25))


@pytest.mark.parametrize("axis", [0, 1])
def test_the_smallest_faults_are_found_with_the_power_asked_for(axis: int):
    """The exact fit of such a fault is found nine times in ten."""
    found = design(SQUARE, Noise(), CENTRE, false_alarm=0.01, power=0.9).detectable["a"]
    fault = np.zeros((4, 3))
    fault[0, axis] = (found.forward_m, found.right_m)[axis]
    assert detection_power(SQUARE, Noise().cov_m2(4), fault, np.eye(3), 0.01) == pytest.approx(0.9, abs=0.03)
    assert found.down_m > 2.0 * found.forward_m, "heights of a plane are seen by the twist alone"


def test_faults_that_nothing_sees_are_infinite():
    """Three antennas have no twist: a vertical fault tilts the plane, and nothing tells."""
    found = design(TRIANGLE, Noise(), CENTRE).detectable["b"]
    assert isinf(found.down_m)
    assert found.forward_m < 0.2
    across = design(SQUARE.only(("a", "b")), Noise(), CENTRE).detectable["a"]
    assert (across.forward_m < inf, across.right_m, across.down_m) == (True, inf, inf)


@pytest.mark.parametrize("layout", [TRIANGLE, SQUARE])
@pytest.mark.parametrize("axis", [0, 1, 2])
@compiled_only
def test_injected_faults_are_found_as_often_as_designed(layout: Layout, axis: int):
    """Draws of noise with the smallest fault of an antenna; what is said to be found by nothing is found as seldom as no fault."""
    noise, rng, n = Noise(0.005, 0.01), np.random.default_rng(axis), len(layout.names)
    smallest_m = astuple(design(layout, noise, CENTRE, false_alarm=0.01, power=0.8).detectable["b"])[axis]
    cov, places = noise.cov_m2(n), layout.positions_m.copy()
    places[1, axis] += smallest_m if isfinite(smallest_m) else 0.05
    draws = rng.multivariate_normal(places.ravel(), cov, 250).reshape(-1, n, 3)
    found = float(np.mean([judged(layout, positions(draw, cov), np.eye(3), 0.01).finding is not Finding.OK for draw in draws]))
    assert isfinite(smallest_m) is not (layout is TRIANGLE and axis == 2)
    assert 0.72 < found < 0.88 if isfinite(smallest_m) else found < 0.04


def test_levels_say_what_a_layout_bounds():
    """Four bound everything, three their tilts by the level only, two nothing; faults that are rarer than the risk leave the noise."""
    four, three, two = (design(layout, Noise(), CENTRE).levels_rad for layout in (SQUARE, TRIANGLE, SQUARE.only(("a", "b"))))
    assert max(np.degrees(four)) < 12.0 < 28.0 < min(np.degrees(three[1:]))
    assert (two[0], two[1], isnan(two[2])) == (inf, inf, True)
    assert degrees(design(TRIANGLE, Noise(), CENTRE, guarding=Guarding(antenna_fault=0.0)).levels_rad[1]) == pytest.approx(12.0, abs=0.2)


@given(st.floats(1e-6, 0.1), st.floats(0.1, 0.999), st.integers(1, 10))
def test_noncentrality_is_the_inverse_of_the_power(false_alarm: float, power: float, degrees_: int):
    if power <= false_alarm:
        return
    found = noncentrality_for(false_alarm, power, degrees_)
    assert noncentral_tail(chi_square_limit(false_alarm, degrees_), degrees_, found) == pytest.approx(power, abs=1e-6)
