"""Serial ports."""

import os
import threading

import serial

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.urls import SourceUrl
from rtkmesh_services.ingest.wires import POLL_S, READ_BYTES, Wire
from rtkmesh_services.runtime.backoff import LOCAL


class SerialWire:
    """An open serial port, locked for us alone."""

    def __init__(self, path: str, baud: int) -> None:
        self.detail = path
        try:
            self._port = serial.Serial(path, baud, timeout=POLL_S, write_timeout=2.0, exclusive=True)
        except (serial.SerialException, ValueError) as error:
            number = getattr(error, "errno", None)
            raise SourceError(f"{path}: {os.strerror(number) if number else error}") from error

    def read(self) -> bytes | None:
        """Return what is there, waiting for the first byte."""
        data = self._port.read(max(1, min(self._port.in_waiting, READ_BYTES)))
        return bytes(data) or None

    def write(self, data: bytes) -> None:
        """Send bytes to the receiver."""
        try:
            self._port.write(data)
        except TypeError as error:  # pyserial's way of saying that the reader has closed the port meanwhile
            raise ConnectionError("the port was closed") from error

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class SerialPort:
    """Opens a serial port."""

    backoff = LOCAL

    def __init__(self, url: SourceUrl) -> None:
        self._url = url

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return the open port."""
        del stopping
        return SerialWire(self._url.path, int(self._url.number("baud", 115200)))

    def close(self) -> None:
        """Nothing is kept."""
