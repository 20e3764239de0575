"""The attitude filter: closed forms, every way round, what it must not do (seed_systems.md 2.2), faults of its inputs."""

from dataclasses import replace
from math import cos, degrees, inf, isnan, nan, pi, radians, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.attitude.baseline import Mounting
from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions, Outcome, Trust, Update, Why
from rtkmesh.attitude.innovation import line_of
from rtkmesh.attitude.rigid_body import Fit, Layout, Shape, baselines, fit
from rtkmesh.attitude.rotation import angles_of, rotation_of, rotation_of_angles, vector_of, wrapped
from rtkmesh.errors import OptionError
from rtkmesh.gnss.integrity import Integrity
from rtkmesh.gnss.time import GpsTime

T0 = GpsTime(2400, 604_799.0)  # the week turns over one second later
SIGMA = radians(0.3)
LEVEL = rotation_of_angles(0.0, 0.0, 0.0)
SENSE = 1e-9


def whole(rotation: np.ndarray, sigma_rad: float = SIGMA) -> Fit:
    """A fit of a rigid body that is spanned in space."""
    return Fit(rotation, sigma_rad**2 * np.eye(3), np.full(3, nan), np.zeros((1, 3)), 0.0, 3, Shape.SPACE)


def error_deg(attitude: AttitudeFilter, time: GpsTime, truth: np.ndarray) -> float:
    estimate = attitude.predicted(time)
    assert estimate.ned_from_body is not None, estimate.why
    return degrees(float(np.linalg.norm(vector_of(truth @ estimate.ned_from_body.T))))


def settled(rotation: np.ndarray = LEVEL, options: FilterOptions | None = None, updates: int = 50) -> AttitudeFilter:
    """A filter that has seen a vehicle at rest for some seconds, at 10 Hz, the last time at T0."""
    attitude = AttitudeFilter(options or FilterOptions())
    for k in range(updates):
        assert attitude.rotation(T0 + 0.1 * (k - updates + 1), whole(rotation)).used
    return attitude


def test_before_any_measurement_there_is_no_attitude() -> None:
    """Fault 1: no solution is not north."""
    estimate = AttitudeFilter(FilterOptions()).predicted(T0)
    assert (estimate.usable, estimate.why, estimate.ned_from_body) == (False, Why.NOT_ALIGNED, None)
    assert all(isnan(angle) for angle in estimate.angles_rad)
    assert np.isnan(estimate.angles_cov_rad2).all()


def test_the_first_fit_is_taken_as_it_is() -> None:
    rotation, attitude = rotation_of_angles(6.0, 0.3, -2.0), AttitudeFilter(FilterOptions())
    assert attitude.rotation(T0, whole(rotation)).outcome is Outcome.STARTED
    estimate = attitude.predicted(T0)
    assert estimate.ned_from_body == pytest.approx(rotation, abs=1e-12)
    assert estimate.cov_rad2 == pytest.approx(SIGMA**2 * np.eye(3), rel=1e-3, abs=1e-12)
    assert estimate.angles_rad == pytest.approx((6.0, 0.3, 2.0 * 0.0 - 2.0), abs=1e-12)


def test_two_equal_measurements_at_once_are_half_the_variance() -> None:
    attitude = AttitudeFilter(FilterOptions())
    attitude.rotation(T0, whole(rotation_of_angles(1.0, 0.0, 0.0)))
    attitude.rotation(T0, whole(rotation_of_angles(1.0 + SIGMA, 0.0, 0.0)))
    estimate = attitude.predicted(T0)
    assert estimate.angles_rad[0] == pytest.approx(1.0 + SIGMA / 2.0, abs=1e-9)
    assert estimate.cov_rad2 == pytest.approx(SIGMA**2 / 2.0 * np.eye(3), rel=1e-3, abs=1e-12)


