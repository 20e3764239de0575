"""Rover epochs get their own base epoch under every arrival pattern that networks produce."""

import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.pairing import Pair, Pairing, PairingOptions

START = GpsTime(2200, 604799.0)  # the week rolls over within every test
INTERVAL_S = 0.2


def epoch_at(seconds: float) -> Epoch:
    return make_epoch(START + seconds, satellite=np.array([1]), signal=np.array([28]))


def run_live(rovers: list[tuple[float, float]], bases: list[tuple[float, float]], options: PairingOptions) -> list[tuple[Pair, float]]:
    """Feed (arrival, tag) lists on a simulated clock, waking at deadlines as the service does; return (pair, instant solved)."""
    pairing, solved = Pairing(options), []
    events = sorted([(arrival, 0, tag) for arrival, tag in bases] + [(arrival, 1, tag) for arrival, tag in rovers])

    def drain(now_s: float) -> None:
        while (pair := pairing.next_pair(now_s)) is not None:
            solved.append((pair, now_s))

    for arrival, is_rover, tag in events:
        while (due := pairing.deadline_s()) < arrival:
            drain(due)
        (pairing.add_rover if is_rover else pairing.add_base)(epoch_at(tag), arrival)
        drain(arrival)
    while len(pairing):
        drain(pairing.deadline_s())
    return solved


def tags(count: int = 100) -> list[float]:
    return [k * INTERVAL_S for k in range(count)]


def bursts(late_s: float) -> list[tuple[float, float]]:
    return [(((k // 5) * 5 + 4) * INTERVAL_S + late_s, tag) for k, tag in enumerate(tags())]


PATTERNS = {
    "in step": [(t, t) for t in tags()],
    "5 ms late": [(t + 0.005, t) for t in tags()],
    "60 ms late": [(t + 0.06, t) for t in tags()],
    "260 ms late": [(t + 0.26, t) for t in tags()],
    "250 ms early": [(t - 0.25, t) for t in tags()],
    "twice": [(t + d, t) for t in tags() for d in (0.0, 0.05)],
    "bursts of five": bursts(0.0),
    "bursts of five, late": bursts(0.06),
    "every tenth late": [(t + (0.31 if k % 10 == 9 else 0.06), t) for k, t in enumerate(tags())],
    "overtaking": [(t + random.Random(k).uniform(0.0, 0.4), t) for k, t in enumerate(tags())],
}


@pytest.mark.parametrize("pattern", PATTERNS)
def test_every_rover_epoch_is_solved_with_its_own_base_epoch(pattern: str) -> None:
    """100 % solved, 100 % at age 0, in order, and no later than the later of the two arrivals (plus earlier waiting ones)."""
    solved = run_live([(t, t) for t in tags()], PATTERNS[pattern], PairingOptions())
    assert [pair.rover.time - START for pair, _ in solved] == pytest.approx(tags())
    assert all(pair.base is not None and pair.base.time == pair.rover.time for pair, _ in solved)
    arrived = {round(tag, 3): max(arrival, tag) for arrival, tag in sorted(PATTERNS[pattern], reverse=True)}
    newest = 0.0
    for pair, instant in solved:
        newest = max(newest, arrived[round(pair.rover.time - START, 3)])
        assert instant <= newest + 1e-9


def test_a_lost_base_epoch_costs_little_once_the_stream_has_proved_orderly() -> None:
    bases = [(t + 0.01, t) for k, t in enumerate(tags(300)) if k % 5 or k < 100]
    solved = run_live([(t, t) for t in tags(300)], bases, PairingOptions())
    assert len(solved) == 300
    late = [instant - (pair.rover.time - START) for pair, instant in solved[120:]]
    assert max(late) <= INTERVAL_S + 0.05
    aged = [pair for pair, _ in solved if pair.base is not None and pair.base.time != pair.rover.time]
    assert all(pair.base is not None and pair.rover.time - pair.base.time == pytest.approx(INTERVAL_S) for pair in aged)
    assert len(aged) == 40


def test_a_fast_rover_does_not_wait_for_epochs_that_a_slow_base_never_sends() -> None:
    rovers = [(t, t) for t in tags(100)]
    bases = [(t + 0.03, t) for t in np.arange(0.0, 20.0, 1.0).tolist()]
    solved = run_live(rovers, bases, PairingOptions())
    assert max(instant - (pair.rover.time - START) for pair, instant in solved[20:]) <= 0.031
    assert all(pair.base is not None and 0.0 <= pair.rover.time - pair.base.time < 1.0 for pair, _ in solved[20:])


def test_a_silent_base_is_not_waited_for() -> None:
    solved = run_live([(t, t) for t in tags(400)], [(t, t) for t in tags(10)], PairingOptions(silent_s=10.0))
    waits = {round(pair.rover.time - START, 3): instant - (pair.rover.time - START) for pair, instant in solved}
    assert len(solved) == 400
    assert max(wait for tag, wait in waits.items() if tag > 13.0) <= 1e-9
    assert max(waits.values()) <= 1.0 + 1e-9


def test_a_base_from_the_future_is_never_used_live() -> None:
    solved = run_live([(1.0, 1.0)], [(0.5, 5.0)], PairingOptions())
    assert solved[0][0].base is None


def test_overload_drops_the_oldest_and_counts_it() -> None:
    pairing = Pairing(PairingOptions(capacity=3))
    for k in range(5):
        pairing.add_rover(epoch_at(k), 0.0)
    assert pairing.counters.rover_dropped == 2
    pair = pairing.next_pair(10.0)
    assert pair is not None
    assert pair.rover.time == START + 2.0


def test_duplicates_and_late_rover_epochs_are_counted_not_solved() -> None:
    pairing = Pairing(PairingOptions(has_base=False))
    for tag in (1.0, 1.0, 2.0):
        pairing.add_rover(epoch_at(tag), 0.0)
    assert [p.rover.time - START for p in iter(lambda: pairing.next_pair(0.0), None)] == [1.0, 2.0]
    pairing.add_rover(epoch_at(1.5), 0.0)
    pairing.add_rover(epoch_at(2.0), 0.0)
    assert (pairing.counters.rover_duplicates, pairing.counters.rover_late, len(pairing)) == (2, 1, 0)


def replay(rovers: list[float], bases: list[float], order: list[bool], options: PairingOptions) -> list[tuple[float, float | None]]:
    """Interleave two streams as ``order`` says (True: next of the rover's); return (rover tag, base tag) of the pairs."""
    return [(rover, base) for rover, base, _ in replayed(rovers, bases, order, options)]


def replayed(
    rovers: list[float], bases: list[float], order: list[bool], options: PairingOptions
) -> list[tuple[float, float | None, float | None]]:
    """Return the tag of the base epoch after the rover's as well, where both may be interpolated."""
    pairing, pairs = Pairing(options), []
    queues = {True: list(rovers), False: list(bases)}
    for pick in [*order, *[True] * len(rovers), *[False] * len(bases)]:
        if queues[pick]:
            tag = queues[pick].pop(0)
            (pairing.add_rover if pick else pairing.add_base)(epoch_at(tag), 0.0)
        pairs += iter(lambda: pairing.next_pair(0.0), None)
    pairing.end_base()
    pairs += iter(lambda: pairing.next_pair(0.0), None)
    return [(p.rover.time - START, *(None if e is None else e.time - START for e in (p.base, p.later))) for p in pairs]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), max_size=80), st.sets(st.integers(0, 39), max_size=30), st.integers(1, 5))
def test_replay_pairs_do_not_depend_on_how_the_streams_were_interleaved(order: list[bool], lost: set[int], slower: int) -> None:
    rovers = [k * 0.5 for k in range(40)]
    bases = [k * 0.5 * slower for k in range(40) if k not in lost]
    options = PairingOptions(replay=True)
    expected = replay(rovers, bases, [False] * len(bases), options)
    assert replay(rovers, bases, order, options) == expected
    assert [rover for rover, _ in expected] == pytest.approx(rovers)
    for rover, base in expected:
        past, future = [b for b in bases if b <= rover + 0.025], [b for b in bases if b > rover]
        assert base == (pytest.approx(max(past) if past else min(future)) if bases else None)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.booleans(), max_size=80))
