"""The velocity that is published: closed forms, drawn walks and Dopplers, what must not be believed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import hypot, nan, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.pace import (
    EPOCH_PRIOR_DOF,
    GAP_S,
    LAST_M,
    MEMORY,
    PRIOR_DOF,
    REST_CHI2,
    REST_EXPECTED,
    REST_FREEDOM,
    REST_PRIOR_DOF,
    RESTING,
    SIGMA_M,
    SQUARES_M2,
    Pace,
    Told,
    learn_rest,
    learn_walk,
)
from rtkmesh.rtk.walk import WALK_COFACTOR, WALK_FREEDOM, WALK_M, WALK_S, WALK_SQUARES_M2, no_walk

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Motion = Callable[[float], Vector]  # place (m) by time (s)

START = GpsTime(2400, 3600.0)
PHASES, JERK_MPS2 = 12, 3.0
NOISE_M = 0.0015  # of a phase
SHAPE = np.linalg.cholesky(np.array([[0.3, 0.05, 0.1], [0.05, 0.25, -0.1], [0.1, -0.1, 0.9]]))


def standing(_time_s: float) -> Vector:
    return np.zeros(3)


def steady(time_s: float) -> Vector:
    return time_s * np.array([3.0, -4.0, 0.5])


def braking(time_s: float) -> Vector:
    return 12.0 * time_s * np.array([0.6, 0.8, 0.0]) - 0.5 * time_s * time_s * np.array([0.9, 1.2, 0.1])


@dataclass(frozen=True)
class Run:
    """How a motion is seen: steps, noise as a part of NOISE_M, sigma of Dopplers (m/s; 0: there are none), turned by ``turn``.

    ``wander``, as a part of NOISE_M too, is by how much places go astray from epoch to epoch, and do not come back.
    """

    motion: Motion
    step_s: float = 1.0
    noise: float = 1.0
    doppler_mps: float = 0.0
    seed: int = 1
    sense: float = 1.0
    turn: Matrix | None = None
    wander: float = 0.0


def walk_of(step_s: float, led_m: Vector, cofactor: Matrix, noise: float = 1.0) -> Vector:
    """A walk whose phases have residuals of their sigma."""
    walk = no_walk()
    walk[WALK_S], walk[WALK_M : WALK_M + 3], walk[WALK_COFACTOR : WALK_COFACTOR + 9] = step_s, led_m, cofactor.ravel()
    walk[WALK_FREEDOM] = PHASES - 4
    walk[WALK_SQUARES_M2] = (PHASES - 4) * 2.0 * max(noise * NOISE_M, 1e-4) ** 2
    return walk


def true_mps(motion: Motion, time_s: float) -> Vector:
    """Velocity by a central difference."""
    return (motion(time_s + 1e-4) - motion(time_s - 1e-4)) / 2e-4


def told_by(run: Run, epochs: int) -> list[tuple[float, Told]]:
    """Times and what is told at them, with the errors of phases and Dopplers drawn."""
    rng, turn = np.random.default_rng(run.seed), np.eye(3) if run.turn is None else run.turn
    shape, out, before_m, astray_m = turn @ SHAPE, list[tuple[float, Told]](), np.full(3, nan), np.zeros(3)
    residual = hypot(run.noise, run.wander / sqrt(2.0))
    for k in range(epochs):
        time_s = run.sense * k * run.step_s
        if run.wander:
            astray_m += run.wander * NOISE_M * shape @ rng.standard_normal(3)
        place_m = turn @ run.motion(time_s) + astray_m + run.noise * NOISE_M * shape @ rng.standard_normal(3)
        error_mps = run.doppler_mps * shape @ rng.standard_normal(3)
        velocity = turn @ true_mps(run.motion, time_s) + error_mps if run.doppler_mps else np.full(3, nan)
        walk = walk_of(run.step_s, place_m - before_m, shape @ shape.T, residual) if k else no_walk()
        out.append((time_s, Told(walk, velocity, run.doppler_mps**2 * shape @ shape.T)))
        before_m = place_m
    return out


def followed(told: list[tuple[float, Told]], sense: float = 1.0, pace: Pace | None = None) -> list[tuple[Vector, Matrix] | None]:
    """What a pace makes of it."""
    pace = Pace() if pace is None else pace
    return [pace.follow(START + time_s, 0.0, one, JERK_MPS2, sense) for time_s, one in told]


def known(found: tuple[Vector, Matrix] | None) -> tuple[Vector, Matrix]:
    """What must be there."""
    assert found is not None
    return found


def misses(run: Run, epochs: int, first: int) -> Vector:
    """Normalised squared errors from an epoch on."""
    out = list[float]()
    for (time_s, _), one in list(zip(told := told_by(run, epochs), followed(told, run.sense), strict=True))[first:]:
        velocity, cov = known(one)
        error = velocity - true_mps(run.motion, time_s)
        out.append(float(error @ np.linalg.solve(cov, error)) / 3.0)
    return np.array(out)


def sigma_mps(found: tuple[Vector, Matrix] | None) -> float:
    """Sigma in 3D."""
    return float(np.sqrt(np.trace(known(found)[1])))


# --- closed forms ---


@pytest.mark.parametrize("step_s", [0.1, 0.2, 1.0])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_steady_velocity_is_found(step_s: float, sense: float):
    """Without noise to a tenth of a millimetre per second, in both directions of time."""
    last = followed(told_by(Run(steady, step_s, 0.0, sense=sense), 40), sense)[-1]
    assert known(last)[0] == pytest.approx([3.0, -4.0, 0.5], abs=1e-4)


@pytest.mark.parametrize(("step_s", "within_mps"), [(0.1, 0.01), (0.2, 0.02), (1.0, 0.15)])
def test_the_velocity_is_of_the_instant(step_s: float, within_mps: float):
    """Braking by 1.5 m/s2: the mean over the last interval is 0.75 m/s off at 1 Hz. (Accelerations decay in 5 s: a lag of that is left.)"""
    run = Run(braking, step_s, 0.0)
    told = told_by(run, 8)
    for (time_s, _), one in list(zip(told, followed(told), strict=True))[4:]:
        error_mps = float(np.linalg.norm(known(one)[0] - true_mps(run.motion, time_s)))
        assert error_mps < within_mps
        assert error_mps < 2.0 * sigma_mps(one)


def test_residuals_of_phases_tell_their_variance():
    """The epoch's own against what is remembered, then both are remembered."""
    memory = np.zeros(MEMORY)
    memory[SQUARES_M2], memory[SQUARES_M2 + 1] = PRIOR_DOF * SIGMA_M**2, PRIOR_DOF
    walk = walk_of(1.0, np.zeros(3), np.eye(3))
    walk[WALK_SQUARES_M2], walk[WALK_FREEDOM] = 8.0 * 0.02**2, 8.0
    own = learn_walk(memory, walk, 1.0)
    assert own == pytest.approx((EPOCH_PRIOR_DOF * SIGMA_M**2 + 8.0 * 0.02**2) / (EPOCH_PRIOR_DOF + 8.0))
    assert memory[SQUARES_M2] / memory[SQUARES_M2 + 1] == pytest.approx((PRIOR_DOF * SIGMA_M**2 + 8.0 * 0.02**2) / (PRIOR_DOF + 8.0))


