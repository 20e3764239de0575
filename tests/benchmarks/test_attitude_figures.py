"""The attitude filters on simulated vehicles: sigmas that are honest, with and without a gyro; endurance."""

from types import SimpleNamespace

import pytest

from rtkmesh.attitude.filter_options import Kind

NAMES = ("attitude_filter",)


@pytest.mark.parametrize("vehicle", ["car with turns", "boat on waves"])
@pytest.mark.parametrize(("fix_hz", "gyro_hz", "runs"), [(10.0, 0.0, 8), (5.0, 25.0, 6)])
def test_sigmas_are_honest(benchmarks: SimpleNamespace, vehicle: str, fix_hz: float, gyro_hz: float, runs: int) -> None:
    """NEES 0.9 to 1.1 per degree of freedom, at fixes and between them, of vehicles that turn; better than the fits alone."""
    b = benchmarks.attitude_filter
    score = b.scored(b.Ride(b.VEHICLES[vehicle], fix_hz, gyro_hz, seconds=30.0), runs, 1)
    assert 0.9 < score.nees < 1.1
    assert score.available_pct == 100.0
    assert score.heading_deg < 0.2
    assert score.tilt_deg < 0.4


def test_a_gyro_carries_over_an_outage(benchmarks: SimpleNamespace) -> None:
    """Five seconds without fixes: without a gyro there is no attitude of a boat, with one it is within half a degree."""
    b = benchmarks.attitude_filter
    without, with_gyro = (
        b.scored(b.Ride(b.VEHICLES["boat on waves"], 5.0, gyro_hz, 20.0, outage_s=5.0), 2, 1, b.at_outage_ends) for gyro_hz in (0.0, 50.0)
    )
    assert without.available_pct == 0.0
    assert with_gyro.available_pct == 100.0
    assert max(with_gyro.heading_deg, with_gyro.tilt_deg) < 0.5


def test_the_heading_filter_rides_a_vehicle_that_is_about_level(benchmarks: SimpleNamespace) -> None:
    b = benchmarks.attitude_filter
    score = b.scored(b.Ride(b.VEHICLES["car with turns"], 5.0, 25.0, 20.0, kind=Kind.HEADING), 2, 1)
    assert score.available_pct == 100.0
    assert score.heading_deg < 0.2


def test_many_inputs_leave_the_covariance_positive(benchmarks: SimpleNamespace) -> None:
    worst, finite, resets = benchmarks.attitude_filter.endured(3000, 1)
    assert finite
    assert worst > 1e-3
    assert resets == 0
