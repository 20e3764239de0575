"""The scalar heading filter and headings from courses: what the rover stack's does wrong is right here."""

from math import degrees, inf, isnan, nan, pi, radians, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.attitude.baseline import Mounting
from rtkmesh.attitude.course import COURSE, CourseOptions, course
from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions, Kind, Outcome, Why
from rtkmesh.attitude.heading_filter import HeadingFilter, filter_of
from rtkmesh.attitude.rotation import wrapped
from rtkmesh.gnss.time import GpsTime

T0 = GpsTime(2400, 100.0)
SIGMA = radians(0.3)


def heading_deg(attitude: HeadingFilter, time: GpsTime) -> float:
    estimate = attitude.predicted(time)
    assert estimate.usable, estimate.why
    return degrees(estimate.angles_rad[0])


def test_options_choose_the_filter() -> None:
    assert isinstance(filter_of(FilterOptions(kind=Kind.HEADING)), HeadingFilter)
    assert isinstance(filter_of(FilterOptions()), AttitudeFilter)


def test_no_heading_is_not_north() -> None:
    """Fault 1."""
    estimate = HeadingFilter(FilterOptions(kind=Kind.HEADING)).predicted(T0)
    assert (estimate.usable, estimate.why) == (False, Why.NOT_ALIGNED)
    assert isnan(estimate.angles_rad[0])


def test_the_case_of_the_rover_stack() -> None:
    """Fault 10: X = 179 deg, measured -179 deg at a steady gain gave 64.5, -7.5, -56, -90, -114 ... deg. The way is 2 deg, not 358."""
    attitude = HeadingFilter(FilterOptions(kind=Kind.HEADING))
    attitude.heading(T0, radians(179.0), radians(1.0))
    for k in range(1, 30):
        assert attitude.heading(T0 + 0.1 * k, radians(-179.0), radians(1.0)).used
        assert 178.9 < heading_deg(attitude, T0 + 0.1 * k) < 181.5
    assert heading_deg(attitude, T0 + 2.9) == pytest.approx(181.0, abs=0.3)


def test_noise_is_per_second_not_per_update() -> None:
    """Fault 10: a prediction in one step or in a hundred, with updates that say nothing, is as unsure."""
    options = FilterOptions(kind=Kind.HEADING, max_heading_sigma_rad=3.0, max_measured_sigma_rad=1e6)
    once, often = HeadingFilter(options), HeadingFilter(options)
    for attitude in (once, often):
        attitude.heading(T0, 1.0, SIGMA)
    for k in range(1, 100):
        often.heading(T0 + 0.01 * k, 1.0, 1e4)
    variances = [attitude.predicted(T0 + 1.0).cov_rad2[2, 2] for attitude in (once, often)]
    # the walk that is learned from updates without news falls; the rate's first uncertainty is most of it
    assert variances[1] == pytest.approx(variances[0], rel=0.1)


def test_prediction_in_closed_form() -> None:
    attitude, dt = HeadingFilter(FilterOptions(kind=Kind.HEADING, rate_walk_radps_rts=0.02, rate_sigma_radps=0.01)), 1.5
    attitude.heading(T0, 1.0, SIGMA)
    expected = SIGMA**2 + 0.01**2 * dt**2 + 0.02**2 * dt**3 / 3.0
    assert attitude.predicted(T0 + dt).cov_rad2[2, 2] == pytest.approx(expected, rel=1e-6)


def test_the_mounting_is_undone() -> None:
    """Fault 9: a lateral baseline of azimuth h + 90 deg."""
    attitude = HeadingFilter(FilterOptions(kind=Kind.HEADING))
    attitude.heading(T0, radians(130.0), SIGMA, Mounting(azimuth_rad=radians(90.0)))
    assert heading_deg(attitude, T0) == pytest.approx(40.0)


