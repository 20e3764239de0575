"""The door into a work loop."""

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import PATIENCE_S

from rtkmesh_services.runtime.inbox import Inbox


def drained(inbox: Inbox) -> list[object]:
    """Take all that waits."""
    return [inbox.get(0.0) for _ in range(inbox.depth())]


def test_items_leave_in_the_order_of_arrival_over_all_lanes():
    """Lanes share one order: rover and base epochs are handled as they came."""
    inbox = Inbox()
    for number in range(10):
        inbox.put(number, lane="even" if number % 2 == 0 else "odd")
    assert drained(inbox) == list(range(10))


def test_urgent_lanes_come_first():
    """A command is answered before the queue of epochs is done."""
    inbox = Inbox()
    inbox.lane("command", urgent=True)
    inbox.put("epoch")
    inbox.put("stop", lane="command")
    assert drained(inbox) == ["stop", "epoch"]


def test_a_full_lane_drops_its_oldest_and_counts():
    """A stream never grows; what went is counted and told."""
    gone: list[object] = []
    inbox = Inbox(capacity=100)
    inbox.lane("obs", capacity=3, on_drop=gone.append)
    for number in range(5):
        inbox.put(number, lane="obs")
    assert drained(inbox) == [2, 3, 4]
    assert gone == [0, 1]
    assert inbox.dropped() == {"obs": 2}


def test_latest_wins_per_key():
    """Only the newest of each key is kept, at the first one's place."""
    inbox = Inbox()
    for key, item in (("a", 1), ("b", 2), ("a", 3)):
        inbox.put(item, key=key)
    assert drained(inbox) == [3, 2]
    assert inbox.dropped() == {}


@given(st.lists(st.tuples(st.sampled_from(["x", "y"]), st.sampled_from([None, "k", "l"]), st.booleans()), max_size=60))
def test_the_size_is_always_that_of_the_lanes(steps: list[tuple[str, str | None, bool]]):
    """Any mixture of puts and gets keeps the bound and the count."""
    inbox, taken = Inbox(capacity=4), 0
    for number, (lane, key, get) in enumerate(steps):
        inbox.put(number, lane=lane, key=key)
        if get:
            taken += inbox.get(0.0) is not None
        assert inbox.depth() == inbox.depth("x") + inbox.depth("y")
        assert inbox.depth("x") <= 4
    assert len(drained(inbox)) + taken + sum(inbox.dropped().values()) <= len(steps)
    assert inbox.get(0.0) is None


def test_get_waits_for_a_put_of_another_thread():
    """The work loop sleeps until something comes."""
    inbox = Inbox()
    threading.Timer(0.05, inbox.put, ["late"]).start()
    assert inbox.get(PATIENCE_S) == "late"


@pytest.mark.parametrize("before_s", [0.0, 0.05])
def test_wake_ends_a_wait(before_s: float):
    """A signal does not wait for the next epoch, also when it comes just before the wait; it ends one wait only."""
    inbox, began = Inbox(), time.monotonic()
    if before_s:
        threading.Timer(before_s, inbox.wake).start()
    else:
        inbox.wake()
    assert inbox.get(PATIENCE_S) is None
    assert time.monotonic() - began < PATIENCE_S / 2.0
    threading.Timer(0.05, inbox.put, ["later"]).start()
    assert inbox.get(PATIENCE_S) == "later"


def test_put_wait_paces_a_reader():
    """A replay's thread waits for room and loses nothing."""
    inbox = Inbox()
    inbox.lane("replay", capacity=2)
    sent: list[bool] = []
    reader = threading.Thread(target=lambda: sent.extend(inbox.put_wait(n, lane="replay", timeout_s=PATIENCE_S) for n in range(50)))
    reader.start()
    got = [inbox.get(PATIENCE_S) for _ in range(50)]
    reader.join(PATIENCE_S)
    assert got == list(range(50))
    assert all(sent)
    assert inbox.dropped() == {}


def test_put_wait_gives_up_in_time_and_at_the_end():
    """A reader is not stuck behind a loop that hangs or has ended."""
    inbox = Inbox()
    inbox.lane("replay", capacity=1)
    assert inbox.put_wait(1, lane="replay", timeout_s=0.0)
    assert not inbox.put_wait(2, lane="replay", timeout_s=0.01)
    assert inbox.close() == [1]
    assert not inbox.put_wait(3, lane="replay", timeout_s=PATIENCE_S)


def test_closed_takes_nothing():
    """After the end nothing is kept and nobody waits."""
    inbox = Inbox()
    inbox.close()
    inbox.put(1)
    assert inbox.get(PATIENCE_S) is None


def test_a_lane_is_declared_once():
    """Two owners of one lane are a fault of the code."""
    inbox = Inbox()
    inbox.lane("a")
    with pytest.raises(ValueError, match="twice"):
        inbox.lane("a")


def test_many_producers_lose_nothing_below_the_bound():
    """Eight threads at once: all items arrive, each thread's in order."""
    inbox = Inbox(capacity=10_000)
    threads = [threading.Thread(target=lambda t=t: [inbox.put((t, n)) for n in range(500)]) for t in range(8)]
    for thread in threads:
        thread.start()
    got = [inbox.get(PATIENCE_S) for _ in range(4000)]
    for thread in threads:
        thread.join()
    for number in range(8):
        assert [item[1] for item in got if item is not None and item[0] == number] == list(range(500))
