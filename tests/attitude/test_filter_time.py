"""Attitude filters and time: late inputs, gaps, clocks that jump, gyros that come, stick, jump and go; equal bits."""

from collections.abc import Callable
from math import degrees, nan, radians

import numpy as np
import pytest

from rtkmesh.attitude.filter import AttitudeFilter
from rtkmesh.attitude.filter_options import FilterOptions, Kind, Outcome, Update, Why
from rtkmesh.attitude.heading_filter import HeadingFilter, filter_of
from rtkmesh.attitude.rigid_body import Fit, Shape
from rtkmesh.attitude.rotation import rotation_of, rotation_of_angles, vector_of
from rtkmesh.gnss.time import GpsTime

T0 = GpsTime(2400, 604_798.0)
SIGMA, GYRO_SIGMA = radians(0.3), radians(0.2)
RATE = np.array([0.0, 0.0, radians(90.0)])
AnyFilter = AttitudeFilter | HeadingFilter
KINDS = pytest.mark.parametrize("kind", list(Kind))


def turned(time_s: float, rate: np.ndarray = RATE) -> np.ndarray:
    return rotation_of_angles(0.0, 0.0, 0.0) @ rotation_of(rate * time_s)


def seen(time_s: float, rng: np.random.Generator | None = None, rate: np.ndarray = RATE) -> Fit:
    noise = np.zeros(3) if rng is None else SIGMA * rng.standard_normal(3)
    return Fit(rotation_of(noise) @ turned(time_s, rate), SIGMA**2 * np.eye(3), np.full(3, nan), np.zeros((1, 3)), 0.0, 3, Shape.SPACE)


def error_deg(attitude: AnyFilter, time_s: float, rate: np.ndarray = RATE) -> float:
    estimate = attitude.predicted(T0 + time_s)
    assert estimate.ned_from_body is not None, estimate.why
    return degrees(float(np.linalg.norm(vector_of(turned(time_s, rate) @ estimate.ned_from_body.T))))


def inputs(seconds: float, seed: int = 4) -> list[tuple[float, Callable[[AnyFilter], Update]]]:
    """A turntable at 90 deg/s: a gyro at 50 Hz from the first fix on, fixes at 5 Hz; in the order of their times."""

    def fix(time_s: float) -> Callable[[AnyFilter], Update]:
        taken = seen(time_s, rng)
        return lambda attitude: attitude.rotation(T0 + time_s, taken)

    def sample(time_s: float) -> Callable[[AnyFilter], Update]:
        rate = RATE + GYRO_SIGMA * rng.standard_normal(3)
        return lambda attitude: attitude.gyro(T0 + time_s, rate, GYRO_SIGMA)

    rng, made = np.random.default_rng(seed), list[tuple[float, Callable[[AnyFilter], Update]]]()
    for k in range(round(50 * seconds)):
        if k % 10 == 0:
            made.append((0.02 * k, fix(0.02 * k)))
        made.append((0.02 * k + 0.001, sample(0.02 * k + 0.001)))
    return made


def bits(attitude: AnyFilter, time_s: float) -> bytes:
    estimate = attitude.predicted(T0 + time_s)
    assert estimate.ned_from_body is not None
    return estimate.ned_from_body.tobytes() + estimate.cov_rad2.tobytes() + estimate.rate_body_radps.tobytes()


@KINDS
def test_equal_inputs_give_equal_bits_and_late_ones_the_same(kind: Kind) -> None:
    """Fixes that arrive 0.3 s late, behind fifteen samples of the gyro, end in the very bits of fixes in time."""
    in_time, late = filter_of(FilterOptions(kind=kind)), filter_of(FilterOptions(kind=kind))
    made = inputs(4.0)
    for _, give in made:
        give(in_time)
    order = sorted(range(len(made)), key=lambda i: made[i][0] + (0.3 if i > 0 and round(made[i][0], 4) % 0.2 < 1e-6 else 0.0))
    assert order != list(range(len(made)))
    for i in order:
        assert made[i][1](late).used
    assert bits(late, 4.1) == bits(in_time, 4.1)


