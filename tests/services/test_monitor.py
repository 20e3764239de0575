"""The fleet's health: from statuses, tokens and silence to one verdict per process."""

import msgspec
import pytest

from rtkmesh_schemas.config import Deployment, MonitorTable
from rtkmesh_schemas.keys import EVENT, SAT, STATUS, Role
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode, encode, encoding_of
from rtkmesh_services.monitor.health import FleetHealth, Health, stale_after_s
from rtkmesh_services.monitor.service import MonitorService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.inbox import Inbox
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context


def status(state: State = State.RUNNING, reason: str = "", **more: object) -> ServiceStatus:
    values = {"id": "rtk", "role": "solver", "state": state, "start_id": "a", "heartbeat": 1, "reason": reason, **more}
    return msgspec.convert(values, ServiceStatus, from_attributes=True)


def living(state: State = State.RUNNING, reason: str = "", **more: object) -> FleetHealth:
    health = FleetHealth()
    health.live("rtk", "solver", 100.0, alive=True)
    health.status(status(state, reason, **more), 100.0)
    return health


def verdict(health: FleetHealth, now_s: float) -> tuple[Health, str]:
    health.check(now_s)
    row = health.table(now_s)["rtk"]
    return Health(row["health"]), row["reason"]


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (State.RUNNING, Health.OK),
        (State.WARMING, Health.STARTING),
        (State.DEGRADED, Health.DEGRADED),
        (State.STALE, Health.STALE),
        (State.STOPPED, Health.STOPPED),
        (State.FAILED, Health.FAILED),
    ],
)
def test_what_a_fresh_process_says_of_itself_holds(state: State, expected: Health) -> None:
    assert verdict(living(state, "why"), 101.0) == (expected, "why")


def test_what_a_monitor_says_of_others_is_not_said_of_it() -> None:
    """Else its own reason would come back as a reason, longer every second."""
    health = living()
    health.status(status(State.DEGRADED, "rtk stale", id="watch", role="monitor"), 100.0)
    assert health.check(101.0)
    assert (health.bad(), health.table(101.0)["watch"]["health"]) == ({}, "ok")


def test_limit_of_silence_follows_from_the_table_of_streams() -> None:
    assert stale_after_s(STATUS) == 10.0


def test_silent_process_with_a_token_is_hung_and_without_one_gone() -> None:
    health = living()
    assert verdict(health, 109.9)[0] is Health.OK
    assert verdict(health, 110.5) == (Health.STALE, "no status for 10 s: hung")
    health.live("rtk", "solver", 111.0, alive=False)
    assert verdict(health, 111.1)[0] is Health.GONE
    health.live("rtk", "solver", 112.0, alive=True)
    health.status(status(start_id="b"), 112.0)
    assert verdict(health, 112.1)[0] is Health.OK


def test_silent_stream_makes_a_running_process_stale_but_not_a_stopped_or_ended_one() -> None:
    health = living()
    health.heard(SAT, "rtk", 100.0)
    health.status(status(), 115.0)
    assert verdict(health, 115.0) == (Health.STALE, "silent: sat")
    health.status(status(State.STOPPED), 116.0)
    assert verdict(health, 116.0)[0] is Health.STOPPED
    health.status(status(data={"end": True}), 117.0)
    assert verdict(health, 117.0)[0] is Health.OK


def test_change_is_told_once_and_growing_figures_are_no_change() -> None:
    health = living()
    health.check(100.0)
    assert [(id_, now.health) for id_, _, now in health.check(111.0)] == [("rtk", Health.STALE)]
    assert health.check(112.0) == []
    assert set(health.bad()) == {"rtk"}


def test_process_that_left_long_ago_is_forgotten() -> None:
    health = living()
    health.live("rtk", "solver", 101.0, alive=False)
    health.check(102.0)
    assert "rtk" in health.table(102.0)
    health.check(1000.0)
    assert health.table(1000.0) == {}


def test_service_publishes_the_fleet_and_an_event_on_change() -> None:
    clock = ManualClock()
    network = MemoryNetwork(clock=clock)
    other, bus = MemoryBus("rtk", network), MemoryBus("watch", network)
    deployment = Deployment(monitor={"watch": MonitorTable(period_s=1.0)})
    context = Context(id="watch", role=Role.MONITOR, deployment=deployment, bus=bus, clock=clock, inbox=Inbox())
    lifecycle = Lifecycle(MonitorService(context), warm_in_thread=False)
    token = other.live_token("solver", "rtk")
    other.publish(STATUS, status(pid=7))
    lifecycle.start()

    def run(seconds: float) -> None:
        for _ in range(round(seconds / 0.1)):
            clock.advance(0.1)
            while context.inbox.depth():
                lifecycle.step(0.0)
            lifecycle.step(0.0)

    run(4.0)
    fleet = decode(ServiceStatus, bus.sent(STATUS)[-1].payload).data["fleet"]
    assert fleet["rtk"]["health"] == "ok"
    assert fleet["watch"]["health"] == "ok"
    token.close()
    run(2.0)
    last = decode(ServiceStatus, bus.sent(STATUS)[-1].payload)
    assert last.state is State.DEGRADED
    assert last.reason.startswith("rtk gone")
    events = [decode(Event, sample.payload) for sample in bus.sent(EVENT, level="error")]
    assert [(event.code, event.data["id"]) for event in events] == [("health_gone", "rtk")]


def test_bytes_that_are_no_status_change_nothing() -> None:
    network = MemoryNetwork(clock=ManualClock())
    bus = MemoryBus("watch", network)
    context = Context(id="watch", role=Role.MONITOR, deployment=Deployment(monitor={"watch": MonitorTable()}), bus=bus, clock=network.clock)
    service = MonitorService(context)
    service.open()
    MemoryBus("evil", network).publish(STATUS, b"\xff\xff", encoding=encoding_of(ServiceStatus))
    MemoryBus("evil", network).publish(STATUS, encode(status())[:-3], encoding=encoding_of(ServiceStatus))
    while (item := context.inbox.get(0.0)) is not None:
        service.handle(item)
    assert service.report().data["fleet"] == {}
