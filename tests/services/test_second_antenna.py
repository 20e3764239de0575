"""A second ingest that takes another one's frames, and what the check says of such sources."""

from itertools import islice
from pathlib import Path

import pytest

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import OBS, RAW, STATUS, WRITE, Role
from rtkmesh_schemas.observation import EphemerisMessage, Observation
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.runtime.bus import Sample
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.configuration import ConfigErrors, load_site
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

START = GpsTime(2400, 7200.0)
TABLES = {"main": IngestTable(source="tcp://127.0.0.1:1"), "second": IngestTable(source="ingest://main?antenna=2")}


class World:
    """Two ingests on one network; the test is the receiver."""

    def __init__(self) -> None:
        self.network, self.deployment = MemoryNetwork(), Deployment(ingest=TABLES)
        self.clock = ManualClock(utc_ns=int(START.to_utc().timestamp()) * 1_000_000_000)
        self.lives = {name: self._life(name) for name in TABLES}

    def _life(self, name: str) -> Lifecycle:
        bus = MemoryBus(name, self.network)
        service = IngestService(Context(id=name, role=Role.INGEST, deployment=self.deployment, bus=bus, clock=self.clock))
        if name == "main":
            assert service._live is not None
            service._live.start = lambda: None
        life = Lifecycle(service, warm_in_thread=False)
        life.start()
        life.step(0.0)
        return life

    def send(self, data: bytes) -> None:
        self.lives["main"].context.inbox.put(Chunk(data, self.clock.mono_ns()), lane="source")
        self.clock.advance(1.0)
        for life in (*self.lives.values(), *self.lives.values()):
            while life.context.inbox.depth():
                life.step(0.0)
            life.step(0.0)

    def sent(self, name: str) -> list[Observation]:
        bus = self.lives[name].context.bus
        assert isinstance(bus, MemoryBus)
        return [decode(Observation, sample.payload) for sample in bus.sent(OBS)]


def test_the_second_antenna_comes_from_the_first_ingests_frames():
    """The same instants, other observations, the ephemerides too; the frames are published once."""
    world, listener, orbits = World(), MemoryBus("listener", MemoryNetwork()), list[Sample]()
    listener = MemoryBus("listener", world.network)
    listener.subscribe("rtk/second/eph/*", orbits.append)
    frames: list[Sample] = []
    listener.subscribe(RAW.key("second", protocol="*"), frames.append)
    for epoch in islice(open_stream("demo", "rover+heading", seed=3, rate_hz=1.0, start=START).epochs(), 4):
        world.send(epoch.data)
    main, second = world.sent("main"), world.sent("second")
    assert [(o.week, o.tow_s) for o in main] == [(o.week, o.tow_s) for o in second]
    assert len(second) == 4
    assert main[0].pseudorange_m != second[0].pseudorange_m
    assert len({decode(EphemerisMessage, sample.payload).orbit.satellite for sample in orbits}) > 15
    assert frames == []
    bus = world.lives["second"].context.bus
    assert isinstance(bus, MemoryBus)
    status = decode(ServiceStatus, bus.sent(STATUS)[-1].payload)
    assert status.state is State.RUNNING
    assert (status.inputs[0].name, status.inputs[0].state, status.inputs[0].detail) == ("ingest", "connected", "ingest main")


def test_what_is_written_to_the_second_goes_to_the_receiver():
    """Through the first ingest."""
    world, written = World(), list[Sample]()
    listener = MemoryBus("listener", world.network)
    listener.subscribe(WRITE.key("main"), written.append)
    listener.publish_as("second", WRITE, b"corrections")
    world.send(b"")
    assert [sample.payload for sample in written] == [b"corrections"]


@pytest.mark.parametrize(
    ("main", "second", "fault"),
    [
        ('source = "tcp://127.0.0.1:1"\nraw = false', "ingest://main?antenna=2", "publishes no frames: raw = false"),
        ('source = "file:///log"', "ingest://main?antenna=2", "is a recording: play it twice, the second time with ?antenna=2"),
        ('source = "tcp://127.0.0.1:1"', "ingest://second?antenna=2", "takes its frames from an ingest itself"),
        ('source = "tcp://127.0.0.1:1"', "ingest://mian?antenna=2", "no [ingest.mian]; did you mean 'main'?"),
    ],
)
def test_ingests_that_cannot_be_followed_are_named(tmp_path: Path, main: str, second: str, fault: str):
    """With the line of the source."""
    file = tmp_path / "d.toml"
    file.write_text(f'[ingest.main]\n{main}\n[ingest.second]\nsource = "{second}"\n')
    with pytest.raises(ConfigErrors) as caught:
        load_site(file, tmp_path)
    (error,) = caught.value.errors
    assert fault in error.message
    assert error.line == main.count("\n") + 4


@pytest.mark.parametrize("url", ["ingest://Main?antenna=2", "ingest://?antenna=2", "ingest://main?antenna=3", "ingest://main?rate=2"])
def test_urls_of_ingests_are_checked(url: str):
    """Ids, antennas, options."""
    with pytest.raises(SourceError):
        parse_source(url)


def test_antennas_of_sources():
    """The first one if nothing is said."""
    urls = ("serial:///dev/x", "serial:///dev/x?antenna=2", "file://a?antenna=2", "sim://a/b")
    assert [parse_source(url).antenna for url in urls] == [1, 2, 2, 1]
