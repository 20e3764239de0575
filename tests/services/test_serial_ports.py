"""Serial ports as pseudo-terminals that pyserial really opens: names, unplugging, locks, wrong and unknown baud rates."""

import os
import pty
import queue
import termios
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
import serial
from serial.tools.list_ports_common import ListPortInfo
from tests.patience import PATIENCE_S

from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh_schemas.config import Deployment, IngestTable
from rtkmesh_schemas.keys import STATUS, Role
from rtkmesh_schemas.status import ServiceStatus, State
from rtkmesh_schemas.wire import decode
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest import serial_ports
from rtkmesh_services.ingest.links import Chunk, Link, LinkReport, LinkState
from rtkmesh_services.ingest.service import IngestService
from rtkmesh_services.ingest.urls import parse_source
from rtkmesh_services.runtime import serial_device
from rtkmesh_services.runtime.lifecycle import Lifecycle
from rtkmesh_services.runtime.memory_bus import MemoryBus, MemoryNetwork
from rtkmesh_services.runtime.serial_device import find_port
from rtkmesh_services.runtime.service import Context

FRAME = frame(bytes([0xFF, 0xE0, *range(30)]))


class Receiver:
    """A receiver behind a pseudo-terminal. At another rate than its own what it sends is garbage."""

    def __init__(self, baud: int = 0, period_s: float = 0.02) -> None:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self._baud, self._period_s = baud, period_s
        self._stop = threading.Event()
        self._plugged = True
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> "Receiver":
        self._thread.start()
        return self

    def set_baud(self, baud: int) -> None:
        self._baud = baud

    def unplug(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._plugged:  # once: the numbers may be somebody else's by now
            self._plugged = False
            os.close(self.master)
            os.close(self.slave)

    def _run(self) -> None:
        speeds = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()}
        while not self._stop.wait(self._period_s):
            now = speeds[termios.tcgetattr(self.master)[4]]
            garbled = bytes(byte * 7 + 13 & 0xFF | 0x80 for byte in FRAME * 4)
            with suppress(OSError):
                os.write(self.master, FRAME if now == self._baud else garbled.replace(b"\xd3", b"\xd2").replace(b"\xb5", b"\xb4"))


class Sink:
    def __init__(self) -> None:
        self.items: queue.Queue[Chunk | LinkReport] = queue.Queue()

    def until(self, state: LinkState, containing: str = "") -> str:
        while True:
            item = self.items.get(timeout=PATIENCE_S)
            if isinstance(item, LinkReport) and item.state is state and containing in item.detail:
                return item.detail

    def until_data(self) -> bytes:
        while True:
            item = self.items.get(timeout=PATIENCE_S)
            if isinstance(item, Chunk):
                return item.data


class World:
    def __init__(self) -> None:
        self.receivers: list[Receiver] = []
        self.links: list[Link] = []

    def receiver(self, baud: int = 115200, period_s: float = 0.02) -> Receiver:
        self.receivers.append(Receiver(baud, period_s))
        return self.receivers[-1]

    def link(self, url: str) -> Sink:
        sink = Sink()
        self.links.append(Link(parse_source(url), sink.items.put))
        self.links[-1].start()
        return sink


@pytest.fixture
def world() -> Iterator[World]:
    world = World()
    yield world
    for link in world.links:
        link.stop()
    for receiver in world.receivers:
        receiver.unplug()


def test_an_unplugged_receiver_is_said_and_is_back_under_its_name_within_two_seconds(world: World, tmp_path: Path) -> None:
    """The name is a link, as udev makes them: the device behind it may be another one after plugging in."""
    name = tmp_path / "receiver"
    first = world.receiver().start()
    name.symlink_to(first.path)
    sink = world.link(f"serial://{name}?baud=115200")
    assert sink.until_data()
    took_s: list[float] = []
    while not took_s or (min(took_s) > 2.0 and len(took_s) < 4):  # the machine may stand still in one of them
        first.unplug()
        name.unlink()
        assert "the device has gone (unplugged?)" in sink.until(LinkState.ERROR)
        assert "no such device is plugged in" in sink.until(LinkState.ERROR, "no such device")
        first = world.receiver().start()
        plugged_s = time.monotonic()
        name.symlink_to(first.path)
        sink.until(LinkState.CONNECTED)
        took_s.append(time.monotonic() - plugged_s)
    assert min(took_s) < 2.0


