"""The campaign's runs beside RTKLIB: what it is given, how it is judged, when it counts as ahead; and that it really solves them."""

import dataclasses
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader

pytestmark = pytest.mark.slow  # without compiled kernels

NAMES = ("campaign", "families", "peers", "rtklib", "score_pos", "simulated", "simulated_files")
rtklib = pytest.mark.rtklib


def run_of(benchmarks: SimpleNamespace, family: str, number: int) -> Any:
    return benchmarks.campaign.simulated_run(next(f for f in benchmarks.families.FAMILIES if f.name == family), 1, number)


# --- what can be given ---


@pytest.mark.parametrize(("family", "number", "given"), [("open", 0, True), ("base_gaps", 0, True), ("base_shift", 0, False)])
def test_a_base_that_moves_house_cannot_be_told(benchmarks: SimpleNamespace, family: str, number: int, given: bool):
    """Lost epochs can be left out of a file; a second position of the base has no place in it."""
    assert benchmarks.peers.can_be_given(run_of(benchmarks, family, number)) is given


def test_late_epochs_cannot_be_given_and_rare_ones_can(benchmarks: SimpleNamespace):
    """A program that reads files takes the newest base epoch up to the rover's: one that came later is out of its reach."""
    run = run_of(benchmarks, "open", 0)
    late = dataclasses.replace(run.setup, arrivals=lambda k: (k - 7,))
    rare = dataclasses.replace(run.setup, arrivals=lambda k: (k,) if k % 7 == 0 else ())
    assert [benchmarks.peers.can_be_given(dataclasses.replace(run, setup=setup)) for setup in (late, rare)] == [False, True]


def test_what_the_rover_does_not_hear_is_not_sent(benchmarks: SimpleNamespace):
    """One base epoch in seven arrives; the bytes hold these alone."""
    run = run_of(benchmarks, "open", 0)
    rare = dataclasses.replace(run, setup=dataclasses.replace(run.setup, arrivals=lambda k: (k,) if k % 7 == 0 else ()))
    heard = [bool(data) for data in benchmarks.simulated_files.sent(rare).base]
    assert heard == [k % 7 == 0 for k in range(run.setup.epochs)]


def test_a_told_restart_is_another_start(benchmarks: SimpleNamespace):
    """The same dive, told and not: two spans that meet at the surfacing, and one."""
    run = run_of(benchmarks, "dive_told", 0)
    (outage,) = run.setup.outages
    up_s, end_s = outage.start_s + outage.duration_s, float(run.setup.seconds)
    assert benchmarks.peers.spans(run) == [(0.0, up_s), (up_s, end_s)]
    assert benchmarks.peers.spans(dataclasses.replace(run, setup=dataclasses.replace(run.setup, told_restarts=False))) == [(0.0, end_s)]


# --- how it is judged ---


@pytest.mark.parametrize(("family", "kind"), [("open", "ecef"), ("moving_base", "enu")])
def test_the_truth_is_right_and_a_shift_of_it_is_wrong(benchmarks: SimpleNamespace, family: str, kind: str):
    """A track of the true places has no error in either frame; 0.2 m up it is wrong, but not as a float; epochs outside do not count."""
    run = run_of(benchmarks, family, 0)
    n, turn = run.setup.epochs, run.site.ecef_from_enu()
    time_s = run.start.week * 604800.0 + run.start.tow_s + np.arange(-1.0, n + 1.0)
    up_m = np.where(np.arange(n) < 10, 0.2, 0.0)[:, None] * np.array([0.0, 0.0, 1.0])
    inside = run.baseline_ecef_m @ turn + up_m if kind == "enu" else run.base_ecef_m + run.baseline_ecef_m + up_m @ turn.T
    vector_m = np.vstack([inside[:1], inside, inside[-1:]])
    quality = np.where(np.arange(-1, n + 1) < 5, 2, 1)
    found = benchmarks.peers.judged(run, [benchmarks.score_pos.Track(kind, time_s, vector_m, quality), None])
    assert np.allclose(found.error_enu_m, up_m, atol=1e-6)
    assert np.flatnonzero(found.wrong).tolist() == list(range(5, 10))
    assert found.fixed.sum() == n - 5


def outcome_of(benchmarks: SimpleNamespace, fixes: int, wrong: int, first_s: float = 0.0) -> Any:
    empty = np.zeros(0)
    return benchmarks.campaign.Outcome("x", 0, 100, fixes, wrong, 0.0, 0.0, first_s, empty, empty, empty, empty)


def test_who_is_ahead(benchmarks: SimpleNamespace):
    """More right fixes, a sooner one, fewer wrong: any of it counts, by a margin; what never fixed is no sooner."""
    of = partial(outcome_of, benchmarks)
    ahead, never = benchmarks.peers.is_ahead, float("inf")
    assert not ahead(of(0, 0, never), of(0, 0, never))
    assert ahead(of(55, 0, 9.0), of(50, 0, 9.0))
    assert not ahead(of(54, 0, 9.0), of(50, 0, 9.0))
    assert ahead(of(2, 0, 4.0), of(50, 0, 9.0))
    assert not ahead(of(2, 0, 5.0), of(50, 0, 9.0))
    assert ahead(of(2, 0, never), of(50, 1, 9.0))
    assert not ahead(of(60, 8, 9.0), of(50, 0, 9.0))


# --- what it is set to ---


