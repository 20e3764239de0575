"""A raw u-blox becomes an RTCM 3 base: its ingest makes the frames, an output sends them, another ingest reads them; fixes are the same."""

from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from tests.services.roles_in_one_process import Site, settle

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream, truth
from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable, SolverTable
from rtkmesh_schemas.keys import MADE, SOL, STATUS, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.output.service import create as create_output
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.configuration import load_deployment
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context, Service
from rtkmesh_services.solver.service import SolverService

START = GpsTime(2400, 7200.0)
SEED, RATE_HZ = 3, 5.0
INGESTS = {"rover": "heading", "base": "rover"}  # both antennas of the vehicle send UBX


class World:
    """Rover and base as raw u-blox receivers; ``again`` reads what the base's output sends."""

    def __init__(self, folder: Path, *, solving: bool = False, **encoding: object) -> None:
        antennas = truth("static", seed=SEED)(START).antennas_ecef_m
        base = tuple(float(value) for value in antennas["rover"])
        self.rover_ecef_m = antennas["heading"]
        self.path = folder / "base.rtcm3"
        output = OutputTable(receiver="base", target=f"file://{self.path}", encode="msm7", **encoding)  # type: ignore[arg-type]
        self.deployment = Deployment(
            ingest={
                "rover": IngestTable(source="tcp://127.0.0.1:1"),
                "base": IngestTable(source="tcp://127.0.0.1:2", position_ecef_m=base),  # type: ignore[arg-type]
                "again": IngestTable(source="tcp://127.0.0.1:3"),
            },
            solver={"raw": SolverTable(rover="rover", base="base"), "made": SolverTable(rover="rover", base="again")} if solving else {},
            output={"radio": output},
        )
        self.network, self.clock = MemoryNetwork(), ManualClock(utc_ns=int(START.to_utc().timestamp()) * 1_000_000_000)
        self.lives: dict[str, Lifecycle] = {}
        self.buses: dict[str, MemoryBus] = {}
        self.network.on_wait = self.settle
        for name in self.deployment.ingest:
            self.begin(name, Role.INGEST, IngestService)
        for name in self.deployment.solver:
            self.begin(name, Role.SOLVER, SolverService)
        self.streams = {
            name: open_stream("static", antenna, seed=SEED, rate_hz=RATE_HZ, start=START).epochs() for name, antenna in INGESTS.items()
        }
        self.taken = 0

    def begin(self, name: str, role: Role, make: Callable[[Context], Service]) -> None:
        self.lives[name], self.buses[name] = Site(self.network, self.clock).begin(name, role, make, self.deployment)
        self.settle()

    def listen(self) -> None:
        self.begin("radio", Role.OUTPUT, create_output)

    def settle(self) -> None:
        settle(self.lives.values())

    def made(self) -> list[bytes]:
        return [sample.payload for sample in self.buses["base"].sent(MADE, output="radio")]

    def play(self, epochs: int) -> None:
        for _ in range(epochs):
            self.clock.advance(1.0 / RATE_HZ)
            for name, stream in self.streams.items():
                [epoch] = islice(stream, 1)
                self.put(name, epoch.data)
            self.settle()
            frames = self.made()
            self.put("again", b"".join(frames[self.taken :]))
            self.taken = len(frames)
            self.settle()

    def put(self, name: str, data: bytes) -> None:
        self.lives[name].context.inbox.put(Chunk(data, self.clock.mono_ns()), lane="source")

    def solutions(self, name: str) -> dict[tuple[int, float], SolutionMessage]:
        found = [decode(SolutionMessage, sample.payload, sample.encoding) for sample in self.buses[name].sent(SOL)]
        return {(message.week, message.tow_s): message for message in found}

    def counters(self) -> dict[str, int]:
        self.clock.advance(1.1)
        self.settle()
        return decode(ServiceStatus, self.buses["base"].sent(STATUS)[-1].payload).counters


def numbers(frames: list[bytes]) -> list[int]:
    return [frame[3] << 4 | frame[4] >> 4 for frame in frames]


def test_fixes_by_the_made_stream_are_those_by_the_raw_one(tmp_path: Path) -> None:
    """After the first epochs both solvers are fixed, within a millimetre of each other and centimetres of the truth."""
    world = World(tmp_path, solving=True)
    world.listen()
    world.play(30)
    raw, made = world.solutions("raw"), world.solutions("made")
    both = [(raw[key], made[key]) for key in sorted(raw.keys() & made.keys()) if raw[key].status_name == made[key].status_name == "FIX"]
    assert len(both) >= 20
    for one, other in both:
        assert np.linalg.norm(np.subtract(one.position_ecef_m, other.position_ecef_m)) < 1.5e-3
        assert np.linalg.norm(np.subtract(one.position_ecef_m, world.rover_ecef_m)) < 0.05
    assert {1006, 1008, 1033, 1019, 1046, 1077, 1097} <= set(numbers(world.made()))
    assert world.counters()["made_radio_epochs"] == 30
    world.lives["radio"].service.close()
    assert world.path.read_bytes() == b"".join(world.made())


def test_nothing_is_made_while_nobody_listens_and_a_newcomer_is_told_all(tmp_path: Path) -> None:
    """The first epoch that an output gets has the station with it and every ephemeris that came before."""
    world = World(tmp_path)
    world.play(12)
    assert world.made() == []
    world.listen()
    world.play(1)
    assert numbers(world.made())[:3] == [1006, 1008, 1033]
    assert numbers(world.made()).count(1019) >= 4
    world.lives["radio"].service.close()


def test_a_radio_gets_what_its_table_says(tmp_path: Path) -> None:
    """One epoch a second with three systems, another station number, and the rate below the budget."""
    world = World(tmp_path, station_id=99, systems="GEC", interval_s=1.0, bytes_per_second=500.0, station_interval_s=2.0)
    world.listen()
    world.play(26)
    frames = world.made()
    assert {int.from_bytes(frame[4:6], "big") & 0xFFF for frame in frames if not 1019 <= numbers([frame])[0] <= 1046} == {99}
    assert {number for number in numbers(frames) if number >= 1070} <= {1077, 1097, 1127}
    assert numbers(frames).count(1077) == world.counters()["made_radio_epochs"] <= 6
    assert sum(map(len, frames)) <= 500.0 * 6.2 + 300.0
    world.lives["radio"].service.close()


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ('receiver = "base"\nencode = "msm6"', "encode"),
        ('receiver = "base"\nencode = "msm7"\nprotocol = "ubx"', "encode makes RTCM 3"),
        ('solver = "rtk"\nencode = "msm7"', "a solver's lines"),
        ('receiver = "base"\nencode = "msm7"\nsystems = "GX"', "systems"),
        ('receiver = "base"\nencode = "msm7"\nstation_id = 4096', "station_id"),
    ],
)
def test_what_cannot_be_is_said_with_its_line(tmp_path: Path, lines: str, text: str) -> None:
    file = tmp_path / "robot.toml"
    ingests = "".join(f'[ingest.{name}]\nsource = "tcp://127.0.0.1:{k}"\n' for k, name in enumerate(("rover", "base"), 1))
    file.write_text(f'{ingests}[solver.rtk]\nrover = "rover"\nbase = "base"\n[output.radio]\ntarget = "file://x"\n{lines}\n')
    with pytest.raises(Exception, match=text) as caught:
        load_deployment(file)
    assert "robot.toml" in str(caught.value)