def test_a_device_that_goes_while_it_is_opened_is_tried_again(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the kernel then says through termios is no OSError."""
    flush, going = serial.Serial._reset_input_buffer, [world.receiver()]  # between opening and reading

    def unplugged(port: serial.Serial) -> None:
        if going:
            going.pop().unplug()
        flush(port)

    monkeypatch.setattr(serial.Serial, "_reset_input_buffer", unplugged)
    sink = world.link(f"serial://{going[0].path}")
    assert "Input/output error" in sink.until(LinkState.ERROR)
    assert "no such device is plugged in" in sink.until(LinkState.ERROR)


def test_a_port_has_one_owner(world: World) -> None:
    receiver = world.receiver().start()
    assert world.link(f"serial://{receiver.path}").until_data()
    assert "in use by another program" in world.link(f"serial://{receiver.path}").until(LinkState.ERROR)


@pytest.mark.parametrize("baud", [460800, 9600])
def test_the_baud_rate_is_found(world: World, baud: int) -> None:
    receiver = world.receiver(baud, 0.01).start()
    sink = world.link(f"serial://{receiver.path}?baud=auto")
    assert "looking for the baud rate, now 115200" in sink.until(LinkState.WAITING)
    assert sink.until(LinkState.CONNECTED) == f"{receiver.path} at {baud} baud"
    assert FRAME in sink.until_data(), "what was heard while listening is not lost"


def test_a_silent_port_has_no_baud_rate(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_ports, "LISTEN_S", 0.05)
    sink = world.link(f"serial://{world.receiver().path}?baud=auto")
    assert "nothing comes at any baud rate from 4800 to 921600" in sink.until(LinkState.ERROR)


def test_the_wrong_baud_rate_is_named_as_the_reason(world: World) -> None:
    """It is the state of the process, and gone with the first whole frame."""
    receiver = world.receiver(38400, 0.005).start()
    table = IngestTable(source=f"serial://{receiver.path}?baud=115200")
    bus = MemoryBus("rover", MemoryNetwork())
    life = Lifecycle(
        IngestService(Context(id="rover", role=Role.INGEST, deployment=Deployment(ingest={"rover": table}), bus=bus)), warm_in_thread=False
    )
    life.start()

    def until(state: State) -> ServiceStatus:
        deadline_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline_s:
            life.step(0.05)
            status = decode(ServiceStatus, bus.sent(STATUS)[-1].payload)
            if status.state is state and status.inputs and status.inputs[0].bytes > 200:
                return status
        raise AssertionError(f"never {state}")

    reason = until(State.DEGRADED).reason
    assert "kB without a whole frame: looks like the wrong baud rate; baud=auto finds it" in reason
    assert "at 115200 baud" in reason
    receiver.set_baud(115200)
    until(State.RUNNING)
    life.service.close()


def port(device: str, vid: int | None = None, pid: int | None = None, serial_number: str | None = None) -> ListPortInfo:
    info = ListPortInfo(device)
    info.vid, info.pid, info.serial_number = vid, pid, serial_number
    return info


PORTS = [
    port("/dev/ttyS0"),
    port("/dev/ttyACM0", 0x1546, 0x01A9, "A1"),
    port("/dev/ttyUSB0", 0x0403, 0x6015, "X"),
    port("/dev/ttyUSB1", 0x0403, 0x6015, "Y"),
]


def test_ports_are_found_by_their_usb_ids(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert find_port("1546:01a9", PORTS) == "/dev/ttyACM0"
    assert find_port("0403:6015:Y", PORTS) == "/dev/ttyUSB1"
    with pytest.raises(SourceError, match="there are 2 of them: /dev/ttyUSB0, /dev/ttyUSB1; say which"):
        find_port("0403:6015", PORTS)
    with pytest.raises(SourceError, match="no such device is plugged in"):
        find_port("1546:01a8", PORTS)
    for name in ("usb-u-blox_ZED-if00", "usb-u-blox_ZED-if02", "usb-FTDI_x-if00-port0"):
        (tmp_path / name).touch()
    monkeypatch.setattr(serial_device, "BY_ID", tmp_path)
    assert find_port("by-id/usb-FTDI") == str(tmp_path / "usb-FTDI_x-if00-port0")
    assert find_port("by-id/usb-u-blox*if02") == str(tmp_path / "usb-u-blox_ZED-if02")
    with pytest.raises(SourceError, match="2 of them"):
        find_port("by-id/usb-u-blox")
    assert find_port(f"{tmp_path}/usb-F*") == str(tmp_path / "usb-FTDI_x-if00-port0")


@pytest.mark.parametrize("url", ["serial://ttyACM0", "serial://1546:1", "serial:///dev/ttyACM0?baud=fast"])
def test_names_that_are_none_are_refused(url: str) -> None:
    with pytest.raises(SourceError, match=r"names no port|nor auto"):
        parse_source(url)
