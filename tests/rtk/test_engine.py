"""Invariants of the engine, and its answers to faults, on a short real recording."""

import os
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from rtkmesh.gnss.epoch import COLUMNS, make_epoch
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.models.ephemeris_table import EphemerisTable
from rtkmesh.rtk.engine import Rtk
from rtkmesh.rtk.options import AmbiguityMode, AmbiguityOptions, Mode, RtkOptions
from rtkmesh.rtk.solution import USED_PHASE, Reason, Solution, Status

pytestmark = pytest.mark.data
BASE = np.array((-3959400.631, 3385704.533, 3667523.111))
TRUTH = np.array((-3962108.673, 3381309.574, 3668678.638))
OPTIONS = RtkOptions(systems="GEJ", frequencies=2)


def table_of(ephemerides):
    table = EphemerisTable()
    for ephemeris in ephemerides:
        table.add(ephemeris)
    return table


def run(rover, base, ephemerides, options=OPTIONS, base_ecef_m=BASE):
    engine, table = Rtk(options), table_of(ephemerides)
    return [engine.step(r, b, table, base_position_ecef_m=base_ecef_m) for r, b in zip(rover, base, strict=True)], engine


def positions(solutions):
    return np.array([s.position_ecef_m for s in solutions])


def edit(epoch, **columns):
    return replace(epoch, **columns)


def test_fixed_from_the_first_epoch(recording):
    """All epochs are fixed and right; numbers that describe them are there."""
    solutions, _ = run(*recording)
    assert np.abs(positions(solutions) - TRUTH).max() < 0.03
    last = solutions[-1]
    assert all(s.status is Status.FIX for s in solutions)
    assert last.grade == 3 or last.grade == 2
    assert last.ratio > 2.0
    assert last.ambiguities_fixed > 20
    assert np.isfinite(last.velocity_ecef_mps).all()
    assert np.linalg.norm(last.velocity_ecef_mps) < 0.1
    assert last.baseline_ecef_m == pytest.approx(TRUTH - BASE, abs=0.03)
    assert len(last.satellites.satellite) > 20
    assert np.nanmax(np.abs(last.satellites.phase_residual_m)) < 0.05


def test_a_solution_has_all_of_its_fields(recording):
    """It is filled field by field."""
    solutions, _ = run(*recording)
    assert all(hasattr(solution, field.name) for solution in solutions[:3] for field in fields(Solution))


def test_what_the_filter_knows_beside_the_integers(recording):
    """The float solution stands near the fix and is not the same; ambiguities have variances and ages; each system has its clock, and
    the atmosphere over five kilometres is known.
    """
    solutions, _ = run(*recording)
    last = solutions[-1]
    apart_m = last.float_state.position_ecef_m - last.position_ecef_m
    assert 0.0 < np.linalg.norm(apart_m) < 0.5
    assert np.linalg.norm(last.float_state.velocity_ecef_mps) < 0.2
    assert abs(last.float_state.zenith_m) < 0.002
    satellites = np.unique(last.satellites.satellite)
    assert set(last.float_state.satellites) <= set(satellites.tolist())
    assert len(last.float_state.satellites) > len(satellites) // 2
    table = last.satellites
    known = np.isfinite(table.ambiguity_cyc)
    assert (table.ambiguity_variance_cyc2[known] > 0.0).all()
    assert np.isnan(table.ambiguity_variance_cyc2[~known]).all()
    assert table.lock_epochs.max() >= len(recording[0]) - 1
    assert not table.rejects[table.state & USED_PHASE != 0].any()
    assert last.clocks_s[0] == pytest.approx(last.receiver_clock_s)
    assert np.isfinite(last.clocks_s).tolist() == [True, False, True, False, True, True, False]
    assert abs(last.clocks_s[2] - last.clocks_s[0]) < 1e-6


