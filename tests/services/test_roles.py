"""Ingest, solver, attitude, recorder and output as they are, on an in-memory bus with a clock that stands still: bytes in, fix out."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from math import degrees
from pathlib import Path

import numpy as np
import pytest
from tests.services.roles_in_one_process import Site, settle

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import SimulatedEpoch, open_stream, truth
from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.command import Code, Reply
from rtkmesh_schemas.config import AttitudeTable, Deployment, IngestTable, OutputTable, RecorderTable, SolverTable
from rtkmesh_schemas.keys import ATT, CMD, EPH, EVENT, OBS, SOL, STATUS, Role
from rtkmesh_schemas.solution import SolutionMessage
from rtkmesh_schemas.status import Event, ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.attitude.service import AttitudeService
from rtkmesh_services.errors import NamesakeError
from rtkmesh_services.ingest.links import Chunk, LinkReport, LinkState
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.output.service import OutputService
from rtkmesh_services.recorder.service import RecorderService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context, Service
from rtkmesh_services.solver.service import SolverService

START = GpsTime(2400, 7200.0)
START_UTC_NS = int(START.to_utc().timestamp()) * 1_000_000_000
SEED, RATE_HZ = 3, 5.0
ROLES: dict[str, tuple[Role, type[Service]]] = {
    "rover": (Role.INGEST, IngestService),
    "rover2": (Role.INGEST, IngestService),
    "base": (Role.INGEST, IngestService),
    "rtk": (Role.SOLVER, SolverService),
    "vector": (Role.SOLVER, SolverService),
    "heading": (Role.ATTITUDE, AttitudeService),
    "logs": (Role.RECORDER, RecorderService),
    "pos": (Role.OUTPUT, OutputService),
}
ANTENNAS = {"rover": "rover", "rover2": "heading", "base": "base"}


def simulated(antenna: str) -> Iterator[SimulatedEpoch]:
    """What an antenna of the demo sends."""
    return open_stream("demo", antenna, seed=SEED, rate_hz=RATE_HZ, start=START).epochs()


@dataclass
class World:
    """One deployment in one process; ``play`` lets simulated time pass."""

    folder: Path
    network: MemoryNetwork = field(default_factory=MemoryNetwork)
    clock: ManualClock = field(default_factory=lambda: ManualClock(utc_ns=START_UTC_NS))
    lives: dict[str, Lifecycle] = field(default_factory=dict)
    buses: dict[str, MemoryBus] = field(default_factory=dict)

    def __post_init__(self) -> None:
        ports = iter(range(1, 4))
        ingest = {name: IngestTable(source=f"tcp://127.0.0.1:{next(ports)}") for name in ANTENNAS}
        self.deployment = Deployment(
            ingest=ingest,
            solver={
                "rtk": SolverTable(rover="rover", base="base"),
                "vector": SolverTable(rover="rover2", base="rover", mode="moving-base"),
            },
            attitude={"heading": AttitudeTable(solver="vector", length_m=1.0)},
            recorder={"logs": RecorderTable(folder=str(self.folder / "logs"), receivers=("rover", "base"))},
            output={"pos": OutputTable(solver="rtk", target=f"file://{self.folder}/track.pos", format="xyz")},
        )
        self.streams = {
            name: open_stream("demo", antenna, seed=SEED, rate_hz=RATE_HZ, start=START).epochs() for name, antenna in ANTENNAS.items()
        }
        self.asker = MemoryBus("asker", self.network)
        self.network.on_wait = self.settle
        for name in ROLES:
            self.begin(name)
        self.settle()

    def begin(self, name: str) -> None:
        site = Site(self.network, self.clock, self.folder)
        self.lives[name], self.buses[name] = site.begin(name, *ROLES[name], self.deployment)

    def settle(self) -> None:
        """Step all until nothing waits."""
        settle(self.lives.values())

    def play(self, epochs: int, *, damage: bytes = b"") -> None:
        """Let each receiver send its next epochs; ``damage`` is what the wire adds between them."""
        for _ in range(epochs):
            self.clock.advance(1.0 / RATE_HZ)
            for name, stream in self.streams.items():
                epoch: SimulatedEpoch = next(stream)
                self.lives[name].context.inbox.put(Chunk(epoch.data + damage, self.clock.mono_ns()), lane="source")
            self.settle()

    def solutions(self, name: str = "rtk") -> list[SolutionMessage]:
        return [decode(SolutionMessage, sample.payload, sample.encoding) for sample in self.buses[name].sent(SOL)]

    def ask(self, name: str, parameters: str) -> Reply:
        [answer] = self.asker.get(f"{CMD.key(name)}?{parameters}", timeout_s=1.0)
        return decode(Reply, answer.payload, answer.encoding)

    def status(self, name: str) -> ServiceStatus:
        return decode(ServiceStatus, self.buses[name].sent(STATUS)[-1].payload)


def test_at_first_processes_wait_then_they_are_stale(world: World) -> None:
    """Nothing heard yet is no alarm for the first seconds."""
    for after_s, state in ((14.0, State.RUNNING), (2.0, State.STALE)):
        world.clock.advance(after_s)
        world.settle()
        for name, text in (("rtk", "rover"), ("heading", "vector")):
            status = world.status(name)
            assert (status.state, text in status.reason) == (state, True)
    world.play(1)
    assert world.status("rtk").state is not State.STALE


def test_loaded_options_are_the_ones_that_are_told(world: World) -> None:
    """After load, config tells the loaded options; a file that the engine refuses changes nothing."""
    (world.folder / "night.toml").write_text('[solver]\nrover = "x"\nbase = "y"\nmode = "static"\n')
    (world.folder / "bad.toml").write_text('[solver]\nrover = "x"\nbase = "y"\nmode = "fixed"\n')
    assert world.ask("rtk", "op=load;file=night.toml").ok
    assert not world.ask("rtk", "op=load;file=bad.toml").ok
    table = world.ask("rtk", "op=config").data["table"]
    assert (table["mode"], table["rover"]) == ("static", "rover")


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def test_bytes_become_a_fix_a_velocity_and_a_heading(world: World) -> None:
    world.play(25)
    told = truth("demo", seed=SEED)
    fixed = [s for s in world.solutions() if s.status_name == "FIX"]
    assert len(fixed) >= 15
    for solution in fixed:
        true = told(GpsTime(solution.week, solution.tow_s))
        assert np.linalg.norm(np.subtract(solution.position_ecef_m, true.antennas_ecef_m["rover"])) < 0.05
        assert np.linalg.norm(np.subtract(solution.velocity_ecef_mps, true.velocities_ecef_mps["rover"])) < 0.5
        assert solution.age_s == pytest.approx(0.0, abs=0.025)
    attitudes = [decode(AttitudeMessage, s.payload, s.encoding) for s in world.buses["heading"].sent(ATT)]
    usable = [a for a in attitudes if a.integrity == "ok"]
    assert len(usable) >= 10
    for attitude in usable:
        error = degrees(attitude.heading_rad - told(GpsTime(attitude.week, attitude.tow_s)).heading_rad)
        assert abs((error + 180.0) % 360.0 - 180.0) < 1.5
    assert world.buses["rover"].sent(EPH, satellite="G01") or len(world.buses["rover"].sent(OBS)) == 25


def test_after_stop_there_are_no_solutions_and_after_start_a_fresh_filter(world: World) -> None:
    world.play(8)
    before = len(world.solutions())
    stopped = world.ask("rtk", "op=stop")
    assert (stopped.ok, stopped.state) == (True, "STOPPED")
    world.play(3)
    assert len(world.solutions()) == before
    again = world.ask("rtk", "op=stop")
    assert (again.ok, again.code, again.state) == (False, Code.WRONG_STATE, "STOPPED")
    assert world.ask("rtk", "op=start").ok
    assert world.ask("rtk", "op=start").code == Code.WRONG_STATE
    world.play(6)
    after = world.solutions()[before:]
    assert len(after) == 6
    assert after[-1].status_name == "FIX"


def test_load_takes_a_table_below_the_folder_and_nothing_else(world: World) -> None:
    (world.folder / "plain.toml").write_text('[solver]\nrover = "rover"\nmode = "single"\n')
    (world.folder / "typo.toml").write_text('[solver]\nrover = "rover"\nelmask = 10\n')
    world.play(6)
    loaded = world.ask("rtk", "op=load&file=plain.toml")
    assert (loaded.message, loaded.data["applied"]) == ("Options loaded. Restart to enable them", "on_restart")
    world.play(1)
    assert world.solutions()[-1].status_name != "SINGLE"
    assert world.ask("rtk", "op=restart").ok
    world.play(3)
    assert [s.status_name for s in world.solutions()[-3:]] == ["SINGLE"] * 3
    typo = world.ask("rtk", "op=load&file=typo.toml")
    assert not typo.ok
    assert "typo.toml:3" in typo.message
    for outside in ("../outside.toml", "/etc/passwd", "missing.toml", ""):
        assert not world.ask("rtk", f"op=load&file={outside}").ok
    world.play(2)
    assert world.solutions()[-1].status_name == "SINGLE"


def test_damaged_bytes_are_counted_and_cost_only_what_they_hit(world: World) -> None:
    rng = np.random.default_rng(5)
    world.play(5)
    for _ in range(10):
        world.play(1, damage=rng.integers(0, 256, 200, dtype=np.uint8).tobytes() + b"\xb5\x62\x02\x15\xff\xff\xd3\x03\xff$GN")
    world.play(5)
    assert world.solutions()[-1].status_name == "FIX"
    assert len([s for s in world.solutions() if s.status_name == "FIX"]) >= 8
    world.clock.advance(1.1)
    world.settle()
    assert world.status("rover").counters["bytes_skipped"] > 1000


def test_a_restarted_ingest_is_taken_up_again(world: World) -> None:
    world.play(10)
    world.lives["rover"].finish()
    world.begin("rover")
    world.play(1)
    assert world.solutions()[-1].tow_s == pytest.approx(START.tow_s + 10 / RATE_HZ), "its first epoch is solved"
    world.play(14)
    assert world.solutions()[-1].status_name == "FIX"
    assert world.solutions()[-1].tow_s == pytest.approx(START.tow_s + 24 / RATE_HZ)
    assert "of_another_process" not in world.status("rtk").inputs[0].counters


def test_a_second_process_of_the_same_id_is_named_and_not_listened_to(world: World) -> None:
    """Another vehicle's rover on the same network, by mistake under the same id: it gives way, being the younger one."""
    world.play(5)
    stranger = Context(id="rover", role=Role.INGEST, deployment=world.deployment, bus=MemoryBus("rover", world.network), clock=world.clock)
    life = world.lives["stranger"] = Lifecycle(IngestService(stranger), warm_in_thread=False)
    life.start()
    life.step(0.0)
    world.streams["stranger"] = simulated("heading")
    with pytest.raises(NamesakeError, match=r"another process has the id 'rover'"):
        world.play(20)
    assert stranger.bus.counters["published"] > 5
    del world.lives["stranger"], world.streams["stranger"]
    life.finish()
    world.settle()
    world.play(10)
    fixed = [s for s in world.solutions() if s.status_name == "FIX"]
    assert len(fixed) >= 8
    told = truth("demo", seed=SEED)
    last = fixed[-1]
    error = np.subtract(last.position_ecef_m, told(GpsTime(last.week, last.tow_s)).antennas_ecef_m["rover"])
    assert np.linalg.norm(error) < 0.05
    world.clock.advance(1.1)
    world.settle()
    assert "two processes publish as rover" in world.status("rtk").reason


