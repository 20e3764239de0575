"""What codes say, epoch after epoch: closed forms, and DGPS by simulated receivers at 1 and 5 Hz."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.rtk.simulated_session import solutions

from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.code_arcs import ALONE_S, CARRIED_S, inflation_of, new_codes, since_seen
from rtkmesh.rtk.matching import Pairs
from rtkmesh.rtk.options import Mode, RtkOptions
from rtkmesh.rtk.solution import Status
from rtkmesh.simulation.scenario import truth


def pairs(*names: str) -> Pairs:
    """Return pairs of the same code on both sides, named like ``G05 1C``."""
    satellite = np.array([satellite_number(name[:3]) for name in names], np.int16)
    signal = np.array([signal_number(name[4:]) for name in names], np.int64)
    rows = np.arange(len(names))
    return Pairs(satellite, rows, rows, np.zeros_like(rows), np.zeros_like(rows), 1, (satellite * 512 + signal) * 512 + signal)


@given(rate_hz=st.sampled_from([1.0, 5.0, 10.0, 20.0]), carried=st.booleans())
def test_a_minute_of_codes_says_the_same_at_every_rate(rate_hz: float, carried: bool):
    """The first epoch counts once, and those of a minute together as 60 s / (2 tau) epochs."""
    weights = [1.0 / inflation_of(1.0 / rate_hz, carried)] * round(60.0 * rate_hz)
    assert sum(weights) == pytest.approx(60.0 / (2.0 * (CARRIED_S if carried else ALONE_S)))
    assert inflation_of(np.inf, carried) == 1.0


def test_each_code_has_an_arc_of_its_own():
    """By satellite and band; a code that was away for longer than its memory is new, and one that is not there is not noted."""
    seen = new_codes()
    both, other = pairs("G05 1C", "G05 2X"), pairs("G05 1W", "E11 1X")
    assert since_seen(seen, both, np.array([True, False]), 10.0).tolist() == [np.inf, np.inf]
    assert since_seen(seen, both, np.array([True, True]), 10.2) == pytest.approx([0.2, np.inf])
    assert since_seen(seen, other, np.array([True, True]), 11.0) == pytest.approx([0.8, np.inf])
    assert since_seen(seen, both, np.array([False, True]), 12.0) == pytest.approx([np.inf, 1.8])
    assert inflation_of(2.0 * CARRIED_S + 1.0, carried=True) == 1.0


def normalised_errors(rate_hz: float, runs: int) -> list[float]:
    """Return the mean normalised squared error of each run of half a minute by codes and Dopplers alone."""
    found: list[float] = []
    for seed in range(runs):
        start, at, squares = GpsTime(2446, 400020.0 + 137.0 * seed), truth("demo", seed=seed), list[float]()
        for solution in solutions(RtkOptions(mode=Mode.DGPS), seed, start, rate_hz, round(30.0 * rate_hz)):
            if solution.status is Status.DGPS:
                error = solution.position_ecef_m - at(solution.time).antennas_ecef_m["rover"]
                squares.append(float(error @ np.linalg.solve(solution.position_cov_ecef_m2, error)) / 3.0)
        assert len(squares) > 25 * rate_hz
        found.append(float(np.mean(squares)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_codes_are_as_good_as_they_say_at_every_rate(rate_hz: float):
    """As white noise they had 1.8 at 1 Hz and 9 to 18 at 5 Hz; behind the bounds are 0.3 to 0.4 and 0.3 to 0.7."""
    assert 0.1 < np.mean(normalised_errors(rate_hz, 4)) < 1.5
