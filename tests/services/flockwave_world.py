"""Control with Flockwave, two bases behind real sockets and a clock that stands still: what a recorded Skybrush server had around it."""

import json
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from tests.patience import PATIENCE_S
from tests.services.roles_in_one_process import Site
from tests.services.simulated_receiver import acknowledgement

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Protocol
from rtkmesh.codecs.rtcm3_encode import encode_epoch, encode_station_message
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import BaseStationTable, ControlTable, Deployment, IngestTable
from rtkmesh_schemas.config_flockwave import FlockwaveTable
from rtkmesh_schemas.config_presets import PresetTable
from rtkmesh_schemas.keys import Role
from rtkmesh_schemas.presets import ingest_id
from rtkmesh_services.control.endpoints import free_port
from rtkmesh_services.control.fleet import LaunchOptions
from rtkmesh_services.control.keeper import Keeper
from rtkmesh_services.control.service import ControlService
from rtkmesh_services.ingest.links import Chunk
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.runtime.clock import ManualClock
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.service import Context

PLACE = (4268987.0, 1178894.0, 4574798.0)
CN0_DBHZ = {"G05": 40.625, "G12": 41.625, "G13": 42.625, "G14": 43.625}
STATION = ReferenceStation(100, PLACE, antenna="ADVNULLANTENNA", antenna_serial="12345678")
BASE_A, BASE_B = ingest_id("base-a"), ingest_id("base-b")


def frames_at(second: int) -> bytes:
    """What the recorded base sent at a second: 1005 and 1008 every five seconds, an MSM7 of four satellites every second."""
    station = [encode_station_message(STATION, number) for number in (1005, 1008)] if second % 5 == 0 else []
    return b"".join([*station, *encode_epoch(_epoch(second), STATION.station_id)])


def _epoch(second: int) -> Epoch:
    count = len(CN0_DBHZ)
    nan, zeros = np.full(count, np.nan), np.zeros(count)
    return Epoch(
        GpsTime(2400, 345600.0 + second),
        satellite=np.array([satellite_number(name) for name in CN0_DBHZ], np.int16),
        signal=np.full(count, signal_number("1C"), np.int16),
        channel=np.full(count, 127, np.int8),
        flags=zeros.astype(np.uint8),
        pseudorange_m=np.full(count, 22e6),
        phase_cyc=np.full(count, 22e6 / 0.19029367279836487),
        doppler_hz=zeros,
        cn0_dbhz=np.array(list(CN0_DBHZ.values())),
        lock_s=np.full(count, 10.0),
        pseudorange_sigma_m=nan,
        phase_sigma_cyc=nan,
    )