def test_the_recorder_writes_what_came_and_never_over_it(world: World) -> None:
    expected = b"".join(epoch.data for epoch in islice(simulated("rover"), 6))
    world.play(6)
    world.lives["logs"].finish()
    [log] = (world.folder / "logs").glob("rover-*.ubx")
    assert log.read_bytes() == expected
    times = Path(f"{log}.times").read_text().splitlines()
    assert sum(int(line.split()[3]) for line in times) == len(expected)
    world.begin("logs")
    world.play(2)
    world.lives["logs"].finish()
    assert log.read_bytes() == expected
    assert len(list((world.folder / "logs").glob("rover-*.ubx"))) == 2


def test_the_output_writes_pos_lines_with_their_header(world: World) -> None:
    world.play(10)
    world.lives["pos"].finish()
    text = (world.folder / "track.pos").read_text()
    assert "x-ecef(m)" in text
    lines = [line.split() for line in text.splitlines() if not line.startswith("%")]
    solved = [s for s in world.solutions() if s.status]
    assert len(lines) == len(solved)
    assert [float(v) for v in lines[-1][2:5]] == pytest.approx(solved[-1].position_ecef_m, abs=6e-5)


def told(life: Lifecycle, *reports: LinkReport, after_s: float) -> None:
    """Let a link tell what becomes of it."""
    for report in reports:
        life.context.inbox.put(report, lane="source")
        life.step(0.0)
        life.context.clock.advance(after_s)
        life.step(0.0)


