"""Outputs of a solver's solutions on a bus of their own: the test is the solver; targets are real sockets, ports and files."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from math import cos, nan, radians, sin
from typing import Any

from tests.patience import PATIENCE_S, SteadyClock

from rtkmesh_schemas.config import Deployment, IngestTable, OutputTable, SolverTable
from rtkmesh_schemas.keys import EVENT, SAT, SOL, STATUS, Role
from rtkmesh_schemas.solution import SatellitesMessage, SolutionMessage
from rtkmesh_schemas.status import Event, Level, ServiceStatus
from rtkmesh_schemas.wire import decode
from rtkmesh_services.output.service import create
from rtkmesh_services.runtime.clock import Clock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

WEEK, TOW_S = 2390, 345600.0
LAT_DEG, LON_DEG, HEIGHT_M = 47.4, 8.5, 480.0
BASE_ECEF_M = (4276000.0, 639000.0, 4671900.0)
COV = (4e-4, 1e-5, 0.0, 1e-5, 4e-4, 0.0, 0.0, 0.0, 9e-4)


def ecef_m(lat_deg: float, lon_deg: float, height_m: float) -> tuple[float, float, float]:
    """WGS 84 (a, 1/f)."""
    lat, lon, e2 = radians(lat_deg), radians(lon_deg), 0.0066943799901413165
    normal = 6378137.0 / (1.0 - e2 * sin(lat) ** 2) ** 0.5
    flat = (normal + height_m) * cos(lat)
    return flat * cos(lon), flat * sin(lon), (normal * (1.0 - e2) + height_m) * sin(lat)


def solution(number: int = 0, **changes: Any) -> SolutionMessage:
    """A fix that goes north, five of them a second."""
    lat_deg = LAT_DEG + number * 1e-6
    values = {
        "source": "rtk", "start_id": "x", "sequence": number, "week": WEEK, "tow_s": TOW_S + 0.2 * number, "status": 1,
        "status_name": "FIX", "reason": "", "lat_deg": lat_deg, "lon_deg": LON_DEG, "height_m": HEIGHT_M,
        "position_ecef_m": ecef_m(lat_deg, LON_DEG, HEIGHT_M), "position_cov_ecef_m2": COV, "position_cov_enu_m2": COV,
        "velocity_ecef_mps": (-0.4, -0.06, 0.37), "velocity_cov_ecef_m2ps2": COV, "velocity_enu_mps": (0.0, 0.55, 0.0),
        "velocity_cov_enu_m2ps2": COV, "base_ecef_m": BASE_ECEF_M, "baseline_ecef_m": (1.0, 2.0, 3.0),
        "baseline_enu_m": (1.83, 1.08, 3.08), "baseline_cov_enu_m2": COV, "age_s": 0.2, "ratio": 20.0, "ratio_threshold": 3.0,
        "success_rate": 1.0, "grade": 3, "ambiguities": 20, "ambiguities_fixed": 18, "satellites_used": 12, "satellites_rover": 14,
        "satellites_base": 15, "code_rms_m": 0.3, "phase_rms_m": 0.002, "nis_per_observation": 0.9, "receiver_clock_s": 0.0,
        "resets": 0, "mode": "kinematic", "rover": "rover", "base": "base",
    }  # fmt: skip
    return SolutionMessage(**(values | changes))


def none(number: int) -> SolutionMessage:
    """An epoch without a solution."""
    unknown = (nan, nan, nan)
    return solution(number, status=0, status_name="NONE", position_ecef_m=unknown, baseline_enu_m=unknown, position_cov_ecef_m2=(nan,) * 9)


def satellites(number: int) -> SatellitesMessage:
    """The satellites of the same epoch: two of GPS, one of Galileo."""
    values = {
        "azimuth_deg": 120.0,
        "cn0_dbhz": 45.0,
        "code_residual_m": 0.1,
        "phase_residual_m": 0.001,
        "ambiguity_cyc": 5.0,
        "lock_s": 60.0,
    }
    columns = {name: [value] * 3 for name, value in values.items()}
    return SatellitesMessage(
        source="rtk", week=WEEK, tow_s=TOW_S + 0.2 * number, satellite=["G05", "G12", "E11"], signal=["1C", "1C", "1C"], state=[7, 7, 3],
        elevation_deg=[20.0, 50.0, 70.0], slips=[0, 0, 0], **columns,
    )  # fmt: skip


class TextWorld:
    """Outputs by their ids, and the solver ``rtk`` that they belong to."""

    def __init__(self, clock: Clock | None = None, source: str = "udp://127.0.0.1:1", **outputs: OutputTable) -> None:
        self.network = MemoryNetwork()
        self.solver = MemoryBus("rtk", self.network)
        self.clock = clock or SteadyClock()
        self.deployment = Deployment(
            ingest={"rover": IngestTable(source=source), "base": IngestTable(source="udp://127.0.0.1:2")},
            solver={"rtk": SolverTable(rover="rover", base="base")},
            output=outputs,
        )
        self.lives: dict[str, Lifecycle] = {}
        self.buses: dict[str, MemoryBus] = {}
        for name in outputs:
            self.begin(name)

    def begin(self, name: str) -> None:
        bus = self.buses[name] = MemoryBus(name, self.network)
        context = Context(id=name, role=Role.OUTPUT, deployment=self.deployment, bus=bus, clock=self.clock)
        life = self.lives[name] = Lifecycle(create(context), warm_in_thread=False)
        life.start()
        life.step(0.0)

    def solve(self, *solutions: SolutionMessage) -> None:
        for one in solutions:
            self.solver.publish(SOL, one)
            self.settle()

    def see(self, *messages: SatellitesMessage) -> None:
        for one in messages:
            self.solver.publish(SAT, one)
            self.settle()

    def mark(self, **data: Any) -> None:
        event = Event(id="rtk", level=Level.INFO, code="mark", text="mark", sequence=0, utc_ns=0, mono_ns=0, data=data)
        self.solver.publish(EVENT, event, level="info")
        self.settle()

    def settle(self) -> None:
        for life in self.lives.values():
            while life.context.inbox.depth():
                life.step(0.0)
            life.step(0.0)

    def until(self, condition: Callable[[], object]) -> None:
        """Step all until the condition holds."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < deadline_s, "waited in vain"
            self.settle()
            time.sleep(0.002)

    def status(self, name: str = "out") -> ServiceStatus:
        return self.lives[name].status()

    def state(self, name: str = "out") -> str:
        self.settle()
        return self.status(name).state.value

    def events(self, name: str = "out") -> list[str]:
        """The codes of what an output has told of its target."""
        sent = [sample for level in Level for sample in self.buses[name].sent(EVENT, level=level.value)]
        events = sorted((decode(Event, sample.payload) for sample in sent), key=lambda event: event.sequence)
        return [event.code for event in events if not event.code.startswith("state_")]

    def newest(self, name: str = "out") -> ServiceStatus:
        return decode(ServiceStatus, self.buses[name].sent(STATUS)[-1].payload)

    def close(self) -> None:
        for life in self.lives.values():
            life.finish()

    def __enter__(self) -> "TextWorld":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def lines(data: bytes) -> list[str]:
    """The lines of a text that are no header."""
    return [line for line in data.decode().splitlines() if not line.startswith("%")]


def received(read: Callable[[int], bytes], until: Callable[[bytes], bool]) -> bytes:
    """Read until what has come is enough; at the end of the stream it must be."""
    data = b""
    for piece in _pieces(read):
        data += piece
        if until(data):
            break
    assert until(data), data[-500:]
    return data


def _pieces(read: Callable[[int], bytes]) -> Iterator[bytes]:
    with suppress(ConnectionResetError):
        while piece := read(65536):
            yield piece
