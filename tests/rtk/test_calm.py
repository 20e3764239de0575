"""The atmosphere as a state nearer than 10 km: from where on, and the place that has nothing of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.frames import enu_from_ecef_at
from rtkmesh.gnss.signals import KEYS_PER_SATELLITE, signal_code
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.ambiguity import condition
from rtkmesh.rtk.asked_odds import ATMOSPHERE_FROM_M
from rtkmesh.rtk.calm import ANTENNAS_M, calmed, is_atmospheric, place_calmly, share_of_states
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import RtkOptions
from rtkmesh.rtk.solution import Solution, Status
from rtkmesh.rtk.state import DYNAMIC, EXCESS_KEY, HISTORY, SLOPE_KEYS, ZENITH_KEY, Filter

KEYS = np.array([ZENITH_KEY, 3, 7, EXCESS_KEY, SLOPE_KEYS[0], 3 * KEYS_PER_SATELLITE + 1, 7 * KEYS_PER_SATELLITE + 1], np.int64)
DYNAMIC_STATES, ATMOSPHERE = np.arange(DYNAMIC), DYNAMIC + np.arange(4)
PAIRS, INTEGERS = np.array([[DYNAMIC + 6, DYNAMIC + 5]]), np.array([2.0])
BASE_ECEF_M = np.array([-3959400.631, 3385704.533, 3667523.111])
L2_M = 299792458.0 / 1227.6e6


def a_filter(seed: int) -> Filter:
    rng, n = np.random.default_rng(seed), DYNAMIC + len(KEYS)
    A, scale = rng.normal(size=(n, n)), np.ones(n)
    scale[ATMOSPHERE] = 0.01  # metres
    return Filter(scale * rng.normal(size=n), np.outer(scale, scale) * (A @ A.T + 0.1 * np.eye(n)), KEYS, np.zeros((len(KEYS), HISTORY)))


@given(st.integers(0, 999), st.floats(-1.0, 1.0))
def test_it_is_the_filter_given_no_atmosphere(seed: int, excess: float) -> None:
    """Mean and covariance of all else are those of the normal distribution under that condition; the slope of GLONASS is none of it."""
    f, known = a_filter(seed), np.array([0.0, 0.0, 0.0, excess])
    others = np.setdiff1d(np.arange(len(f.x)), ATMOSPHERE)
    gain = f.P[np.ix_(others, ATMOSPHERE)] @ np.linalg.inv(f.P[np.ix_(ATMOSPHERE, ATMOSPHERE)])
    calm = calmed(f, excess)
    assert calm.x[others] == pytest.approx(f.x[others] - gain @ (f.x[ATMOSPHERE] - known), abs=1e-9)
    expected = f.P[np.ix_(others, others)] - gain @ f.P[np.ix_(ATMOSPHERE, others)]
    assert calm.P[np.ix_(others, others)] == pytest.approx(expected, abs=1e-9)
    assert calm.x[ATMOSPHERE] == pytest.approx(known, abs=1e-12)


def test_a_filter_without_atmosphere_stays() -> None:
    f = a_filter(5)
    kept = np.concatenate((np.arange(DYNAMIC), DYNAMIC + np.array([4, 5, 6])))
    plain = Filter(f.x[kept], f.P[np.ix_(kept, kept)].copy(), KEYS[4:], f.history[4:])
    calm = calmed(plain, 0.3)
    assert calm.x == pytest.approx(plain.x, abs=1e-12)
    assert np.allclose(calm.P, plain.P, atol=1e-9)


def placed(f: Filter, states=DYNAMIC_STATES) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the place given an integer of what the two ambiguities differ by, its covariance, and the squared norm of the integer."""
    x, P = np.zeros(len(states)), np.zeros((len(states), len(states)))
    norm = condition(f.x, f.P, PAIRS, INTEGERS, 0.0, states, x, P)
    return x, P, norm


