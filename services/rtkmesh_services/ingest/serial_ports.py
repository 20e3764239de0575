"""Serial ports: by path, by-id name or USB ids, locked for us alone, found again after unplugging, their baud rate found if asked.

The name of a port is looked up anew at every opening: ``/dev/ttyACM0`` (also with ``*``), ``by-id/usb-u-blox...`` (a beginning is
enough), ``1546:01a9`` or ``1546:01a9:SERIAL``.
"""

import errno
import os
import termios
import threading
import time
from collections.abc import Callable, Iterable
from glob import glob
from pathlib import Path
from typing import Any, Final

import serial
from serial.tools.list_ports import comports

from rtkmesh.codecs.framing import Framer
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import USB_NAME, SourceUrl
from rtkmesh_services.ingest.wires import POLL_S, READ_BYTES, Wire
from rtkmesh_services.runtime.backoff import LOCAL, Backoff

BY_ID: Final = Path("/dev/serial/by-id")
DEFAULT_BAUD: Final = 115200
BAUDS: Final = (115200, 460800, 38400, 9600, 921600, 230400, 57600, 19200, 4800)  # in the order of what receivers are set to
LISTEN_S: Final = 2.2  # a receiver speaks at least once a second
GARBAGE_BYTES: Final = 1500  # so much without a whole frame is the wrong rate
SURE_FRAMES: Final = 2
WRITE_S: Final = 2.0

Say = Callable[[str], None]


class SerialWire:
    """An open serial port, locked for us alone. ``first`` are bytes that were read already."""

    def __init__(self, port: "serial.Serial", detail: str, first: bytes = b"") -> None:
        self._port, self.detail, self._first = port, detail, first

    @property
    def bytes_per_s(self) -> float:
        """What the line carries: ten bits a byte; 0 where the baud rate means nothing (USB of the receiver itself)."""
        return 0.0 if "ttyACM" in os.path.realpath(self._port.port or "") else self._port.baudrate / 10.0

    def read(self) -> bytes | None:
        """Return what is there, waiting for the first byte; SourceError when the device has gone."""
        if self._first:
            data, self._first = self._first, b""
            return data
        return read_port(self._port, self.detail)

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver."""
        try:
            self._port.write(data)
        except TypeError as error:  # pyserial's way of saying that the reader has closed the port meanwhile
            raise ConnectionError("the port was closed") from error

    def set_baud(self, baud: int) -> None:
        """Go on at another rate, after what was written has left."""
        try:
            self._port.flush()
            self._port.baudrate = baud
        except (serial.SerialException, OSError, ValueError, termios.error) as error:
            raise ConnectionError(f"{self.detail}: cannot change to {baud} baud: {error}") from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class SerialPort:
    """Opens a serial port again and again; remembers the baud rate that it has found."""

    backoff: Backoff = LOCAL

    def __init__(self, url: SourceUrl, say: Say | None = None) -> None:
        self._url, self._say = url, say
        self._found = 0

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return the open port; SourceError says why there is none."""
        path = find_port(self._url.path)
        if self._url.options.get("baud") == "auto":
            return self._search(path, stopping)
        baud = int(self._url.number("baud", DEFAULT_BAUD))
        return SerialWire(open_port(path, baud), f"{path} at {baud} baud")

    def close(self) -> None:
        """Nothing is kept."""

    def _search(self, path: str, stopping: threading.Event) -> Wire | None:
        """Return the port at the rate at which whole frames come; each rate has the time of two epochs."""
        heard = 0
        for baud in sorted(BAUDS, key=lambda rate: rate != self._found):
            if stopping.is_set():
                return None
            if self._say is not None:
                self._say(f"{path}: looking for the baud rate, now {baud}")
            port = open_port(path, baud)
            try:
                data, frames = listen(port, path, stopping)
            except BaseException:
                port.close()
                raise
            if frames:
                self._found = baud
                return SerialWire(port, f"{path} at {baud} baud", data)
            port.close()
            heard += len(data)
        said = f"{heard} bytes, but no whole frame" if heard else "nothing comes"
        raise SourceError(f"{path}: {said} at any baud rate from {min(BAUDS)} to {max(BAUDS)}")


def open_port(path: str, baud: int) -> "serial.Serial":
    """Return an open port; SourceError says why it cannot be opened."""
    try:
        return serial.Serial(path, baud, timeout=POLL_S, write_timeout=WRITE_S, exclusive=True)
    except (serial.SerialException, ValueError, OSError) as error:
        raise SourceError(f"{path}: {_reason(error)}") from error


def read_port(port: "serial.Serial", path: str) -> bytes | None:
    """Return what is there, waiting for the first byte; SourceError when the device has gone."""
    try:
        return bytes(port.read(max(1, min(port.in_waiting, READ_BYTES)))) or None
    except (serial.SerialException, OSError) as error:
        raise SourceError(f"{path}: the device has gone (unplugged?)") from error


def listen(port: "serial.Serial", path: str, stopping: threading.Event) -> tuple[bytes, int]:
    """Return what comes within the time of two epochs, and how many whole frames are in it; ends early when that is clear."""
    framer, data, frames = Framer(), b"", 0
    deadline_s = time.monotonic() + LISTEN_S
    while time.monotonic() < deadline_s and not stopping.is_set():
        piece = read_port(port, path)
        if not piece:
            continue
        data += piece
        frames += len(framer.feed(piece))
        if frames >= SURE_FRAMES or (not frames and framer.counters.bytes_skipped > GARBAGE_BYTES):
            break
    return data, frames


def find_port(name: str, ports: Iterable[Any] | None = None) -> str:
    """Return the path of the one port that a name means; SourceError when there is none or more than one."""
    if name.startswith("/"):
        return _only(name, sorted(glob(name))) if any(sign in name for sign in "*?[") else name  # noqa: PTH207  a full pattern
    if name.startswith("by-id/"):
        found = sorted(map(str, BY_ID.glob(f"{name.removeprefix('by-id/')}*")))
        return _only(name, found)
    match = USB_NAME.fullmatch(name)
    if match is None:
        raise SourceError(f"{name!r} is no port: a path, by-id/NAME, VID:PID or VID:PID:SERIAL")
    wanted = int(match["vid"], 16), int(match["pid"], 16)
    fit = [port for port in (comports() if ports is None else ports) if (port.vid, port.pid) == wanted]
    return _only(name, sorted(port.device for port in fit if match["serial"] in (None, port.serial_number)))


def _only(name: str, found: list[str]) -> str:
    if not found:
        raise SourceError(f"{name}: no such device is plugged in")
    if len(found) > 1:
        raise SourceError(f"{name}: there are {len(found)} of them: {', '.join(found)}; say which")
    return found[0]


def _reason(error: Exception) -> str:
    text, number = str(error), getattr(error, "errno", None)
    if "lock" in text or number == errno.EBUSY:
        return "in use by another program"
    hints = {
        errno.ENOENT: "no such device is plugged in",
        errno.EACCES: "permission denied: the user must be in the device's group (dialout)",
    }
    return hints.get(number or 0) or (os.strerror(number) if number else text)