class Puppet:
    """A base at the end of a TCP connection: hears what it is told, and acknowledges it while ``acknowledges`` is set."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self.listener.getsockname()[1]
        self.told: list[bytes] = []
        self.acknowledges = threading.Event()
        self.acknowledges.set()
        self._ended = threading.Event()
        self._framer = Framer()
        self._framer.feed(b"\n")
        threading.Thread(target=self._run, daemon=True).start()

    def close(self) -> None:
        self._ended.set()
        with suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.listener.close()

    def _run(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self.listener.accept()
                with connection:
                    connection.sendall(b"\r\n")  # a link stands when something comes over it
                    while data := connection.recv(4096):
                        self._hear(connection, data)

    def _hear(self, connection: socket.socket, data: bytes) -> None:
        for frame in self._framer.feed(data):
            if frame.protocol is Protocol.UBX:
                self.told.append(frame.data)
                while not self.acknowledges.wait(0.05) and not self._ended.is_set():
                    pass
                connection.sendall(acknowledgement(frame, taken=True))


class World:
    """All of it in this process but the sockets' threads. ``step`` lets what has come be worked on."""

    def __init__(self, folder: Path, **flockwave: Any) -> None:
        self.clock = ManualClock(mono_ns=time.monotonic_ns())
        self.network = MemoryNetwork(clock=self.clock, on_wait=self._wait)
        self.puppets = {name: Puppet() for name in (BASE_A, BASE_B)}
        self._thread = threading.current_thread()
        self._second = 0
        port = free_port()
        self.deployment = Deployment(
            ingest={name: self._table(name) for name in (BASE_A, BASE_B)},
            preset={
                "base-a": PresetTable(title="Base A", format="rtcm3", sources=("tcp://127.0.0.1:29502",)),
                "base-b": PresetTable(title="Base B", format="auto", sources=("tcp://127.0.0.1:29503",)),
            },
            flockwave=FlockwaveTable(**{"tcp": f"127.0.0.1:{port}", "udp": f"127.0.0.1:{port}", **flockwave}),
        )
        self.asker = MemoryBus("asker", self.network)
        self.lives = {name: self._begun(name, Role.INGEST, IngestService) for name in (BASE_A, BASE_B)}
        keeper = Keeper([], ControlTable())
        self.lives["control"] = self._begun("control", Role.CONTROL, lambda context: ControlService(context, keeper, LaunchOptions(folder)))
        self.address = ("127.0.0.1", port)
        self.until(lambda: all(life.service.report().inputs[0].state == "connected" for life in self._ingests()))
        self.advance(1.0)

    def _table(self, name: str) -> IngestTable:
        station = BaseStationTable(mode="watch", receiver="ublox-legacy") if name == BASE_B else None
        return IngestTable(source=f"tcp://127.0.0.1:{self.puppets[name].port}", base_station=station)

    def _ingests(self) -> list[Lifecycle]:
        return [self.lives[name] for name in (BASE_A, BASE_B)]

    def _begun(self, name: str, role: Role, make: Callable[[Context], Any]) -> Lifecycle:
        return Site(self.network, self.clock).begin(name, role, make, self.deployment)[0]

    def _wait(self) -> None:
        """Let an asked service work: in this thread by steps, in others by waiting for this one."""
        if threading.current_thread() is self._thread:
            self.step()
        time.sleep(0.0005)

    def step(self) -> None:
        """Let all work on what has come."""
        for life in self.lives.values():
            while life.context.inbox.depth():
                life.step(0.0)
            life.step(0.0)

    def until(self, condition: Callable[[], Any]) -> Any:
        """Step until a condition holds; return what it gave."""
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            self.step()
            if found := condition():
                return found
            time.sleep(0.0005)
        raise AssertionError("waited in vain")

    def advance(self, seconds: float) -> None:
        """Let time pass in which nothing comes."""
        while seconds > 1e-9:
            part = min(0.1, seconds)
            self.clock.advance(part)
            self.step()
            self.until(self._is_answered)
            seconds -= part

    def _is_answered(self) -> bool:
        """Whether the receiver has answered what it was told, or does not answer at all: its time is not that of the clock."""
        station = self.lives[BASE_B].service._dialogue._station
        talk = station._conversation
        return talk is None or not talk._attempt or not self.puppets[BASE_B].acknowledges.is_set()

    def stream(self, ingest: str, from_s: float, to_s: float) -> None:
        """Let a base send what it sends between two instants after its selection, and time pass with it."""
        at_s = from_s
        for second in range(int(np.ceil(from_s)), int(np.floor(to_s)) + 1):
            self.advance(second - at_s)
            at_s = float(second)
            self.lives[ingest].context.inbox.put(Chunk(frames_at(second), self.clock.mono_ns()), lane="source")
            self.step()
        self.advance(to_s - at_s)

    def close(self) -> None:
        for life in self.lives.values():
            life.service.close()
        for puppet in self.puppets.values():
            puppet.close()


class SkybrushClient:
    """What speaks to Flockwave by TCP, line by line; notifications are put aside."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.socket = socket.create_connection(world.address)
        self.socket.setblocking(False)
        self._rest = b""
        self.lines: list[dict[str, Any]] = []
        self.notifications: list[dict[str, Any]] = []

    def say(self, line: bytes | str | Mapping[str, Any]) -> None:
        text = json.dumps(line) if isinstance(line, Mapping) else line
        self.socket.sendall((text if isinstance(text, bytes) else text.encode()) + b"\n")

    def read(self) -> None:
        """Take what has come."""
        with suppress(BlockingIOError):
            while True:
                data = self.socket.recv(65536)
                assert data, "the connection was dropped"
                self._rest += data
        *whole, self._rest = self._rest.split(b"\n")
        for message in map(json.loads, whole):
            (self.lines if "refs" in message else self.notifications).append(message)

    def ask(self, message: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a request."""
        self.say(message)
        return self._world.until(lambda: self._answer_to(message["id"]))

    def ask_body(self, kind: str, **fields: Any) -> dict[str, Any]:
        """Return the body of the answer to a body."""
        name = f"t{time.monotonic_ns()}"
        answer = self.ask({"$fw.version": "1.0", "id": name, "body": {"type": kind, **fields}})
        found: dict[str, Any] = answer["body"]
        return found

    def close(self) -> None:
        self.socket.close()

    def silence(self) -> None:
        """Make sure that whatever was said before is done with: the server reads a client's lines in their order."""
        self.ask_body("SYS-PING")

    def _answer_to(self, name: str) -> dict[str, Any] | None:
        self.read()
        return next((line for line in self.lines if line["refs"] == name), None)