@pytest.fixture
def ingest() -> Lifecycle:
    """An ingest whose source says only what the test lets it say."""
    table = IngestTable(source="tcp://127.0.0.1:1")
    network = MemoryNetwork()
    context = Context(
        id="rover", role=Role.INGEST, deployment=Deployment(ingest={"rover": table}), bus=MemoryBus("rover", network), clock=ManualClock()
    )
    service = IngestService(context)
    service._start_source = lambda: None
    life = Lifecycle(service, warm_in_thread=False)
    life.start()
    life.step(0.0)
    return life


def test_what_becomes_of_a_source_is_logged_once(ingest: Lifecycle, caplog: pytest.LogCaptureFixture) -> None:
    """A failure that changes the state is one line, the same again none, another one a line; as events they are all there."""
    caplog.set_level("INFO")
    told(ingest, *(LinkReport(LinkState.ERROR, detail) for detail in ("no such port", "no such port", "a busy port")), after_s=0.2)
    said = [record.getMessage() for record in caplog.records if "port" in record.getMessage()]
    assert said == ["DEGRADED no such port", "tcp source: a busy port"]
    assert isinstance(ingest.context.bus, MemoryBus)
    events = [decode(Event, sample.payload) for sample in ingest.context.bus.sent(EVENT, level="warning")]
    assert [event.text for event in events if event.code == "source_error"] == ["tcp source: no such port", "tcp source: a busy port"]


def test_a_silent_connection_is_stale_and_not_at_fault(ingest: Lifecycle, caplog: pytest.LogCaptureFixture) -> None:
    """That it is made anew now and then is no news."""
    caplog.set_level("INFO")
    anew = [LinkReport(state, "tcp://127.0.0.1:1") for state in (LinkState.CONNECTING, LinkState.WAITING)]
    told(ingest, *anew * 4, after_s=10.0)
    assert [record.getMessage().split()[0] for record in caplog.records] == ["STALE"]