def test_the_best_settings_have_right_fixes_and_few_wrong_ones(benchmarks: SimpleNamespace):
    """Over two runs: 90 right and 30 wrong are less than 70 right; of equals the first is taken."""
    first, second, third = benchmarks.peers.all_settings("open")[:3]
    of = partial(outcome_of, benchmarks)
    runs = [{("p", first): of(60, 20), ("p", second): of(40, 0), ("p", third): of(40, 0), ("other", third): of(99, 0)}]
    runs.append({("p", first): of(60, 10), ("p", second): of(30, 0), ("p", third): of(30, 0), ("other", third): of(99, 0)})
    assert benchmarks.peers.best("p", runs) == second


def test_every_family_that_can_be_given_has_settings(benchmarks: SimpleNamespace):
    """The file knows all of them, and nothing that cannot be chosen."""
    for peer in (peer for peer in benchmarks.peers._PEERS if peer.chosen):
        for family in benchmarks.families.FAMILIES:
            if family.name != "base_shift":
                assert peer.settings(family.name) in benchmarks.peers.all_settings(family.name), (peer.name, family.name)


# --- RTKLIB itself ---


@pytest.fixture
def files(benchmarks: SimpleNamespace, rtklib_program: Any, tmp_path: Path) -> Any:
    """A run with slips that nobody tells, as files."""
    rtklib_program("convbin")
    run = run_of(benchmarks, "slips", 0)
    written = benchmarks.simulated_files.converted(run, benchmarks.simulated_files.sent(run), tmp_path)
    return run, benchmarks.simulated_files.with_wrong_orbits(run, written)


@rtklib
def test_convbin_hands_on_every_observation(files: Any):
    """Every code of the run with its faults, to the last printed digit, and nothing else."""
    run, written = files
    for path, epochs in ((written.rover, run.rover_epochs), (written.base, run.base_epochs)):
        read = list(ObservationReader(path.read_bytes()))
        assert len(read) == len(epochs)
        for ours, theirs in zip(epochs, read, strict=True):
            assert (ours.satellite.tolist(), ours.signal.tolist()) == (theirs.satellite.tolist(), theirs.signal.tolist())
            assert np.allclose(ours.pseudorange_m, theirs.pseudorange_m, rtol=0.0, atol=1.1e-3)
            kept = np.isfinite(theirs.phase_cyc)
            assert np.allclose(ours.phase_cyc[kept], theirs.phase_cyc[kept], rtol=0.0, atol=1.1e-3)


@rtklib
def test_every_phase_is_there_when_asked_for(benchmarks: SimpleNamespace, files: Any, tmp_path: Path):
    """By default convbin drops those of which the receiver says that they are bad; told less, it keeps them, and nothing else changes."""
    run, written = files
    default = list(ObservationReader(written.rover.read_bytes()))
    (tmp_path / "all").mkdir()
    bytes_of_all = benchmarks.simulated_files.sent(run, every_phase=True)
    all_of_them = list(ObservationReader(benchmarks.simulated_files.converted(run, bytes_of_all, tmp_path / "all").rover.read_bytes()))
    kept, every = (np.concatenate([np.isfinite(epoch.phase_cyc) for epoch in epochs]) for epochs in (default, all_of_them))
    assert every.all()
    assert 0.02 < 1.0 - kept.mean() < 0.4
    codes = [np.concatenate([epoch.pseudorange_m for epoch in epochs]) for epochs in (default, all_of_them)]
    assert np.array_equal(*codes)


@rtklib
def test_their_ephemerides_are_ours(benchmarks: SimpleNamespace, files: Any):
    """All satellites, as wrong as broadcast ones are: none is the simulator's own."""
    run, written = files
    (path,) = written.navigation
    found = {ephemeris.satellite: ephemeris for ephemeris in read_navigation(path.read_bytes()).ephemerides}
    sky = benchmarks.simulated_files
    assert set(found) == set(sky.SATELLITES.tolist())
    for satellite, ephemeris in found.items():
        if hasattr(ephemeris, "m0_rad"):
            told = sky.with_orbit_error(sky.broadcast(satellite, run.start), run.seed)
            assert ephemeris.m0_rad == pytest.approx(told.m0_rad, rel=1e-11)
            assert abs(ephemeris.m0_rad - sky.broadcast(satellite, run.start).m0_rad) > 1e-12


@rtklib
@pytest.mark.parametrize("demo5", [False, True])
def test_they_solve_a_run(benchmarks: SimpleNamespace, rtklib_program: Any, demo5: bool):
    """Under open sky nearly every epoch is a right fix of either program; a moving base works as well."""
    rtklib_program("rnx2rtkp")
    if demo5:
        pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")
    names = [peer.name for peer in benchmarks.peers.installed() if peer.demo5 is demo5]
    assert len(names) == 2
    for family in ("open", "moving_base"):
        found = benchmarks.peers.measure(family, 1, 0)
        assert max(found[name].fixes - found[name].wrong for name in names) > 0.9 * found["rtkmesh"].possible
        assert all(found[name].wrong == 0 for name in names)


@rtklib
def test_options_that_demo5_does_not_know_are_told(benchmarks: SimpleNamespace, files: Any):
    """A value of b34's options that demo5 would pass over in silence."""
    pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")
    run, written = files
    with pytest.raises(benchmarks.rtklib.ProgramError, match="pos1-frequency"):
        benchmarks.simulated_files.by_demo5(run.start, written, "pos1-frequency=l1+2\n", (0.0, 10.0))


def test_a_run_that_cannot_be_given_is_left_out(benchmarks: SimpleNamespace):
    """Of us as well: rows compare the same runs."""
    assert benchmarks.peers.measure("base_shift", 1, 0) == {}
