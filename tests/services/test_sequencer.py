"""Numbered messages come back into stream order, and nothing is lost silently."""

from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_services.solver.sequencer import Sequencer


@given(st.permutations(list(range(12))))
def test_any_order_of_arrival_gives_the_stream_order(order: list[int]) -> None:
    sequencer: Sequencer[int] = Sequencer(complete=True)
    taken = [item for number in order for item in sequencer.take(number, "a", number, 0.0)]
    assert taken == list(range(12))
    assert sequencer.lost == 0


def test_a_missing_message_is_waited_for_then_counted() -> None:
    sequencer: Sequencer[int] = Sequencer(complete=True, hold_s=0.1)
    assert sequencer.take(0, "a", 0, 0.0) == [0]
    assert sequencer.take(3, "a", 3, 1.0) == []
    assert sequencer.overdue(1.05) == []
    assert sequencer.overdue(1.11) == [3]
    assert sequencer.lost == 2
    assert sequencer.take(4, "a", 4, 1.2) == [4]


def test_a_late_joiner_begins_with_the_first_epoch_and_takes_cached_navigation_at_any_time() -> None:
    sequencer: Sequencer[str] = Sequencer()
    assert sequencer.take("eph", "a", 3, 0.0, anchors=False) == ["eph"]
    assert sequencer.take("obs", "a", 700, 0.0) == ["obs"]
    assert sequencer.take("old eph", "a", 5, 0.0, anchors=False) == ["old eph"]
    assert sequencer.take("obs again", "a", 700, 0.0) == []


def test_a_restarted_ingest_begins_anew() -> None:
    sequencer: Sequencer[int] = Sequencer(complete=True)
    sequencer.take(0, "a", 0, 0.0)
    sequencer.take(5, "a", 5, 0.0)
    assert sequencer.take(10, "b", 0, 0.0) == [10]
    assert (sequencer.restarts, sequencer.lost) == (1, 0)


def test_who_joins_a_replay_under_way_waits_for_nothing_before() -> None:
    """Cached navigation data of earlier are taken at once with the first epoch, none of what lies between counts as lost."""
    sequencer: Sequencer[str] = Sequencer(complete=True, hold_s=10.0)
    assert sequencer.take("eph 7", "a", 7, 0.0, anchors=False) == []
    assert sequencer.take("eph 3", "a", 3, 0.0, anchors=False) == []
    assert sequencer.take("obs", "a", 700, 0.0, joins=True) == ["eph 3", "eph 7", "obs"]
    assert sequencer.take("next", "a", 701, 0.0) == ["next"]
    assert sequencer.lost == 0


def test_gaps_are_waited_for_together() -> None:
    """Several gaps cost one wait, not one each; a younger one is still waited for."""
    sequencer: Sequencer[int] = Sequencer(complete=True, hold_s=1.0)
    for number, now_s in ((2, 0.0), (5, 0.1), (9, 0.9)):
        assert sequencer.take(number, "a", number, now_s) == []
    assert sequencer.overdue(1.2) == [2, 5]
    assert sequencer.overdue(2.0) == [9]
    assert sequencer.lost == 7