@KINDS
def test_a_measurement_stands_at_its_own_time(kind: Kind) -> None:
    """Fault 10: 50 ms at 90 deg/s are 4.5 deg, if a heading is taken for one of now. Ours are of then."""
    attitude, rng = filter_of(FilterOptions(kind=kind)), np.random.default_rng(5)
    for k in range(300):
        attitude.gyro(T0 + 0.02 * k, RATE + GYRO_SIGMA * rng.standard_normal(3), GYRO_SIGMA)
        if k % 5 == 0 and k > 5:
            assert attitude.rotation(T0 + (0.02 * k - 0.05), seen(0.02 * k - 0.05, rng)).used
            assert k < 20 or error_deg(attitude, 0.02 * k) < 1.5
    assert error_deg(attitude, 0.02 * 299) < 0.5


@KINDS
def test_what_is_older_than_the_history_is_refused(kind: Kind) -> None:
    attitude = filter_of(FilterOptions(kind=kind))
    for time_s, give in inputs(3.0):
        assert give(attitude).used or time_s < 0.0
    before = bits(attitude, 3.0)
    assert attitude.rotation(T0 + 0.5, seen(0.5)).why is Why.LATE
    assert attitude.gyro(T0 + 0.5, 2.0 * RATE, GYRO_SIGMA).why is Why.LATE
    assert attitude.predicted(T0 + 0.5).why is Why.LATE
    assert bits(attitude, 3.0) == before
    assert error_deg(attitude, 2.5) < 0.5  # within the history: what was thought then, and since


@KINDS
def test_without_measurements_there_is_soon_no_attitude(kind: Kind) -> None:
    """Fault 11: staleness is seen, with a gyro that goes on for ever, too; and the next fix starts anew and says so."""
    attitude = filter_of(FilterOptions(kind=kind, max_coast_s=3.0, max_heading_sigma_rad=3.0, max_tilt_sigma_rad=3.0))
    for _, give in inputs(2.0):
        give(attitude)
    for k in range(250):
        attitude.gyro(T0 + (2.0 + 0.02 * k), RATE + 1e-4 * (k % 2), GYRO_SIGMA)
    assert attitude.predicted(T0 + 4.7).usable
    estimate = attitude.predicted(T0 + 4.9)
    assert (estimate.usable, estimate.why, estimate.age_s) == (False, Why.GAP, pytest.approx(3.1))
    assert attitude.gyro(T0 + 7.0, RATE, GYRO_SIGMA).why is Why.GAP
    update = attitude.rotation(T0 + 8.0, seen(8.0))
    assert (update.outcome, update.why, attitude.resets) == (Outcome.RESET, Why.GAP, 1)
    assert error_deg(attitude, 8.0) < 0.01


@KINDS
def test_growing_sigmas_end_it_too(kind: Kind) -> None:
    attitude = filter_of(FilterOptions(kind=kind))
    for k in range(30):
        attitude.rotation(T0 + 0.1 * k, seen(0.1 * k))
    assert attitude.predicted(T0 + 9.0).why is Why.SIGMA


@KINDS
def test_a_clock_that_jumps_ahead_and_back_is_survived(kind: Kind) -> None:
    """One measurement of next week: until five in a row say otherwise the filter believes it, and gives no attitude of today."""
    attitude = filter_of(FilterOptions(kind=kind))
    for k in range(20):
        attitude.rotation(T0 + 0.1 * k, seen(0.1 * k))
    assert attitude.rotation(T0 + 604_800.0, seen(0.0)).why is Why.GAP
    assert attitude.predicted(T0 + 2.0).why is Why.LATE
    updates = [attitude.rotation(T0 + 0.1 * k, seen(0.1 * k)) for k in range(20, 30)]
    assert [update.why for update in updates[:5]] == [Why.LATE] * 5
    assert [update.outcome for update in updates[:5]] == [Outcome.REFUSED] * 4 + [Outcome.RESET]
    assert attitude.resets == 2
    assert error_deg(attitude, 2.9) < 1.0


@KINDS
def test_a_stuck_gyro_is_left_out_and_believed_again(kind: Kind) -> None:
    """Fault 11: ten equal samples and it is out; the first other one and it is back. Nothing latches."""
    attitude, rng = filter_of(FilterOptions(kind=kind)), np.random.default_rng(6)
    whys: list[Why] = []
    for k in range(600):
        stuck = 200 <= k < 400
        rate = 0.3 * RATE if stuck else RATE + GYRO_SIGMA * rng.standard_normal(3)
        whys.append(attitude.gyro(T0 + 0.02 * k, rate, GYRO_SIGMA).why)
        if k % 5 == 0:
            attitude.rotation(T0 + 0.02 * k, seen(0.02 * k, rng))
    assert set(whys[:1]) == {Why.NOT_ALIGNED}
    assert set(whys[210:400]) == {Why.STUCK}
    assert whys[:210].count(Why.STUCK) == 1  # the tenth
    assert set(whys[405:]) == {Why.OK}
    assert error_deg(attitude, 12.0 - 0.02) < 0.5