def test_prediction_follows_the_walk_of_the_rate() -> None:
    """Variance of a double integral of white noise: P + (rate variance) dt^2 + q dt^3 / 3."""
    options, dt = FilterOptions(rate_walk_radps_rts=0.05, rate_sigma_radps=0.01), 2.0
    attitude = AttitudeFilter(options)
    attitude.rotation(T0, whole(LEVEL))
    expected = SIGMA**2 + 0.01**2 * dt**2 + 0.05**2 * dt**3 / 3.0
    assert attitude.predicted(T0 + dt).cov_rad2 == pytest.approx(expected * np.eye(3), rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("rate_deg", [170.0, -170.0, 35.0])
def test_headings_cross_north_and_south(rate_deg: float) -> None:
    """A turntable, many times round, at 10 Hz: never gated, never more than the noise away."""
    attitude, rng = AttitudeFilter(FilterOptions(rate_sigma_radps=radians(90.0))), np.random.default_rng(1)
    for k in range(200):
        truth = radians(rate_deg) * 0.1 * k
        update = attitude.heading(T0 + 0.1 * k, (truth + SIGMA * rng.standard_normal()) % (2 * pi), SIGMA)
        assert update.used, (k, update)
        if k > 20:
            assert abs(wrapped(attitude.predicted(T0 + 0.1 * k).angles_rad[0] - truth)) < 5 * SIGMA
    assert attitude.resets == 0


@pytest.mark.parametrize("pitch_deg", [85.0, -85.0, 90.0])
def test_steep_pitches_are_no_singularity(pitch_deg: float) -> None:
    attitude, rng = AttitudeFilter(FilterOptions()), np.random.default_rng(2)
    for k in range(200):
        truth = rotation_of_angles(0.3 * 0.1 * k, radians(pitch_deg) * sin(0.05 * k), 0.2)
        assert attitude.rotation(T0 + 0.1 * k, whole(rotation_of(SIGMA * rng.standard_normal(3)) @ truth)).used
        assert error_deg(attitude, T0 + 0.1 * k, truth) < 2.0
    assert attitude.resets == 0


@given(st.floats(0.0, 6.28), st.floats(-1.4, 1.4), st.floats(-3.1, 3.1), st.floats(0.0, 6.28), st.floats(-0.8, 0.8))
@settings(max_examples=30, deadline=None)
def test_a_mounted_baseline_is_seen_as_it_stands(heading: float, pitch: float, roll: float, azimuth: float, elevation: float) -> None:
    """Fault 9: any mounting, any tilt. A baseline's true azimuth agrees with the true attitude; its jacobian is the finite difference."""
    mounting, truth = Mounting(azimuth, elevation), rotation_of_angles(heading, pitch, roll)
    from rtkmesh.attitude.innovation import Azimuth

    north, east, _ = (truth @ line_of(mounting)).tolist()
    if sqrt(north**2 + east**2) < 0.1:
        return
    said = Azimuth(mounting, np.arctan2(east, north), SIGMA).innovation(truth)
    assert said is not None
    assert abs(float(said.value[0])) < SENSE
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        turned = Azimuth(mounting, np.arctan2(east, north), SIGMA).innovation(rotation_of(-step) @ truth)
        assert turned is not None
        assert float(turned.value[0]) / 1e-6 == pytest.approx(float(said.jacobian[0, axis]), abs=2e-3)


def test_a_lateral_baseline_on_a_slope() -> None:
    """Fault 9: a baseline to the right, raised, on a vehicle that pitches and rolls: the vehicle's heading comes out, not minus that."""
    mounting, truth = Mounting(azimuth_rad=radians(90.0), elevation_rad=radians(10.0)), rotation_of_angles(radians(70.0), 0.2, -0.15)
    attitude = AttitudeFilter(FilterOptions())
    attitude.rotation(T0, whole(truth))
    north, east, down = (truth @ line_of(mounting)).tolist()
    for k in range(1, 30):
        attitude.rotation(T0 + 0.1 * k, whole(truth))
        update = attitude.heading(T0 + 0.1 * k, float(np.arctan2(east, north)), SIGMA, mounting)
        assert update.used
        assert update.chi_square < 1e-9
    cov, elevation = SIGMA**2 * np.eye(2), float(-np.arcsin(down))
    assert attitude.direction(T0 + 2.9, float(np.arctan2(east, north)), elevation, cov, mounting).chi_square < 1e-6
    assert attitude.predicted(T0 + 2.9).angles_rad == pytest.approx((radians(70.0), 0.2, -0.15), abs=1e-6)


def test_a_heading_says_nothing_of_the_tilt() -> None:
    """Fault 12: a heading is one number. Pitch and roll stay where they were, as unsure as without it."""
    truth = rotation_of_angles(2.0, 0.2, 0.1)
    with_heading, without = AttitudeFilter(FilterOptions()), AttitudeFilter(FilterOptions())
    for attitude in (with_heading, without):
        attitude.rotation(T0, whole(truth))
    with_heading.heading(T0 + 0.1, 2.0 + SIGMA, SIGMA)
    ours, other = with_heading.predicted(T0 + 0.1), without.predicted(T0 + 0.1)
    assert ours.angles_rad[1] == pytest.approx(0.2, abs=1e-5)
    assert ours.angles_rad[2] == pytest.approx(0.1, abs=0.3 * SIGMA)  # a heading of a pitched nose is correlated with roll
    assert np.diag(ours.angles_cov_rad2)[1:] == pytest.approx(np.diag(other.angles_cov_rad2)[1:], rel=0.05)
    assert ours.cov_rad2[2, 2] < 0.9 * other.cov_rad2[2, 2]


def test_sigmas_are_the_receivers_own() -> None:
    """Faults 10 and 12: what the receiver says of a heading decides how much it weighs."""
    moved: list[float] = []
    for sigma in (SIGMA, 10.0 * SIGMA):
        attitude = AttitudeFilter(FilterOptions())
        attitude.heading(T0, 1.0, SIGMA)
        attitude.heading(T0, 1.0 + SIGMA, sigma)
        moved.append((attitude.predicted(T0).angles_rad[0] - 1.0) / SIGMA)
    assert moved == pytest.approx([1.0 / 2.0, 1.0 / 101.0], rel=1e-2)


@pytest.mark.parametrize(
    ("options", "trust", "expected"),
    [
        (FilterOptions(), Trust(fixed=False), Why.NOT_FIXED),
        (FilterOptions(accept_float=True), Trust(fixed=False), Why.OK),
        (FilterOptions(), Trust(integrity=Integrity.FAILED), Why.INTEGRITY),
        (FilterOptions(), Trust(integrity=Integrity.UNAVAILABLE), Why.OK),
        (FilterOptions(accept_unchecked=False), Trust(integrity=Integrity.UNAVAILABLE), Why.INTEGRITY),
    ],
)
def test_status_and_integrity_decide(options: FilterOptions, trust: Trust, expected: Why) -> None:
    """Fault 12: floats are not fixes."""
    attitude = settled(options=options, updates=5)
    update = attitude.rotation(T0 + 0.1, whole(LEVEL), trust)
    assert (update.why, update.used) == (expected, expected is Why.OK)


@pytest.mark.parametrize("bad", [nan, inf])
def test_what_is_not_finite_is_refused_and_changes_nothing(bad: float) -> None:
    attitude = settled(updates=5)
    before = attitude.predicted(T0 + 0.2)
    broken = LEVEL.copy()
    broken[0, 1] = bad
    updates = [
        attitude.rotation(T0 + 0.1, whole(broken)),
        attitude.rotation(T0 + 0.1, replace(whole(LEVEL), cov=np.full((3, 3), bad))),
        attitude.rotation(GpsTime(2400, bad), whole(LEVEL)),
        attitude.rotation(T0 + 0.1, replace(whole(LEVEL), shape=Shape.LINE, unseen_ned=np.array([bad, 0.0, 0.0]))),
        attitude.heading(T0 + 0.1, bad, SIGMA),
        attitude.heading(T0 + 0.1, 0.0, bad),
        attitude.heading(T0 + 0.1, 0.0, 0.0),
        attitude.direction(T0 + 0.1, 0.0, bad, np.eye(2)),
        attitude.tilt(T0 + 0.1, np.array([0.0, bad, -9.81]), SIGMA),
        attitude.gyro(T0 + 0.1, np.array([bad, 0.0, 0.0]), 0.01),
        attitude.gyro(T0 + 0.1, np.zeros(3), bad),
        attitude.gyro(GpsTime(2400, bad), np.zeros(3), 0.01),
    ]
    assert {(update.outcome, update.why) for update in updates} == {(Outcome.REFUSED, Why.INVALID)}
    after = attitude.predicted(T0 + 0.2)
    assert (after.ned_from_body == before.ned_from_body, after.cov_rad2 == before.cov_rad2) == (pytest.approx(True), pytest.approx(True))
    assert attitude.predicted(GpsTime(2400, bad)).why is Why.INVALID


def test_a_covariance_that_is_none_is_refused() -> None:
    attitude = settled(updates=5)
    assert attitude.rotation(T0, replace(whole(LEVEL), cov=-np.eye(3))).why is Why.INVALID
    assert attitude.rotation(T0, replace(whole(LEVEL), cov=np.zeros((3, 3)))).why is Why.INVALID
    assert attitude.rotation(T0, whole(LEVEL, radians(30.0))).why is Why.SIGMA


def test_a_baseline_straight_up_has_no_azimuth() -> None:
    attitude = settled(rotation_of_angles(1.0, radians(90.0), 0.0), updates=5)
    assert attitude.heading(T0, 1.0, SIGMA).why is Why.VERTICAL


def test_outliers_are_gated_and_single_ones_never_reset() -> None:
    """One measurement in three is wild (each its own way): all of these are gated, and nothing is lost."""
    attitude, rng = settled(), np.random.default_rng(3)
    for k in range(1, 120):
        wild = k % 3 != 0
        error = rng.uniform(0.2, 3.0) * np.array([0.0, 0.0, 1.0]) if wild else SIGMA * rng.standard_normal(3)
        update = attitude.rotation(T0 + 0.1 * k, whole(rotation_of(error)))
        assert update.outcome is (Outcome.GATED if wild else Outcome.ACCEPTED), (k, update)
        assert error_deg(attitude, T0 + 0.1 * k, LEVEL) < 2.0
    assert attitude.resets == 0


def test_a_row_of_wild_ones_that_disagree_never_resets() -> None:
    attitude = settled()
    for k in range(1, 30):
        assert attitude.rotation(T0 + 0.1 * k, whole(rotation_of(0.5 * np.eye(3)[k % 3]))).outcome is Outcome.GATED
    assert attitude.resets == 0


def test_what_is_persistently_otherwise_resets_and_says_so() -> None:
    """Half a turn from one moment to the next (a wrong fix that goes): four are gated, the fifth is believed, with the jump."""
    attitude, truth = settled(), rotation_of_angles(pi, 0.0, 0.0)
    updates = [attitude.rotation(T0 + 0.1 * k, whole(truth)) for k in range(1, 8)]
    assert [update.outcome for update in updates] == [Outcome.GATED] * 4 + [Outcome.RESET] + [Outcome.ACCEPTED] * 2
    assert degrees(updates[4].jump_rad) == pytest.approx(180.0, abs=0.5)
    assert attitude.resets == 1
    assert error_deg(attitude, T0 + 0.7, truth) < 0.5


def test_a_vehicle_that_already_spins_is_caught() -> None:
    """170 deg/s at the first measurement, where 30 are expected: some are gated, then the filter starts anew at the rate that they show."""
    attitude = AttitudeFilter(FilterOptions())
    truths = [rotation_of_angles(radians(17.0) * k, 0.0, 0.0) for k in range(60)]
    updates = [attitude.rotation(T0 + 0.1 * k, whole(truth)) for k, truth in enumerate(truths)]
    assert attitude.resets == 1
    assert all(update.used for update in updates[6:])
    assert error_deg(attitude, T0 + 5.9, truths[-1]) < 0.5
    assert np.degrees(attitude.predicted(T0 + 5.9).rate_body_radps) == pytest.approx([0.0, 0.0, 170.0], abs=2.0)


def test_a_course_never_overrules() -> None:
    """A vehicle that backs: its course is off by half a turn for as long as it backs."""
    attitude = settled()
    updates = [attitude.heading(T0 + 0.1 * k, pi, radians(3.0), trust=Trust(may_reset=False)) for k in range(1, 40)]
    assert {update.outcome for update in updates} == {Outcome.GATED}
    assert attitude.resets == 0


def test_a_line_of_antennas_leaves_the_rotation_about_it() -> None:
    """Two antennas ahead of each other: heading and pitch become sure, roll stays as level as vehicles are, and does not average down."""
    layout = Layout(("a", "b"), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    truth = rotation_of_angles(radians(200.0), radians(12.0), 0.0)
    seen = fit(layout, baselines(((0, 1),), 2, (truth @ np.array([1.0, 0.0, 0.0]))[None, :], 1e-5 * np.eye(3)))
    assert seen is not None
    assert seen.shape is Shape.LINE
    attitude = AttitudeFilter(FilterOptions())
    for k in range(300):
        assert attitude.rotation(T0 + 0.1 * k, seen).used
    estimate = attitude.predicted(T0 + 29.9)
    heading, pitch, roll = (degrees(sqrt(variance)) for variance in np.diag(estimate.angles_cov_rad2))
    assert estimate.angles_rad[:2] == pytest.approx((radians(200.0), radians(12.0)), abs=1e-3)
    assert max(heading, pitch) < 0.3
    assert roll == pytest.approx(10.0, rel=0.1)


def test_gravity_gives_the_roll_that_a_line_does_not_see() -> None:
    truth = rotation_of_angles(1.0, 0.1, 0.4)
    attitude, force = AttitudeFilter(FilterOptions()), truth.T @ np.array([0.0, 0.0, -9.81])
    assert attitude.tilt(T0, force, SIGMA).why is Why.NOT_ALIGNED
    attitude.heading(T0, 1.0, SIGMA)
    for k in range(1, 40):
        assert attitude.tilt(T0 + 0.1 * k, force, radians(2.0)).used, k
        assert attitude.heading(T0 + 0.1 * k, 1.0, SIGMA).used, k
    assert attitude.predicted(T0 + 3.9).angles_rad == pytest.approx(angles_of(truth), abs=0.01)
    assert attitude.tilt(T0 + 4.0, 1.3 * force, SIGMA).why is Why.ACCELERATED


def test_sensors_that_hang_together_count_for_less() -> None:
    """Errors that stay for a second: ten measurements a second are about as good as one, (1 + rho) / (1 - rho) of the variance."""
    sigmas = [settled(options=FilterOptions(correlation_s=c)).predicted(T0).cov_rad2[2, 2] ** 0.5 for c in (0.0, 1.0)]
    assert sigmas[1] > 2.0 * sigmas[0]


@pytest.mark.parametrize(
    "options",
    [
        {"persistence": 1}, {"stuck_samples": 1}, {"false_alarm": 1.0}, {"rate_walk_radps_rts": 0.0}, {"max_coast_s": nan},
        {"level_sigma_rad": -1.0}, {"bias_sigma_radps": inf},
    ],
)  # fmt: skip
def test_options_out_of_range_are_named(options: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=next(iter(options))):
        FilterOptions(**options)  # type: ignore[arg-type]


def test_an_update_says_whether_it_was_used() -> None:
    assert [Update(outcome).used for outcome in Outcome] == [True, True, True, False, False]


def test_rotations_of_a_mounting_are_unit_vectors() -> None:
    assert line_of(Mounting(radians(30.0), radians(20.0))) == pytest.approx(
        [cos(radians(20.0)) * cos(radians(30.0)), cos(radians(20.0)) * sin(radians(30.0)), -sin(radians(20.0))]
    )