def test_yaw_increments_carry_over_a_gap() -> None:
    """An IMU's own yaw, which drifts and has its zero anywhere: 30 deg/s for five seconds without a heading, to half a degree."""
    attitude, rng = HeadingFilter(FilterOptions(kind=Kind.HEADING)), np.random.default_rng(1)
    for k in range(500):
        now, before = T0 + 0.02 * k, T0 + 0.02 * (k - 1)
        if k % 10 == 0 and k <= 250:
            assert attitude.heading(now, radians(30.0) * 0.02 * k + SIGMA * rng.standard_normal(), SIGMA).used
        update = attitude.yaw_increment(before, now, radians(30.6) * 0.02 + 1e-5 * rng.standard_normal(), 1e-5)
        assert update.used or k == 0
    assert degrees(wrapped(attitude.predicted(T0 + 9.98).angles_rad[0] - radians(30.0) * 9.98)) == pytest.approx(0.0, abs=0.7)
    assert attitude.yaw_increment(T0 + 1.0, T0 + 1.0, 0.1, 0.1).why is Why.INVALID
    assert attitude.yaw_increment(T0, GpsTime(2400, nan), 0.1, 0.1).why is Why.INVALID
    assert attitude.yaw_increment(T0 + 9.98, T0 + 9.99, nan, 0.1).why is Why.INVALID


@pytest.mark.parametrize("seed", [1, 2])
def test_sigmas_are_honest(seed: int) -> None:
    """Headings that walk as the model says: NEES 0.9 to 1.1."""
    rng, dt, q = np.random.default_rng(seed), 0.1, 0.2
    attitude, truth, rate = HeadingFilter(FilterOptions(kind=Kind.HEADING, rate_walk_radps_rts=q)), 0.0, 0.0
    squares: list[float] = []
    root = np.linalg.cholesky(q**2 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]))
    for k in range(2500):
        step = root @ rng.standard_normal(2)
        truth, rate = truth + rate * dt + float(step[0]), rate + float(step[1])
        attitude.heading(T0 + dt * k, truth + SIGMA * rng.standard_normal(), SIGMA)
        estimate = attitude.predicted(T0 + dt * k)
        squares.append(wrapped(truth - estimate.angles_rad[0]) ** 2 / float(estimate.cov_rad2[2, 2]))
    assert attitude.resets == 0
    assert 0.9 < float(np.mean(squares[20:])) < 1.1


@given(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0))
def test_a_course_is_the_direction_of_the_velocity(east: float, north: float) -> None:
    found = course(np.array([east, north, 1.0]), 0.01 * np.eye(3), CourseOptions())
    speed = sqrt(east**2 + north**2)
    if speed < 1.0:
        assert found is None
        return
    assert found is not None
    assert found[0] == pytest.approx(np.arctan2(east, north) % (2 * pi), abs=1e-12)
    assert found[1] == pytest.approx(sqrt((0.1 / speed) ** 2 + radians(3.0) ** 2))


@pytest.mark.parametrize(
    ("east_mps", "variance"), [(nan, 0.01), (inf, 0.01), (3.0, nan), (3.0, 100.0), (3.0, -1.0)]
)  # fmt: skip
def test_a_course_that_says_nothing_is_none(east_mps: float, variance: float) -> None:
    assert course(np.array([east_mps, 3.0, 0.0]), np.diag([variance] * 3), CourseOptions()) is None


def test_a_course_starts_a_filter_and_a_heading_overrules_it() -> None:
    """A rover that backs out of its garage: its course is wrong by half a turn, and the antennas say so in five headings."""
    attitude = HeadingFilter(FilterOptions(kind=Kind.HEADING))
    for k in range(5):
        said = course(np.array([0.0, -1.5, 0.0]), 1e-4 * np.eye(3), CourseOptions())
        assert said is not None
        assert attitude.heading(T0 + 0.1 * k, *said, trust=COURSE).used
    outcomes = [attitude.heading(T0 + 0.1 * k, 0.0, SIGMA).outcome for k in range(5, 11)]
    assert outcomes == [Outcome.GATED] * 4 + [Outcome.RESET, Outcome.ACCEPTED]
    for k in range(11, 30):
        assert attitude.heading(T0 + 0.1 * k, pi, radians(3.0), trust=COURSE).outcome is Outcome.GATED
        assert attitude.heading(T0 + 0.1 * k, 0.0, SIGMA).used
    assert attitude.resets == 1