@KINDS
def test_a_bias_that_jumps_is_found_again(kind: Kind) -> None:
    """5 deg/s from one sample to the next: the filter may start anew, says so, and is right again within seconds."""
    attitude, rng, still = filter_of(FilterOptions(kind=kind)), np.random.default_rng(7), np.zeros(3)
    resets = 0
    for k in range(2000):
        bias = radians(5.0) * np.array([0.0, 0.0, 1.0]) * (k >= 1000)
        attitude.gyro(T0 + 0.02 * k, bias + GYRO_SIGMA * rng.standard_normal(3), GYRO_SIGMA)
        if k % 10 == 0:
            resets += attitude.rotation(T0 + 0.02 * k, seen(0.02 * k, rng, still)).outcome is Outcome.RESET
        if k > 1500:
            assert error_deg(attitude, 0.02 * k, still) < 1.5
    assert resets == attitude.resets
    assert abs(degrees(float(attitude.predicted(T0 + 39.98).rate_body_radps[2]))) < 1.0


@KINDS
def test_single_spikes_of_a_gyro_are_gated(kind: Kind) -> None:
    attitude, rng = filter_of(FilterOptions(kind=kind)), np.random.default_rng(8)
    for k in range(400):
        spike = k % 50 == 49
        rate = np.full(3, 30.0) if spike else RATE + GYRO_SIGMA * rng.standard_normal(3)
        if k % 10 == 0:
            attitude.rotation(T0 + 0.02 * k, seen(0.02 * k, rng))
        assert attitude.gyro(T0 + 0.02 * k, rate, GYRO_SIGMA).outcome is (Outcome.GATED if spike else Outcome.ACCEPTED)
    assert error_deg(attitude, 7.98) < 0.5


@KINDS
def test_a_gyro_that_persists_is_right(kind: Kind) -> None:
    """A kick to 20 rad/s: four samples are gated, then the vehicle does turn that fast."""
    attitude, rng = filter_of(FilterOptions(kind=kind)), np.random.default_rng(9)
    outcomes: list[Outcome] = []
    attitude.rotation(T0, seen(0.0, None, np.zeros(3)))
    for k in range(20):
        rate = np.array([0.0, 0.0, 20.0]) if k >= 10 else np.zeros(3)
        outcomes.append(attitude.gyro(T0 + 0.01 * k, rate + GYRO_SIGMA * rng.standard_normal(3), GYRO_SIGMA).outcome)
    assert outcomes == [Outcome.ACCEPTED] * 10 + [Outcome.GATED] * 4 + [Outcome.ACCEPTED] * 6
    assert attitude.predicted(T0 + 0.19).rate_body_radps[2] == pytest.approx(20.0, abs=0.1)


def test_covariances_stay_positive() -> None:
    """Inputs of sigmas from a micro-radian to 20 degrees, gaps between: never an eigenvalue below 0, nothing not finite."""
    attitude, rng, time_s = AttitudeFilter(FilterOptions()), np.random.default_rng(10), 0.0
    for _ in range(2000):
        time_s += float(rng.choice([0.0, 1e-6, 0.01, 0.5], p=[0.2, 0.2, 0.55, 0.05]))
        sigma = float(10.0 ** rng.uniform(-6.0, -0.6))
        which = rng.integers(4)
        if which == 0:
            attitude.rotation(T0 + time_s, Fit(rotation_of(sigma * rng.standard_normal(3)), sigma**2 * np.eye(3), *_rest()))
        elif which == 1:
            attitude.heading(T0 + time_s, sigma * float(rng.standard_normal()), sigma)
        else:
            attitude.gyro(T0 + time_s, sigma * rng.standard_normal(3), sigma)
        estimate = attitude.predicted(T0 + time_s)
        if estimate.ned_from_body is not None:
            assert float(np.linalg.eigvalsh(estimate.cov_rad2)[0]) > 0.0
            assert float(np.linalg.eigvalsh(estimate.rate_cov_radps2)[0]) > 0.0
            assert estimate.ned_from_body @ estimate.ned_from_body.T == pytest.approx(np.eye(3), abs=1e-12)


def _rest() -> tuple[np.ndarray, np.ndarray, float, int, Shape]:
    return np.full(3, nan), np.zeros((1, 3)), 0.0, 3, Shape.SPACE