def test_in_replay_a_base_from_the_future_serves_where_the_past_has_none(order: list[bool]) -> None:
    """At the start of the base's log and after a gap beyond ``silent_s``, however the streams are interleaved."""
    rovers, bases = [float(t) for t in range(1, 60)], [8.0, 9.0, 10.0, *(float(t) for t in range(50, 60))]
    for tag, base in replay(rovers, bases, order, PairingOptions(replay=True, silent_s=30.0)):
        assert base == (8.0 if tag < 8.0 else tag if tag in bases else 10.0 if tag <= 40.0 else 50.0), tag
    matched = replay(rovers, bases, order, PairingOptions(replay=True, matched_only=True))
    assert all(base in (None, tag) for tag, base in matched)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.booleans(), min_size=100, max_size=700), st.sets(st.integers(60, 119), max_size=20), st.sampled_from([1.0, 0.4]))
def test_replays_of_an_orderly_base_do_not_depend_on_interleaving_either(order: list[bool], lost: set[int], slower: float) -> None:
    """Where the log's cadence ends the wait early."""
    rovers = [k * 0.2 for k in range(500)]
    bases = [k * slower for k in range(120) if k not in lost]
    options = PairingOptions(replay=True)
    expected = replay(rovers, bases, [False] * len(bases), options)
    assert replay(rovers, bases, order, options) == expected
    assert all(base == pytest.approx(max(b for b in bases if b <= rover + 0.025)) for rover, base in expected)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.booleans(), max_size=300), st.sets(st.integers(0, 119), max_size=80), st.sampled_from([0.5, 2.0, 7.0]), st.booleans())
