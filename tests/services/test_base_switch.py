"""A solver changes its base while it runs: ingests and solver as they are, on an in-memory bus, with two simulated bases."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from tests.services.roles_in_one_process import Site, settle

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import SimulatedEpoch, open_stream, truth
from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.config import Deployment, IngestTable, SolverTable
from rtkmesh_schemas.keys import CMD, EVENT, OBS, SOL, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import Event, Level, ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.solver.service import SolverService

START = GpsTime(2400, 7200.0)
START_UTC_NS = int(START.to_utc().timestamp()) * 1_000_000_000
RATE_HZ = 5.0
FIX = 1
ANTENNAS = {"rover": "rover", "base": "base", "other": "base2"}


@dataclass
class World:
    """Rover, its base, another base that is not of the solver's file, and the solver. ``silent`` receivers send nothing."""

    folder: Path
    other: IngestTable = field(default_factory=lambda: IngestTable(source="tcp://127.0.0.1:3"))
    navigation: tuple[str, ...] = ()
    silent: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.network, self.clock = MemoryNetwork(), ManualClock(utc_ns=START_UTC_NS)
        self.asker = MemoryBus("asker", self.network)
        self.lives: dict[str, Lifecycle] = {}
        self.buses: dict[str, MemoryBus] = {}
        self.streams = {
            name: open_stream("two_bases", antenna, seed=3, rate_hz=RATE_HZ, start=START).epochs() for name, antenna in ANTENNAS.items()
        }
        file = {name: IngestTable(source=f"tcp://127.0.0.1:{number}") for number, name in enumerate(("rover", "base"), 1)}
        solver = {"rtk": SolverTable(rover="rover", base="base", navigation=self.navigation)}
        known = {**file, "other": self.other} if "other" in self.navigation else file
        for name in ANTENNAS:
            self._begin(name, Role.INGEST, IngestService, Deployment(ingest={**file, "other": self.other}, solver=solver))
        self._begin("rtk", Role.SOLVER, SolverService, Deployment(ingest=known, solver=solver))
        self.network.on_wait = self.settle
        self.settle()

    def _begin(self, name: str, role: Role, make: type, deployment: Deployment) -> None:
        self.lives[name], self.buses[name] = Site(self.network, self.clock, self.folder).begin(name, role, make, deployment)

    def settle(self) -> None:
        settle(self.lives.values())

    def play(self, epochs: int) -> None:
        for _ in range(epochs):
            self.clock.advance(1.0 / RATE_HZ)
            for name, stream in self.streams.items():
                epoch: SimulatedEpoch = next(stream)
                if name not in self.silent:
                    self.lives[name].context.inbox.put(Chunk(epoch.data, self.clock.mono_ns()), lane="source")
            self.settle()

    def solutions(self) -> list[SolutionMessage]:
        return [decode(SolutionMessage, sample.payload, sample.encoding) for sample in self.buses["rtk"].sent(SOL)]

    def events(self, code: str) -> list[Event]:
        events = [decode(Event, sample.payload) for level in Level for sample in self.buses["rtk"].sent(EVENT, level=level.value)]
        return [event for event in events if event.code == code]

    def status(self) -> ServiceStatus:
        return self.lives["rtk"].status()

    def ask(self, parameters: str) -> Reply:
        [answer] = self.asker.get(f"{CMD.key('rtk')}?{parameters}", timeout_s=1.0)
        return decode(Reply, answer.payload, answer.encoding)


def errors_m(solutions: list[SolutionMessage]) -> np.ndarray:
    at = truth("two_bases", seed=3)
    return np.array([np.linalg.norm(s.position_ecef_m - at(GpsTime(s.week, s.tow_s)).antennas_ecef_m["rover"]) for s in solutions])