def at_rest(last_m: Vector) -> Vector:
    """A memory of a rest that is certain, and of the last walk."""
    memory = np.zeros(MEMORY)
    memory[RESTING], memory[REST_CHI2], memory[REST_FREEDOM] = 1.0, REST_PRIOR_DOF * REST_EXPECTED, REST_PRIOR_DOF
    memory[LAST_M : LAST_M + 3] = last_m
    return memory


def test_two_walks_at_rest_tell_how_good_they_are():
    """Their sum, squared, in units of what phases say; there and back again tells of nothing that lasts."""
    first_m, second_m, cofactor = np.array([0.004, 0.0, 0.001]), np.array([0.002, -0.003, 0.001]), SHAPE @ SHAPE.T
    chi2 = float((first_m + second_m) @ np.linalg.solve(0.002**2 * cofactor, first_m + second_m))
    for second, square in ((second_m, chi2), (-first_m, 0.0)):
        memory = at_rest(first_m)
        factor = learn_rest(memory, walk_of(1.0, second, cofactor), 0.002**2, 1.0)
        assert memory[REST_CHI2] == pytest.approx(REST_PRIOR_DOF * REST_EXPECTED + square)
        assert factor == pytest.approx((REST_PRIOR_DOF * REST_EXPECTED + square) / (REST_EXPECTED * (REST_PRIOR_DOF + 3.0)))
        assert np.array_equal(memory[LAST_M : LAST_M + 3], second)


def test_what_moves_tells_nothing_of_a_rest():
    """And no factor of a rest is its own."""
    memory = at_rest(np.full(3, 5.0))
    memory[REST_CHI2], memory[0], memory[RESTING] = 70.0, 1.0, 0.0
    assert learn_rest(memory, walk_of(1.0, np.full(3, 5.0), SHAPE @ SHAPE.T), 0.002**2, 1.0) == 1.0
    assert memory[REST_CHI2] == 70.0


