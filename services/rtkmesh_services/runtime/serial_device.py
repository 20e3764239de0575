"""Serial ports: by path, by-id name or USB ids, locked for us alone.

The name of a port is looked up anew at every opening: ``/dev/ttyACM0`` (also with ``*``), ``by-id/usb-u-blox...`` (a beginning is
enough), ``1546:01a9`` or ``1546:01a9:SERIAL``.
"""

import errno
import os
import termios
from collections.abc import Iterable
from glob import glob
from pathlib import Path
from typing import Any, Final

import serial
from serial.tools.list_ports import comports

from rtkmesh_services.errors import SourceError
from rtkmesh_services.runtime import port_names
from rtkmesh_services.runtime.port_names import USB_NAME

BY_ID: Final = Path(port_names.BY_ID)

POLL_S: Final = 0.25  # how soon a blocked reader notices that it shall stop
READ_BYTES: Final = 65536
WRITE_S: Final = 2.0


def open_port(path: str, baud: int, write_s: float = WRITE_S) -> "serial.Serial":
    """Return an open port whose writes may take ``write_s``; SourceError says why it cannot be opened."""
    try:
        return serial.Serial(path, baud, timeout=POLL_S, write_timeout=write_s, exclusive=True)
    except termios.error as error:  # no OSError: a device that goes while it is being opened
        raise SourceError(f"{path}: {_reason(OSError(*error.args))}") from error
    except (serial.SerialException, ValueError, OSError) as error:
        raise SourceError(f"{path}: {_reason(error)}") from error


def read_port(port: "serial.Serial", path: str) -> bytes | None:
    """Return what is there, waiting for the first byte; SourceError when the device has gone."""
    try:
        return bytes(port.read(max(1, min(port.in_waiting, READ_BYTES)))) or None
    except (serial.SerialException, OSError) as error:
        raise SourceError(f"{path}: the device has gone (unplugged?)") from error


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