def test_another_base_costs_no_epoch_and_its_jump_is_told(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.play(15)
    reply = world.ask("op=base&id=other")
    assert (reply.code, reply.data) == (Code.ACCEPTED, {"base": "base", "next": "other"})
    assert world.status().data["next_base"] == "other"
    world.play(15)
    solutions = world.solutions()
    assert len(solutions) == 30
    bases = [solution.base for solution in solutions]
    assert bases == ["base"] * bases.index("other") + ["other"] * (30 - bases.index("other"))
    assert bases.index("other") in (16, 17, 18)  # its third epoch, when its cadence is known
    assert all(solution.status == FIX for solution in solutions[5:])
    assert errors_m(solutions[5:]).max() < 0.05
    [event] = world.events("base_changed")
    assert (event.data["old"], event.data["new"], event.data["significant"]) == ("base", "other", False)
    assert np.linalg.norm(event.data["jump_enu_m"]) < 0.05
    assert np.linalg.norm(np.subtract(event.data["old_position_ecef_m"], event.data["new_position_ecef_m"])) > 3000.0
    assert world.events("base_jump") == []
    status = world.status()
    assert status.data["base"] == "other"
    assert [row.name for row in status.inputs] == ["rover", "other"]
    assert not world.buses["base"].matched(OBS)


def test_and_back_again(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.play(10)
    for name in ("other", "base"):
        world.ask(f"op=base&id={name}")
        world.play(10)
    assert [event.data["new"] for event in world.events("base_changed")] == ["other", "base"]
    assert all(solution.status == FIX for solution in world.solutions()[5:])
    assert world.ask("op=base&id=base").message == "the base is base already"


def test_a_base_with_a_wrong_position_is_a_warning(tmp_path: Path) -> None:
    right = truth("two_bases", seed=3)(START).antennas_ecef_m["base2"].tolist()
    x, y, z = right
    world = World(tmp_path, other=IngestTable(source="tcp://127.0.0.1:3", position_ecef_m=(x + 1.5, y, z)))
    world.play(10)
    world.ask("op=base&id=other")
    world.play(8)
    [event] = world.events("base_jump")
    assert event.level is Level.WARNING
    assert np.linalg.norm(event.data["jump_enu_m"]) == pytest.approx(1.5, abs=0.05)
    assert "the position of one of the bases is wrong" in event.text
    assert len(world.events("base_changed")) == 1


def test_a_silent_base_is_not_used_and_that_is_told(tmp_path: Path) -> None:
    world = World(tmp_path, silent={"other"})
    world.play(10)
    world.ask("op=base&id=other&timeout_s=2")
    world.play(15)
    [event] = world.events("base_not_changed")
    assert "no observations come from it for 2 s; base stays" in event.text
    assert {solution.base for solution in world.solutions()} == {"base"}
    assert all(solution.status == FIX for solution in world.solutions()[5:])
    assert "next_base" not in world.status().data


def test_a_dead_base_is_left_with_the_first_epoch_of_another_one(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.play(10)
    world.silent.add("base")
    world.play(15)
    world.ask("op=base&id=other")
    world.play(7)  # epochs from before it wait for the old one as long as they always do
    assert world.solutions()[-1].base == "other"
    assert world.solutions()[-1].status == FIX
    assert errors_m(world.solutions()[-1:]).max() < 0.05
    assert len(world.solutions()) == 32


def test_a_base_whose_ephemerides_were_taken_before_is_one_input_all_the_time(tmp_path: Path) -> None:
    world = World(tmp_path, navigation=("other", "base"))
    world.play(10)
    world.ask("op=base&id=other")
    world.play(10)
    assert [(row.name, row.detail) for row in world.status().inputs] == [("rover", "rover"), ("base", "navigation"), ("other", "base")]
    assert all(solution.status == FIX for solution in world.solutions()[5:])


def test_no_base_at_all_and_one_again(tmp_path: Path) -> None:
    world = World(tmp_path)
    world.play(8)
    assert world.ask("op=base").ok
    world.play(3)
    assert world.solutions()[-1].status_name.lower() == "single"
    world.ask("op=base&id=other")
    world.play(3)
    assert world.solutions()[-1].status == FIX
    assert len(world.solutions()) == 14


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ("id=rover", "is the rover"),
        ("id=A%20b", "is no id"),
        ("id=*", "one base"),
        ("id=other&timeout_s=x", "timeout_s"),
        ("id=other&antenna=NONSENSE", "NONSENSE"),
    ],
)
def test_what_cannot_be_a_base_is_refused_and_changes_nothing(tmp_path: Path, arguments: str, text: str) -> None:
    world = World(tmp_path)
    world.play(8)
    reply = world.ask(f"op=base&{arguments}")
    assert not reply.ok
    assert text in reply.message
    world.play(2)
    assert world.solutions()[-1].status == FIX
    assert world.solutions()[-1].base == "base"


def test_a_loaded_table_and_a_restart_keep_the_base_that_was_chosen(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text('[solver]\nrover = "rover"\nbase = "base"\nelevation_mask_deg = 12.0\n')
    world = World(tmp_path)
    world.play(8)
    world.ask("op=base&id=other")
    world.play(6)
    assert world.ask("op=load&file=night.toml").ok
    world.play(4)
    assert world.solutions()[-1].base == "other"
    assert world.solutions()[-1].status == FIX