def test_where_bases_are_interpolated_both_sides_are_given(order: list[bool], lost: set[int], slower: float, swapped: bool) -> None:
    """The base epochs next to the rover's, at most ``silent_s`` apart, however the streams are interleaved; a match stands alone."""
    if swapped:  # by less than is waited for
        slower, lost = min(slower, 2.0), set(sorted(lost)[:20])
    rovers, bases = [k * 0.5 for k in range(160)], [k * slower for k in range(120) if k not in lost]
    arriving = [base for pair in zip(bases[1::2], bases[::2], strict=False) for base in pair] if swapped else bases
    options = PairingOptions(replay=True, interpolate=True, silent_s=30.0, maximum_wait_s=60.0)
    expected = replayed(rovers, arriving, [False] * len(arriving), options)
    assert replayed(rovers, arriving, order, options) == expected
    for rover, base, later in expected:
        assert later is None or (base is not None and base < rover < later <= base + 30.0)
        if not swapped:
            past, future = [b for b in bases if b <= rover], [b for b in bases if b > rover]
            between = bool(past) and rover not in past and bool(future) and min(future) - max(past) <= 30.0
            assert later == (pytest.approx(min(future)) if between else None)
            assert not past or rover - max(past) > 30.0 or base == pytest.approx(max(past))


@settings(max_examples=100, deadline=None)
@given(st.data(), st.booleans(), st.sampled_from([0.02, 0.5, 1.0, 5.0]))
def test_replay_pairs_do_not_depend_on_interleaving_however_the_base_is_reordered(
    data: st.DataObject, interpolate: bool, step: float
) -> None:
    """By much more than is waited for, and with epochs that come again: pairs are those of a buffer that forgets nothing."""
    count = data.draw(st.integers(60, 160))
    late = data.draw(st.dictionaries(st.integers(0, count - 1), st.integers(1, 100), max_size=8))
    again = data.draw(st.dictionaries(st.integers(0, count - 1), st.integers(1, 100), max_size=4))
    places = [(k + late.get(k, 0), k) for k in range(count)] + [(k + after, k) for k, after in again.items()]
    bases = [k * step for _, k in sorted(places)]
    rovers = [k * 0.5 + data.draw(st.sampled_from([0.0, 0.015])) for k in range(data.draw(st.integers(20, 100)))]
    order = data.draw(st.lists(st.booleans(), max_size=len(rovers) + len(bases)))
    options = PairingOptions(replay=True, interpolate=interpolate, maximum_wait_s=data.draw(st.sampled_from([1.0, 10.0])))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Pairing, "_forget", lambda *_: None)
        expected = replayed(rovers, bases, [False] * len(bases), options)
    assert replayed(rovers, bases, order, options) == expected
    assert replayed(rovers, bases, [False] * len(bases), options) == expected


def test_only_recordings_know_the_next_base_epoch() -> None:
    with pytest.raises(OptionError, match="in recordings alone"):
        PairingOptions(interpolate=True)


def test_a_replayed_rover_does_not_wait_for_epochs_that_an_orderly_slow_base_never_sends() -> None:
    """Once 50 base epochs came in order, an epoch between two of a 1 Hz base is solved when it comes."""
    pairing = Pairing(PairingOptions(replay=True))
    for k in range(61):
        pairing.add_base(epoch_at(float(k)), 0.0)
    pairing.add_rover(epoch_at(60.2), 0.0)
    pairing.add_rover(epoch_at(61.0), 0.0)
    pair = pairing.next_pair(0.0)
    assert pair is not None
    assert pair.base is not None
    assert (pair.rover.time - START, pair.base.time - START) == (pytest.approx(60.2), 60.0)
    assert pairing.next_pair(0.0) is None, "its own base epoch is due"


def test_replayed_rover_epochs_are_never_dropped() -> None:
    pairing = Pairing(PairingOptions(replay=True, capacity=4))
    for k in range(50):
        pairing.add_rover(epoch_at(k), 0.0)
    pairing.end_base()
    pairs = list(iter(lambda: pairing.next_pair(0.0), None))
    assert len(pairs) == 50
    assert all(b.rover.time > a.rover.time for a, b in pairwise(pairs))


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-3.0, 3.0), st.sampled_from([0.2, 1.0, 5.0])), min_size=55, max_size=140), st.floats(-2.0, 30.0))
def test_what_is_known_of_the_base_equals_its_definitions(steps: list[tuple[float, float]], ahead_s: float) -> None:
    """Cadence and end of waiting are kept up to date epoch by epoch: both equal what all epochs at hand say, however these came."""
    pairing, at_s = Pairing(PairingOptions(replay=True)), 0.0
    for back_s, step_s in steps:
        at_s += step_s
        pairing.add_base(epoch_at(at_s + (back_s if back_s > 2.5 else 0.0)), at_s)
        gaps = [b.epoch.time - a.epoch.time for a, b in pairwise(pairing._bases[-21:])]
        assert pairing._interval_s() == (min(gaps) if len(gaps) > 1 else -np.inf)
    time = START + (at_s - ahead_s)
    ends = [base.order for base in pairing._bases if pairing._ends_wait(base, base.epoch.time - time)]
    assert pairing._cut(time) == min(ends, default=np.inf)
