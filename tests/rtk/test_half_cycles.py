"""Phases whose half cycles a receiver has not resolved: the filter has nothing of them, the table of satellites says why."""

from dataclasses import replace

import numpy as np
import pytest
from tests.rtk.test_engine import TRUTH, run

from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.rtk.solution import HALF_CYCLE as OPEN
from rtkmesh.rtk.solution import USED_CODE, USED_PHASE, Status

pytestmark = pytest.mark.data
OPEN_UNTIL = 6  # epochs


def flagged(epoch: Epoch, satellites: list[str], off_cyc: float) -> Epoch:
    """An epoch with open half cycles of some satellites, whose phases are off."""
    which = np.isin(epoch.satellite, [satellite_number(name) for name in satellites])
    return replace(epoch, flags=np.where(which, epoch.flags | HALF_CYCLE, epoch.flags), phase_cyc=epoch.phase_cyc + off_cyc * which)


def without_phases(epoch: Epoch, satellites: list[str]) -> Epoch:
    which = np.isin(epoch.satellite, [satellite_number(name) for name in satellites])
    return replace(epoch, phase_cyc=np.where(which, np.nan, epoch.phase_cyc))


def satellites_of(epoch: Epoch) -> list[str]:
    used = [row[0] for row in epoch.rows()]
    return sorted(set(used))[:4]


@pytest.mark.parametrize("end", ["rover", "base"])
def test_open_half_cycles_are_as_no_phases(recording, end):
    """Half of the satellites half a cycle off, and said to be open: bit by bit the solutions of a receiver that has no phase of them."""
    rover, base, ephemerides = recording
    names = satellites_of(rover[0])
    told = {"rover": rover, "base": base}
    with_flags = {**told, end: [flagged(e, names, 0.5) for e in told[end]]}
    bare = {**told, end: [without_phases(e, names) for e in told[end]]}
    solved, _ = run(with_flags["rover"], with_flags["base"], ephemerides)
    expected, _ = run(bare["rover"], bare["base"], ephemerides)
    for one, other in zip(solved, expected, strict=True):
        assert one.status is other.status
        assert np.array_equal(one.position_ecef_m, other.position_ecef_m)
    table = solved[-1].satellites
    which = np.isin(table.satellite, [satellite_number(name) for name in names])
    assert which.sum() >= 4
    assert ((table.state & OPEN) > 0).tolist() == which.tolist()
    assert not (table.state[which] & USED_PHASE).any()
    assert (table.state[which] & USED_CODE).any()


def test_without_the_flag_they_would_count(recording):
    """The same phases, said to be whole: what the test above leaves out matters."""
    rover, base, ephemerides = recording
    names = satellites_of(rover[0])
    wrong = [replace(flagged(e, names, 0.5), flags=e.flags) for e in rover]
    solved, _ = run(wrong, base, ephemerides)
    expected, _ = run([without_phases(e, names) for e in rover], base, ephemerides)
    assert any(not np.array_equal(a.position_ecef_m, b.position_ecef_m) for a, b in zip(solved, expected, strict=True))


def test_resolved_half_cycles_join(recording):
    """Resolved, and half a cycle moved by that (which receivers tell as a slip): the phases are used, the fix stays right."""
    rover, base, ephemerides = recording
    names = satellites_of(rover[0])
    epochs = [flagged(e, names, 0.5) for e in rover[:OPEN_UNTIL]]
    first = rover[OPEN_UNTIL]
    which = np.isin(first.satellite, [satellite_number(name) for name in names])
    epochs += [replace(first, flags=np.where(which, first.flags | SLIP, first.flags)), *rover[OPEN_UNTIL + 1 :]]
    solved, _ = run(epochs, base, ephemerides)
    assert all(s.status is Status.FIX for s in solved)
    assert max(np.linalg.norm(s.position_ecef_m - TRUTH) for s in solved) < 0.05
    table = solved[-1].satellites
    joined = np.isin(table.satellite, [satellite_number(name) for name in names])
    assert not (table.state[joined] & OPEN).any()
    assert (table.state[joined] & USED_PHASE).any()
