"""Ordered fail-over between sources: when it happens, and what consumers see of it."""

from itertools import islice

import numpy as np
import pytest

from rtkmesh.gnss.epoch import SLIP
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import EVENT, OBS, REF, STATUS, Role
from rtkmesh_schemas.observation import Observation, ReferenceMessage
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ingest.failover import Failover
from rtkmesh_services.ingest.links import Chunk, LinkReport, LinkState
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.mapping.observation import epoch_of
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

START = GpsTime(2400, 7200.0)


def test_the_next_source_is_opened_after_silence_and_used_with_its_first_frame():
    failover = Failover(3, 10.0, 60.0, 100.0)
    assert not failover.silent(109.0)
    assert failover.silent(111.0)
    assert failover.running == 2
    assert not failover.silent(120.0), "each one has its time"
    assert failover.silent(122.0)
    assert not failover.silent(140.0), "there are no more"
    assert failover.heard(1, 141.0)
    assert (failover.active, failover.running) == (1, 2)


def test_a_better_source_comes_back_when_it_has_been_steady():
    failover = Failover(2, 10.0, 60.0, 0.0)
    assert not failover.heard(0, 1.0)
    assert failover.silent(12.0)
    assert failover.heard(1, 13.0)
    for second in range(14, 100):
        failover.heard(1, float(second))
        if second in (20, 21) or second > 40:  # a visit, then for good
            switched = failover.heard(0, float(second))
            assert switched == (second == 101)
    assert not failover.heard(0, 100.0)
    assert failover.heard(0, 101.0)
    assert (failover.active, failover.running) == (0, 1)


def test_a_source_that_fails_while_a_better_one_is_back_is_left_at_once():
    failover = Failover(2, 10.0, 60.0, 0.0)
    assert failover.silent(11.0)
    assert failover.heard(1, 12.0)
    assert not failover.heard(0, 20.0)
    assert failover.heard(0, 23.0)


def test_a_single_source_is_never_left():
    failover = Failover(1, 10.0, 60.0, 0.0)
    assert not failover.silent(1000.0)
    assert not failover.heard(0, 2000.0)


class World:
    """An ingest with two sources; the test says what they bring."""

    def __init__(self) -> None:
        table = IngestTable(source="ntrip://127.0.0.1:1/A", fallback=("tcp://127.0.0.1:1",), fallback_after_s=5.0, return_after_s=3.0)
        self.clock = ManualClock(utc_ns=int(START.to_utc().timestamp()) * 1_000_000_000)
        self.bus = MemoryBus("base", MemoryNetwork())
        deployment = Deployment(ingest={"base": table})
        service = IngestService(Context(id="base", role=Role.INGEST, deployment=deployment, bus=self.bus, clock=self.clock))
        assert service._live is not None
        service._live.start = lambda: None
        self.life = Lifecycle(service, warm_in_thread=False)
        self.life.start()
        self.life.step(0.0)
        self.streams = [open_stream("demo", name, seed=3, rate_hz=1.0, start=START).epochs() for name in ("base", "rover")]

    def play(self, *sources: int, seconds: int = 1) -> None:
        """Let a second pass in which these sources bring an epoch."""
        for _ in range(seconds):
            self.clock.advance(1.0)
            for number, stream in enumerate(self.streams):
                data = next(stream).data
                if number in sources:
                    self.life.context.inbox.put(Chunk(data, self.clock.mono_ns(), number), lane="source")
            while self.life.context.inbox.depth():
                self.life.step(0.0)
            self.life.step(0.0)

    def epochs(self) -> list[Observation]:
        return [decode(Observation, sample.payload) for sample in self.bus.sent(OBS)]

    def references(self) -> list[ReferenceMessage]:
        return [decode(ReferenceMessage, sample.payload) for sample in self.bus.sent(REF)]

    def status(self) -> ServiceStatus:
        return decode(ServiceStatus, self.bus.sent(STATUS)[-1].payload)


@pytest.fixture
def world() -> World:
    return World()


def slipped(observation: Observation) -> bool:
    epoch = epoch_of(observation)
    return bool(np.all(epoch.flags[np.isfinite(epoch.phase_cyc)] & SLIP))


def test_another_base_means_another_place_and_new_phases(world: World):
    world.play(0, seconds=8)
    first = world.references()[-1]
    assert first.position_ecef_m is not None
    assert not slipped(world.epochs()[-1])
    world.play(seconds=7)
    world.life.context.inbox.put(LinkReport(LinkState.ERROR, "ntrip://127.0.0.1:1/A: 401 Unauthorized"), lane="source")
    before = len(world.epochs())
    world.play(1)
    [epoch] = world.epochs()[before:]
    assert slipped(epoch)
    assert world.references()[-1].position_ecef_m is None, "the fallback has not said where it is, the first one's place is not its"
    numbers = [row.sequence for row in (*world.epochs(), *world.references())]
    assert len(numbers) == len(set(numbers)), "one stream goes on"
    world.play(1)
    assert not slipped(world.epochs()[-1])
    status = world.status()
    assert (status.state, status.data["source"]) == (State.DEGRADED, 1)
    assert status.reason.startswith("using fallback 1")
    assert "the first choice: ntrip://127.0.0.1:1/A: 401 Unauthorized" in status.reason
    assert [row.name for row in status.inputs] == ["tcp", "ntrip"]


def test_the_first_choice_comes_back_with_the_place_that_it_has_said_meanwhile(world: World):
    world.play(0, seconds=8)
    place = world.references()[-1].position_ecef_m
    world.play(seconds=7)
    world.play(1, seconds=3)
    before = len(world.epochs())
    world.play(0, 1, seconds=3)
    assert len(world.epochs()) == before + 3, "of two sources one is used"
    world.play(0, 1)
    assert slipped(world.epochs()[-1])
    assert world.references()[-1].position_ecef_m == place
    assert world.status().data["source"] == 0
    codes = [decode(Event, sample.payload).code for level in ("info", "warning") for sample in world.bus.sent(EVENT, level=level)]
    assert codes.count("source_switched") == 2
    assert codes.count("source_fallback") == 1


def test_what_a_closed_source_still_had_on_its_way_is_not_used(world: World):
    world.play(0, seconds=2)
    data = b"".join(epoch.data for epoch in islice(world.streams[1], 2))
    world.life.context.inbox.put(Chunk(data, world.clock.mono_ns(), 1), lane="source")
    before = len(world.epochs())
    world.play()
    assert len(world.epochs()) == before


def test_another_nearest_mount_point_is_another_antenna(world: World):
    world.life.context.inbox.put(LinkReport(LinkState.CONNECTED, "ntrip://127.0.0.1:1/A (ICY)"), lane="source")
    world.play(0, seconds=2)
    for detail, other in (("ntrip://127.0.0.1:1/A (HTTP/1.1)", False), ("ntrip://127.0.0.1:1/B (ICY)", True)):
        world.life.context.inbox.put(LinkReport(LinkState.CONNECTED, detail), lane="source")
        world.play(0)
        assert slipped(world.epochs()[-1]) == other
