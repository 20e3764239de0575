"""Stations for hours: what is simulated is what the level says, judged against where the rover's antenna is."""

from types import SimpleNamespace

import numpy as np
import pytest

pytestmark = pytest.mark.slow  # without compiled kernels

NAMES = ("stations", "station_peers", "campaign", "rtklib")


def test_runs_of_all_systems_are_alike(benchmarks: SimpleNamespace) -> None:
    stations = benchmarks.stations
    found = [stations.stations_of(level, 3, 1) for level in stations.LEVELS if level.km == 35]
    assert len({(one.start, one.seed, tuple(one.rover_ecef_m)) for one in found}) == 1
    assert 31.5e3 <= np.linalg.norm(found[0].rover_ecef_m - found[0].base_ecef_m) <= 38.5e3


def test_levels_have_names(benchmarks: SimpleNamespace) -> None:
    stations = benchmarks.stations
    assert all(stations.level_of(level.name) == level for level in stations.LEVELS)
    with pytest.raises(ValueError, match="GR:50"):
        stations.level_of("GR:48")


def test_half_an_hour_is_solved_and_judged(benchmarks: SimpleNamespace) -> None:
    stations = benchmarks.stations
    level = stations.level_of("GREC:20")
    found = stations.stations_of(level, 1, 0)
    solutions = list(stations.solutions_of(level, found, stations.seen_by(found, 60)))
    judged = stations.judge(found, solutions)
    assert judged.fixed[10:].all()
    assert not judged.wrong.any()
    assert np.nanmedian(judged.normalised) < 3.0
    row = benchmarks.campaign.figures([benchmarks.campaign.outcome(str(level), 0, judged, 2.0)])
    assert row["epochs"] == 60
    assert row["first_right_s"][0] == int(np.argmax(judged.fixed)) / 2.0
    assert len(list(benchmarks.campaign.lines_of(solutions, judged))) == 61


def test_an_hour_beside_rtklib(benchmarks: SimpleNamespace) -> None:
    """Other programs read the files and have the same truth: at 20 km both fix, and without antennas there is nobody to compare with."""
    stations = benchmarks.stations
    if benchmarks.rtklib.missing():
        pytest.skip("RTKLIB's programs are not installed")
    found = stations.measure(stations.level_of("GR:20"), 1, 4, hours=1.0)
    assert list(found) == [stations.OURS, *(peer.name for peer in benchmarks.station_peers.station_peers())]
    assert found[stations.OURS].fixes > 100
    assert found["b34 continuous"].fixes - found["b34 continuous"].wrong > 20
    assert list(stations.measure(stations.level_of("GR:20:unknown"), 1, 4, hours=0.1)) == [stations.OURS]


def test_waves_of_the_ionosphere_make_no_lasting_wrong_fixes(benchmarks: SimpleNamespace) -> None:
    """Three hours of stations 50 km apart: as long as ionospheres lasted for an hour in both filters 88 of these fixes were wrong
    (without the slope that lasts for hours)."""
    stations = benchmarks.stations
    level = stations.level_of("GR:50:unknown")
    found = stations.stations_of(level, 1, 3)
    judged = stations.judge(found, list(stations.solutions_of(level, found, stations.seen_by(found, 360))))
    assert judged.fixed.mean() > 0.9
    assert judged.wrong.sum() <= 20