def test_same_input_same_bits_and_order_of_satellites_irrelevant(recording):
    """Rows given in another order, and another run, change no bit."""
    rover, base, ephemerides = recording
    rng = np.random.default_rng(0)

    def shuffled(epoch):
        order = rng.permutation(len(epoch))
        return make_epoch(epoch.time, **{name: getattr(epoch, name)[order] for name, _, _ in COLUMNS})

    first, _ = run(*recording)
    second, _ = run([shuffled(e) for e in rover], [shuffled(e) for e in base], list(reversed(ephemerides)))
    assert np.array_equal(positions(first), positions(second))
    assert np.array_equal(first[-1].position_cov_ecef_m2, second[-1].position_cov_ecef_m2)


def test_swapping_rover_and_base_changes_the_sign(recording):
    rover, base, ephemerides = recording
    forward, _ = run(*recording)
    backward, _ = run(base, rover, ephemerides, base_ecef_m=TRUTH)
    assert backward[-1].status is Status.FIX
    assert backward[-1].baseline_ecef_m == pytest.approx(-forward[-1].baseline_ecef_m, abs=0.01)


def test_whole_cycles_on_a_satellite_change_nothing(recording):
    """Another integer ambiguity from the beginning gives the same position."""
    rover, base, ephemerides = recording
    shifted = [edit(e, phase_cyc=e.phase_cyc + 12345.0 * (e.satellite == e.satellite[0])) for e in rover]
    assert positions(run(shifted, base, ephemerides)[0]) == pytest.approx(positions(run(*recording)[0]), abs=1e-5)


def test_a_week_later_everything_is_the_same(recording):
    """Moving epochs and ephemerides by a week moves nothing (but the seasons of the troposphere by a week)."""
    rover, base, ephemerides = recording

    def later(value):
        return GpsTime(value.week + 1, value.tow_s)

    moved = [
        replace(e, **{name: later(getattr(e, name)) for name in ("toe", "toc", "transmitted") if hasattr(e, name)}) for e in ephemerides
    ]
    solutions, _ = run([edit(e, time=later(e.time)) for e in rover], [edit(e, time=later(e.time)) for e in base], moved)
    assert positions(solutions) == pytest.approx(positions(run(*recording)[0]), abs=2e-4)


def test_later_epochs_leave_a_solution_as_it_is(recording):
    """Its vectors are read when they are asked for; none is a window on the filter."""
    rover, base, ephemerides = recording
    engine, table, before = Rtk(OPTIONS), table_of(ephemerides), []
    solutions = []
    for r, b in zip(rover, base, strict=True):
        solutions.append(engine.step(r, b, table, base_position_ecef_m=BASE))
        before.append([part.copy() for part in vectors_of(solutions[-1])])
    for solution, then in zip(solutions, before, strict=True):
        assert all(np.array_equal(now, old, equal_nan=True) for now, old in zip(vectors_of(solution), then, strict=True))


def vectors_of(solution):
    state = solution.float_state
    floats = state.position_ecef_m, state.velocity_ecef_mps, state.acceleration_ecef_mps2, state.ionosphere_m, solution.satellites.packed
    return [value for field in fields(solution) if isinstance(value := getattr(solution, field.name), np.ndarray)] + list(floats)


def test_slips_are_survived(recording):
    """A one-cycle slip on one signal and a large one on another satellite leave the fix right, and are counted."""
    rover, base, ephemerides = recording
    satellites = np.unique(rover[0].satellite)
    first = int(np.flatnonzero(rover[0].satellite == satellites[1])[0])
    slipped = []
    for k, epoch in enumerate(rover):
        phase = epoch.phase_cyc.copy()
        if k >= 6:
            phase[(epoch.satellite == epoch.satellite[first]) & (epoch.signal == rover[0].signal[first])] += 1.0
            phase[epoch.satellite == satellites[3]] += 777.0
        slipped.append(edit(epoch, phase_cyc=phase))
    solutions, _ = run(slipped, base, ephemerides)
    assert np.abs(positions(solutions) - TRUTH).max() < 0.03
    assert all(s.status is Status.FIX for s in solutions)
    assert solutions[-1].satellites.slips.sum() >= 2


def test_bad_codes_are_left_out(recording):
    """A code that is 300 m off, and one that jumps later, change the result by millimetres."""
    rover, base, ephemerides = recording
    bad = []
    for k, epoch in enumerate(rover):
        code = epoch.pseudorange_m.copy()
        code[epoch.satellite == epoch.satellite[0]] += 300.0 if k > 3 else 0.0
        bad.append(edit(epoch, pseudorange_m=code))
    solutions, _ = run(bad, base, ephemerides)
    assert np.abs(positions(solutions) - TRUTH).max() < 0.03