def test_a_walk_after_none_is_no_pair():
    """An epoch without a walk is between them."""
    memory = at_rest(np.full(3, 0.01))
    learn_rest(memory, no_walk(), 0.0, 1.0)
    assert learn_rest(memory, walk_of(1.0, np.full(3, 0.01), SHAPE @ SHAPE.T), 0.002**2, 1.0) == 1.0
    assert memory[REST_FREEDOM] == REST_PRIOR_DOF


# --- drawn: honest ---


@pytest.mark.parametrize(("noise", "wander"), [(1.0, 0.0), (1.0, 1.0), (0.3, 1.5)])
@pytest.mark.parametrize("step_s", [1.0, 30.0])
def test_what_stands_is_as_sure_as_it_says(step_s: float, noise: float, wander: float):
    """Whether errors of walks cancel in the next one, or last: clocks of satellites, phases that a receiver smooths."""
    squares = np.concatenate([misses(Run(standing, step_s, noise, seed=seed, wander=wander), 150, 60) for seed in range(10)])
    assert 0.5 < squares.mean() < 1.5


def test_what_stands_is_known_to_millimetres_per_second():
    """Within ten seconds at 1 Hz, and to tenths of them where epochs are half a minute apart."""
    assert sigma_mps(followed(told_by(Run(standing), 20))[-1]) < 0.005
    assert sigma_mps(followed(told_by(Run(standing, 30.0), 20))[-1]) < 0.0002


def test_more_epochs_make_no_worse_rest():
    """Half a minute at 5 Hz: that it stands is asked once a second. Asked in every epoch it was taken for a vehicle, at 32 mm/s."""
    assert sigma_mps(followed(told_by(Run(standing, 0.2), 150))[-1]) < 0.012


@pytest.mark.parametrize("doppler_mps", [0.0, 0.05])
@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_a_turning_drive_is_as_sure_as_it_says(step_s: float, doppler_mps: float):
    """15 m/s round a circle of 60 m that goes up and down: 3.8 m/s2 across, changing all the time."""

    def drive(time_s: float) -> Vector:
        angle = 0.25 * time_s
        return np.array([60.0 * np.cos(angle), 60.0 * np.sin(angle), 0.1 * np.sin(0.7 * time_s)])

    squares = np.concatenate([misses(Run(drive, step_s, 1.0, doppler_mps, seed), 80, 10) for seed in range(8)])
    assert 0.2 < squares.mean() < 1.5


@pytest.mark.parametrize("step_s", [0.1, 1.0])
def test_a_start_from_rest_is_not_told_as_rest(step_s: float):
    """After a minute of standing 2 m/s2, and after 5 s steady: errors beyond four sigmas are those of half an interval, of one epoch."""

    def start(time_s: float) -> Vector:
        for_s = min(max(time_s - 60.3, 0.0), 5.0)
        return np.array([1.0, 0.0, 0.0]) * (for_s**2 + 10.0 * max(time_s - 65.3, 0.0))

    run, beyond = Run(start, step_s), 0
    told = told_by(run, round(80.0 / step_s))
    for (time_s, _), one in list(zip(told, followed(told), strict=True))[3:]:
        error_mps = float(np.linalg.norm(known(one)[0] - true_mps(start, time_s)))
        assert error_mps < max(4.0 * sigma_mps(one), 1.1 * step_s)
        beyond += error_mps > 4.0 * sigma_mps(one)
    assert beyond <= 1


def test_dopplers_tell_a_sway_that_no_epoch_shows():
    """3 cm at 1.1 s, seen once a second, is a slow 1.7 cm/s instead of 0.17 m/s: walks count less as Dopplers contradict them."""

    def sway(time_s: float) -> Vector:
        return time_s * np.array([1.0, 0.6, 0.0]) + 0.03 * np.sin(2.0 * np.pi * time_s / 1.1) * np.array([-0.5, 0.85, 0.1])

    squares = np.concatenate([misses(Run(sway, 1.0, 1.0, 0.1, seed), 120, 40) for seed in range(8)])
    assert 0.2 < squares.mean() < 1.5


# --- what must not be believed ---


@pytest.mark.parametrize("motion", [standing, steady])
@pytest.mark.parametrize("slip_m", [0.03, 0.1, 0.25])
def test_a_slip_that_passes_makes_the_velocity_unsure(motion: Motion, slip_m: float):
    """One walk is wrong, though its phases agree with each other: the error is within three sigmas, and gone after four epochs."""
    told = told_by(Run(motion), 50)
    told[40][1].walk[WALK_M] += slip_m
    found = followed(told)
    for k in range(40, 50):
        error_mps = float(np.linalg.norm(known(found[k])[0] - true_mps(motion, told[k][0])))
        assert error_mps < 3.0 * sigma_mps(found[k])
        assert k < 44 or error_mps < 0.015 + 0.2 * slip_m


