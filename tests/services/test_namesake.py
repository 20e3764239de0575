"""Two processes of one id: the younger ends and says why, the older stays."""

import pytest

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.keys import STATUS, Role
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_services.errors import NamesakeError
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.namesake import Namesake
from rtkmesh_services.runtime.service import Context


class Ours:
    """A process called rover, and another's statuses on its key."""

    def __init__(self, role: Role = Role.INGEST) -> None:
        self.clock = ManualClock()
        self.network = MemoryNetwork(self.clock)
        self.context = Context(id="rover", role=role, deployment=Deployment(), bus=MemoryBus("rover", self.network), clock=self.clock)
        self.namesake = Namesake(self.context)
        self.handles = self.namesake.watch()
        self.other = MemoryBus("rover", self.network)

    def hear(self, heartbeat: int, uptime_s: float, *, start_id: str = "another", state: State = State.RUNNING) -> None:
        status = ServiceStatus(
            id="rover", role="ingest", state=state, start_id=start_id, heartbeat=heartbeat, pid=77, host="boat", uptime_s=uptime_s
        )
        self.other.publish(STATUS, status)


def test_the_younger_ends_with_the_name_of_the_older():
    """Two heartbeats of an older process are enough."""
    ours = Ours()
    ours.hear(41, 100.0)
    ours.namesake.require_none()
    ours.hear(42, 101.0)
    with pytest.raises(NamesakeError, match=r"'rover'.*pid 77 on boat, up for 101 s"):
        ours.namesake.require_none()


def test_the_older_stays():
    """What began after us is the other's trouble."""
    ours = Ours()
    ours.clock.advance(50.0)
    for beat in range(5):
        ours.hear(beat, 1.0 + beat)
    ours.namesake.require_none()


@pytest.mark.parametrize("state", [State.STOPPED, State.FAILED])
def test_one_that_ends_is_no_namesake(state: State):
    """The last words of a process that is replaced."""
    ours = Ours()
    ours.hear(8, 9.0)
    ours.hear(9, 10.0, state=state)
    ours.namesake.require_none()


def test_own_heartbeats_and_noise_do_not_count():
    """A bus gives back what we publish, and anybody may write anything on a key."""
    ours = Ours()
    for beat in range(3):
        ours.hear(beat, 1e6, start_id=ours.context.start_id)
    ours.other.publish(STATUS, b"\xff not a status")
    ours.namesake.require_none()


def test_hubs_and_controls_may_be_many():
    """Joined networks have one on each host."""
    assert Ours(Role.CONTROL).handles == []
    assert Ours(Role.HUB).handles == []