def test_rubbish_never_raises_and_never_becomes_a_number(recording):
    """Not finite, absurd and empty observations give no exception and no NaN in a solution that claims a position."""
    rover, base, ephemerides = recording
    rng = np.random.default_rng(1)
    damaged = list(rover)
    damaged[2] = edit(rover[2], pseudorange_m=np.full(len(rover[2]), np.inf), phase_cyc=np.full(len(rover[2]), np.nan))
    damaged[4] = edit(rover[4], pseudorange_m=rng.uniform(0.0, 1e9, len(rover[4])), phase_cyc=rng.normal(size=len(rover[4])) * 1e300)
    damaged[6] = rover[6].take(np.zeros(len(rover[6]), np.bool_))
    damaged[8] = edit(rover[8], doppler_hz=np.full(len(rover[8]), 1e300), cn0_dbhz=np.full(len(rover[8]), -np.inf))
    solutions, _ = run(damaged, base, ephemerides)
    for s in solutions:
        if s.status is not Status.NONE:
            assert np.isfinite(s.position_ecef_m).all()
            assert np.isfinite(s.position_cov_ecef_m2).all()
    assert np.linalg.norm(solutions[-1].position_ecef_m - TRUTH) < 1.0


def test_reasons(recording):
    """Without base, with an old one, without its position: a single-point solution and the reason."""
    rover, base, ephemerides = recording
    table = table_of(ephemerides)
    engine = Rtk(OPTIONS)
    assert engine.step(rover[0], None, table, base_position_ecef_m=BASE).reason is Reason.NO_BASE
    assert engine.step(rover[0], base[0], table).reason is Reason.NO_BASE_POSITION
    old = edit(base[0], time=base[0].time + -40.0)
    solution = engine.step(rover[0], old, table, base_position_ecef_m=BASE)
    assert (solution.status, solution.reason) == (Status.SINGLE, Reason.BASE_TOO_OLD)
    assert engine.step(rover[0], base[0], EphemerisTable(), base_position_ecef_m=BASE).status is Status.NONE


def test_a_prediction_far_off_the_single_point_is_not_believed(recording):
    """A filter that is a kilometre off begins anew with the epoch, and the epoch's solution is the first one of a new engine."""
    rover, base, ephemerides = recording
    _, engine = run(rover[:5], base[:5], ephemerides)
    engine._state.filter.x[0] += 1000.0
    table = table_of(ephemerides)
    solution = engine.step(rover[5], base[5], table, base_position_ecef_m=BASE)
    assert solution.resets == 1
    (first,), _ = run(rover[5:6], base[5:6], ephemerides)
    assert solution.status is first.status is Status.FIX
    assert np.linalg.norm(solution.position_ecef_m - TRUTH) < 0.05


def test_a_gap_of_seconds_costs_the_motion_and_nothing_else(recording):
    """Beyond what the motion model spans the single point takes over the position; the integers stay."""
    rover, base, ephemerides = recording
    kept = [0, 1, 2, 3, 4, 11]
    solutions, _ = run([rover[k] for k in kept], [base[k] for k in kept], ephemerides)
    assert solutions[-1].resets == 0
    assert [s.status for s in solutions] == [Status.FIX] * len(kept)
    assert solutions[-1].grade >= solutions[-2].grade
    assert np.linalg.norm(solutions[-1].position_ecef_m - TRUTH) < 0.03


def test_another_position_of_the_base_moves_the_rover_along(recording):
    """Told that the base stands a metre elsewhere, the rover is a metre elsewhere too: the baseline stays, fixed at once."""
    rover, base, ephemerides = recording
    _, engine = run(rover[:5], base[:5], ephemerides)
    move_m = np.array((0.6, -0.3, 0.2))
    solution = engine.step(rover[5], base[5], table_of(ephemerides), base_position_ecef_m=BASE + move_m)
    assert solution.resets == 0
    assert np.linalg.norm(solution.position_ecef_m - TRUTH - move_m) < 0.5


