"""How serial ports are called in files: ``/dev/NAME`` (also with ``*``), ``by-id/NAME``, ``VID:PID``, ``VID:PID:SERIAL``."""

import re
from glob import glob
from os.path import realpath
from typing import Final

BY_ID: Final = "/dev/serial/by-id"
DEFAULT_BAUD: Final = 115200
USB_NAME: Final = re.compile(r"(?P<vid>[0-9A-Fa-f]{4}):(?P<pid>[0-9A-Fa-f]{4})(?::(?P<serial>.+))?")


def is_port_name(name: str) -> bool:
    """Return whether a text names a serial port."""
    return name.startswith(("/", "by-id/")) or USB_NAME.fullmatch(name) is not None


def is_same_port(one: str, other: str) -> bool:
    """Return whether two names are known to mean one device: they are equal, or lead to one that is plugged in now."""
    if one.casefold() == other.casefold():
        return True
    first, second = _devices(one), _devices(other)
    return bool(first and second) and bool(first & second)


def _devices(name: str) -> set[str]:
    if USB_NAME.fullmatch(name):  # who has these ids is known when it is opened
        return set()
    pattern = f"{BY_ID}/{name.removeprefix('by-id/')}*" if name.startswith("by-id/") else name
    return {realpath(path) for path in glob(pattern)}  # noqa: PTH207  a full pattern
