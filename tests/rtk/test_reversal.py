"""A recording turned round: what the receiver said of a step is said of the same step, from the other side."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.reversal import Reversal
from rtkmesh.rtk.slips import lost_lock

START = GpsTime(2399, 604790.0)  # over the end of a week
SATELLITES = [satellite_number(name) for name in ("G05", "E11", "R07")]
SIGNAL = 5


def recording(rows, dt_s=1.0):
    """Return epochs from per epoch lists of (satellite index, flags, lock time or None, has a phase)."""
    epochs = []
    for k, row in enumerate(rows):
        columns = {
            "satellite": [SATELLITES[s] for s, *_ in row], "signal": [SIGNAL] * len(row), "flags": [flags for _, flags, *_ in row],
            "lock_s": [np.nan if lock is None else lock for _, _, lock, _ in row],
            "phase_cyc": [1e8 + 100.0 * k if phase else np.nan for *_, phase in row], "pseudorange_m": [2.2e7] * len(row),
        }  # fmt: skip
        epochs.append(make_epoch(START + k * dt_s, **columns))
    return epochs


def turned(epochs: list[Epoch]) -> list[Epoch]:
    """Return the recording turned round, in the order of its new clock."""
    reversal = Reversal()
    return [reversal.turn(epoch) for epoch in reversed(epochs)]


def of(epoch: Epoch, satellite: int):
    """Return (flagged, lock time) of a satellite."""
    k = int(np.flatnonzero(epoch.satellite == SATELLITES[satellite])[0])
    return bool(epoch.flags[k] & SLIP), float(epoch.lock_s[k])


@st.composite
def recordings(draw):
    """Arcs with slips, lock times that fall, are missing or bounds, open half cycles, missing phases and rows."""
    has_lock, dt_s = draw(st.booleans()), draw(st.sampled_from([0.1, 1.0, 30.0]))
    lock = [draw(st.floats(0.0, 100.0)) for _ in SATELLITES]
    rows = []
    for _ in range(draw(st.integers(1, 12))):
        row = []
        for s in range(len(SATELLITES)):
            event = draw(st.sampled_from(["", "", "", "", "gone", "slip", "lost", "half", "no phase"]))
            lock[s] = 0.0 if event in ("lost", "half") else lock[s] + dt_s
            if event == "gone":
                continue
            flags = (SLIP if event == "slip" else 0) | (HALF_CYCLE if event == "half" else 0)
            row.append((s, flags, lock[s] if has_lock else None, event != "no phase"))
        rows.append(row)
    return recording(rows, dt_s)


@given(recordings())
def test_turning_twice_is_the_normal_form(epochs: list[Epoch]):
    """Backward of backward is forward: the same observations in the same order, and turning twice more changes nothing at all."""
    twice = turned(turned(epochs))
    again = turned(turned(twice))
    for first, second, third in zip(epochs, twice, again, strict=True):
        assert first.time == second.time
        for name in ("satellite", "signal", "phase_cyc", "pseudorange_m", "doppler_hz", "cn0_dbhz"):
            assert np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
        assert np.array_equal(second.flags, third.flags)
        assert third.lock_s == pytest.approx(second.lock_s, abs=1e-9, nan_ok=True)


@given(recordings())
def test_a_broken_step_is_broken_from_both_sides(epochs: list[Epoch]):
    """What the engine hears between two neighbouring phases of a signal (slips.lost_lock and the flag) is the same either way."""
    there, back = epochs, turned(epochs)[::-1]
    for satellite in range(len(SATELLITES)):
        number = SATELLITES[satellite]
        seen = [k for k, e in enumerate(there) if usable(e, number)]
        for a, b in pairwise(seen):
            elapsed_s = there[b].time - there[a].time
            between = any(of(there[k], satellite)[0] for k in range(a + 1, b + 1) if number in there[k].satellite)
            forward = between or lost_lock(of(there[b], satellite)[1], of(there[a], satellite)[1], elapsed_s)
            gap = b > a + 1 and of(there[b], satellite)[1] <= elapsed_s
            flagged, lock_s = of(back[a], satellite)
            assert flagged == (forward or gap)
            if not flagged and np.isfinite(lock_s):
                assert not lost_lock(lock_s, of(back[b], satellite)[1], elapsed_s)
                assert lock_s > elapsed_s  # an arc that spans a gap says so


def usable(epoch: Epoch, number: int) -> bool:
    k = np.flatnonzero(epoch.satellite == number)
    return len(k) > 0 and bool(np.isfinite(epoch.phase_cyc[k[0]])) and not epoch.flags[k[0]] & HALF_CYCLE


def test_a_slip_moves_to_the_epoch_before():
    """A flag at epoch 3 says of the step from 2 to 3; backward it stands at 2, and the first epoch of the new clock has none."""
    epochs = recording([[(0, SLIP if k == 3 else 0, None, True)] for k in range(6)])
    assert [of(e, 0)[0] for e in turned(epochs)[::-1]] == [False, False, True, False, False, False]


def test_a_lock_time_counts_from_the_end_of_the_arc():
    """Ten seconds of lock before the recording are not known backward; the second arc counts from its own end."""
    epochs = recording([[(0, 0, lock, True)] for lock in (10.0, 11.0, 12.0, 0.2, 1.2)])
    back = [of(e, 0) for e in turned(epochs)[::-1]]
    assert [flagged for flagged, _ in back] == [False, False, True, False, False]
    assert [lock_s for _, lock_s in back] == pytest.approx([2.0, 1.0, 0.0, 1.0, 0.0], abs=2e-3)


def test_a_slip_that_is_flagged_where_there_is_no_phase_is_not_lost():
    """The receiver says of the epoch without a usable phase that it slipped: the step over that epoch is broken."""
    rows = [[(0, 0, 50.0, True)], [(0, SLIP | HALF_CYCLE, 51.0, True)], [(0, 0, 52.0, True)]]
    assert [of(e, 0)[0] for e in turned(recording(rows))[::-1]] == [True, False, False]


def test_open_half_cycles_stay_where_they_are():
    """They are of the epoch's own phase, not of the time before it."""
    epochs = recording([[(0, HALF_CYCLE if k < 2 else 0, float(k), True)] for k in range(4)])
    assert [int(e.flags[0]) & HALF_CYCLE for e in turned(epochs)[::-1]] == [HALF_CYCLE, HALF_CYCLE, 0, 0]


def test_other_epochs_of_the_receiver_are_left_alone():
    """Turning makes new epochs: the recording is not written to."""
    epochs = recording([[(0, SLIP, 5.0, True)], [(0, SLIP, 6.0, True)]])
    copies = [replace(e, flags=e.flags.copy(), lock_s=e.lock_s.copy()) for e in epochs]
    turned(epochs)
    assert all(np.array_equal(a.flags, b.flags) and np.array_equal(a.lock_s, b.lock_s) for a, b in zip(epochs, copies, strict=True))