def test_a_base_that_stands_still_in_time(recording):
    """With base epochs up to ten seconds old the fix holds and the age is told."""
    rover, base, ephemerides = recording
    solutions, _ = run(rover, [base[0], base[1], *[base[1]] * (len(rover) - 2)], ephemerides)
    assert solutions[-1].age_s == pytest.approx(10.0)
    assert solutions[-1].status is Status.FIX
    assert np.abs(positions(solutions) - TRUTH).max() < 0.08


def test_a_base_that_loses_messages(recording):
    """When a base epoch lacks a system, the system comes from the epoch before: all stay in use, the fix holds."""
    rover, base, ephemerides = recording
    whole, _ = run(*recording)
    partial = [e if k == 0 else e.take((e.satellite < 64) == (k % 2 == 0)) for k, e in enumerate(base)]
    solutions, _ = run(rover, partial, ephemerides)
    assert all(s.status is Status.FIX for s in solutions)
    assert np.abs(positions(solutions) - TRUTH).max() < 0.03
    assert solutions[-1].satellites_used >= whole[-1].satellites_used - 1


def test_time_that_runs_back_resets_the_filter(recording):
    rover, base, ephemerides = recording
    order = [0, 1, 2, 0, 1, 2]
    solutions, _ = run([rover[k] for k in order], [base[k] for k in order], ephemerides)
    assert solutions[-1].resets == 1
    assert np.abs(positions(solutions) - TRUTH).max() < 0.03


@pytest.mark.parametrize("mode", [Mode.STATIC, Mode.STATIC_START, Mode.DGPS, Mode.SINGLE, Mode.FIXED])
def test_modes(recording, mode):
    """Every mode gives its kind of solution at its accuracy."""
    options = replace(OPTIONS, mode=mode, fixed_position_ecef_m=tuple(TRUTH) if mode is Mode.FIXED else None)
    solutions, _ = run(*recording, options)
    expected, limit_m = {Mode.DGPS: (Status.DGPS, 1.0), Mode.SINGLE: (Status.SINGLE, 6.0)}.get(mode, (Status.FIX, 0.03))
    assert solutions[-1].status is expected
    assert np.linalg.norm(solutions[-1].position_ecef_m - TRUTH) < limit_m


@pytest.mark.parametrize("mode", [AmbiguityMode.OFF, AmbiguityMode.INSTANTANEOUS, AmbiguityMode.FIX_AND_HOLD])
def test_ambiguity_modes(recording, mode):
    solutions, _ = run(*recording, replace(OPTIONS, ambiguity=AmbiguityOptions(mode=mode, hold_after_epochs=3)))
    assert solutions[-1].status is (Status.FLOAT if mode is AmbiguityMode.OFF else Status.FIX)
    assert np.linalg.norm(solutions[-1].position_ecef_m - TRUTH) < (0.5 if mode is AmbiguityMode.OFF else 0.03)


def test_an_excluded_satellite_is_not_used(recording):
    name = next(row[0] for row in recording[0][0].rows())
    solutions, _ = run(*recording, replace(OPTIONS, excluded=(name,)))
    assert satellite_number(name) not in solutions[-1].satellites.satellite


def test_the_same_code_without_compilation(recording, data):
    """Three epochs with NUMBA_DISABLE_JIT=1 give the positions of the compiled code to a micrometre."""
    rover, base, ephemerides = recording
    program = f"""
import sys, numpy as np, pathlib
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_engine as t
from conftest import load
rover, base, ephemerides = load(pathlib.Path({str(data / "kanagawa_2021_078_60s")!r}))
options = t.replace(t.OPTIONS, systems="G", frequencies=1)
print(repr(t.positions(t.run(rover[:3], base[:3], ephemerides, options)[0]).tolist()))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, "NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=True
    )
    compiled, _ = run(rover[:3], base[:3], ephemerides, replace(OPTIONS, systems="G", frequencies=1))
    plain = np.array(eval(done.stdout))  # our own program's list of lists
    assert plain == pytest.approx(positions(compiled), abs=1e-6)