@given(st.integers(0, 999), st.floats(0.0, 100.0))
def test_the_place_goes_over_to_the_one_with_an_active_atmosphere(seed: int, activity: float) -> None:
    """Between both, on the line that joins them, by what their distance has beyond antennas and noise; so is the covariance."""
    f = a_filter(seed)
    f.x[ATMOSPHERE] *= activity
    felt_x, felt_P, norm = placed(f)
    calm_x, calm_P, _ = placed(calmed(f, placed(f, ATMOSPHERE[3:])[0][0]))
    x, P = np.zeros(DYNAMIC), np.zeros((DYNAMIC, DYNAMIC))
    assert place_calmly(f, PAIRS, INTEGERS, DYNAMIC_STATES, x, P) == norm
    apart_m2 = float(((felt_x - calm_x)[:3] ** 2).sum())
    variance_m2 = float(np.trace((felt_P - calm_P)[:3, :3]))
    share = max(0.0, 1.0 - (variance_m2 + ANTENNAS_M**2) / apart_m2)
    assert x == pytest.approx(calm_x + share * (felt_x - calm_x), abs=1e-7)
    assert pytest.approx(calm_P + share * (felt_P - calm_P), abs=1e-7) == P


@pytest.mark.parametrize(
    ("apart_m", "sigma_m", "share"), [(0.035, 0.0, 0.0), (0.08, 0.0, 0.75), (0.05, 0.03, 0.0), (0.1, 0.03, 0.75), (0.0, 0.0, 0.0)]
)
def test_what_antennas_and_noise_explain_is_no_atmosphere(apart_m: float, sigma_m: float, share: float) -> None:
    assert ANTENNAS_M == 0.04
    assert share_of_states(apart_m**2, sigma_m**2) == pytest.approx(share, abs=1e-12)


@pytest.mark.parametrize(("length_m", "two", "one"), [(3999.0, False, False), (4001.0, True, False), (10001.0, True, True)])
def test_two_bands_tell_it_sooner(length_m: float, two: bool, one: bool) -> None:
    """From 4 km on where satellites have two bands; of one band from 10 km on."""
    assert ATMOSPHERE_FROM_M == 4000.0
    assert is_atmospheric(length_m, np.repeat(np.arange(6, dtype=np.int16), 2)) is two
    assert is_atmospheric(length_m, np.arange(12, dtype=np.int16)) is one


def solve(rover: list[Epoch], base: list[Epoch], table: EphemerisTable) -> list[Solution]:
    engine = Rtk(RtkOptions(systems="G"))
    return [engine.step(r, b, table, base_position_ecef_m=BASE_ECEF_M) for r, b in zip(rover, base, strict=True)]


def higher_on_second_band(epoch: Epoch, solution: Solution, up_m: float) -> Epoch:
    """Return the epoch as of an antenna whose second phase centre is higher than its first."""
    seen, phase = solution.satellites, epoch.phase_cyc.copy()
    elevation = dict(zip(seen.satellite.tolist(), seen.elevation_rad.tolist(), strict=True))
    for k, (satellite, signal) in enumerate(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)):
        if signal_code(signal).startswith("2") and satellite in elevation:
            phase[k] -= up_m * np.sin(elevation[satellite]) / L2_M
    return replace(epoch, phase_cyc=phase)


def test_phase_centres_of_bands_apart_move_the_place_by_no_more(recording) -> None:
    """Between uncalibrated antennas 5 km apart: a centimetre on the second band would be 15 mm of height without an ionosphere, of both
    bands together it is half of a centimetre.
    """
    rover, base, ephemerides = recording
    table = EphemerisTable()
    for ephemeris in ephemerides:
        table.add(ephemeris)
    plain = solve(rover, base, table)
    other = solve([higher_on_second_band(e, s, 0.01) for e, s in zip(rover, plain, strict=True)], base, table)
    assert plain[-1].status is other[-1].status is Status.FIX
    moved = enu_from_ecef_at(BASE_ECEF_M) @ (other[-1].position_ecef_m - plain[-1].position_ecef_m)
    assert 0.003 < moved[2] < 0.008