def test_a_walk_from_another_epoch_is_not_of_this_place():
    """It spans two intervals, but the last epoch had none: the place that it began at is not known any more."""
    told = told_by(Run(steady, noise=0.0), 20)
    lost, double = replace_walk(told[18], no_walk()), told[19][1].walk.copy()
    double[WALK_S], double[WALK_M : WALK_M + 3] = 2.0, 2.0 * double[WALK_M : WALK_M + 3] + 5.0
    with_it, without = ([*told[:18], lost, replace_walk(told[19], walk)] for walk in (double, no_walk()))
    assert np.array_equal(known(followed(with_it)[-1])[0], known(followed(without)[-1])[0])


def replace_walk(told: tuple[float, Told], walk: Vector) -> tuple[float, Told]:
    """The same epoch with another walk."""
    return told[0], told[1]._replace(walk=walk)


def test_without_walks_and_dopplers_a_velocity_is_soon_none():
    """It grows unsure, and after GAP_S is not told; the next walks are a beginning."""
    told = told_by(Run(steady), 40)
    silent = [*told[:20], *(replace_walk(one, no_walk()) for one in told[20:30]), *told[30:]]
    found = followed(silent)
    sigmas = [sigma_mps(found[k]) for k in range(19, 20 + int(GAP_S))]
    assert sigmas == sorted(sigmas)
    assert all(found[k] is None for k in range(20 + int(GAP_S), 30))
    assert known(found[32])[0] == pytest.approx([3.0, -4.0, 0.5], abs=4.0 * sigma_mps(found[32]))


def test_a_gap_of_the_receiver_is_a_beginning_unless_a_walk_spans_it():
    """Epochs of 30 s have walks of 30 s; after 10 s without one the motion is forgotten."""
    slow = followed(told_by(Run(standing, 30.0), 20))
    assert sigma_mps(slow[-1]) < 0.003
    told = told_by(Run(steady, noise=0.0), 22)
    later = replace_walk((told[20][0] + 10.0, told[20][1]), no_walk())
    assert followed([*told[:20], later])[-1] is None


def test_a_clock_that_jumps_moves_no_velocity():
    """A millisecond at 30 m/s would be 3 cm/s."""
    told, pace, clock_s = told_by(Run(lambda t: 30.0 * t * np.array([1.0, 0.0, 0.0]), noise=0.0), 30), Pace(), 0.0
    for k, (time_s, one) in enumerate(told):
        if k == 25:
            clock_s = 1e-3
            one.walk[WALK_M] -= 0.03  # it measures a millisecond earlier
        velocity = known(pace.follow(START + time_s, clock_s, one, JERK_MPS2, 1.0) or (np.zeros(3), np.eye(3)))[0]
        assert k < 20 or velocity[0] == pytest.approx(30.0, abs=2e-3)


def test_what_is_not_finite_is_forgotten():
    """A velocity without end is none, and the next epochs are a beginning."""
    told = told_by(Run(steady, noise=0.0), 30)
    told[20][1].walk[WALK_M] = 1e300
    with np.errstate(all="ignore"):  # without compilation numpy warns
        found = followed(told)
    assert found[20] is None
    assert known(found[29])[0] == pytest.approx([3.0, -4.0, 0.5], abs=1e-3)


# --- invariants ---


def test_turned_axes_are_turned_velocities():
    """No direction is another one."""
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    run = Run(braking, 0.2, 1.0, 0.05)
    for one, other in zip(followed(told_by(run, 40)), followed(told_by(replace(run, turn=turn), 40)), strict=True):
        assert turn @ known(one)[0] == pytest.approx(known(other)[0], abs=1e-7)
        assert turn @ known(one)[1] @ turn.T == pytest.approx(known(other)[1], rel=1e-5, abs=1e-9)


def test_the_same_twice_and_by_a_copy():
    """Bit by bit; the copy goes its own way."""
    told = told_by(Run(braking, 0.2, 1.0, 0.05), 40)
    pace = Pace()
    first = followed(told[:20], pace=pace)
    other = pace.copy()
    again = [*first, *followed(told[20:], pace=pace)]
    for one, two in zip(followed(told), again, strict=True):
        assert np.array_equal(known(one)[0], known(two)[0])
        assert np.array_equal(known(one)[1], known(two)[1])
    for one, two in zip(again[20:], followed(told[20:], pace=other), strict=True):
        assert np.array_equal(known(one)[0], known(two)[0])


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_covariance_is_one(sense: float):
    """Symmetric and positive definite, also where everything fits without noise."""
    for one in followed(told_by(Run(braking, 0.2, 0.0, sense=sense), 60), sense)[1:]:
        cov = known(one)[1]
        assert np.array_equal(cov, cov.T)
        assert np.linalg.eigvalsh(cov)[0] > 0.0
