"""Receivers on serial ports: found again after unplugging, their baud rate found if asked."""

import os
import termios
import threading
import time
from collections.abc import Callable
from typing import Final

import serial

from rtkmesh.codecs.framing import Framer
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.ingest.wires import Wire
from rtkmesh_services.runtime.backoff import LOCAL, Backoff
from rtkmesh_services.runtime.port_names import DEFAULT_BAUD
from rtkmesh_services.runtime.serial_device import find_port, open_port, read_port

BAUDS: Final = (115200, 460800, 38400, 9600, 921600, 230400, 57600, 19200, 4800)  # in the order of what receivers are set to
LISTEN_S: Final = 2.2  # a receiver speaks at least once a second
GARBAGE_BYTES: Final = 1500  # so much without a whole frame is the wrong rate
SURE_FRAMES: Final = 2

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
