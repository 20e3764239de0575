"""Serial ports that are plugged in, as presets: one for each port and baud rate, without what is known to be an autopilot."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from glob import glob
from typing import Any, Final

from serial.tools.list_ports import comports

from rtkmesh_schemas.config_presets import BasesTable, PresetTable

# USB vendors (and products) of autopilots, radios to drones and debug probes: a base station is none of them (USB ID repository, vendors'
# board definitions).
_AUTOPILOTS: Final[tuple[tuple[int, int | None], ...]] = (
    (0x26AC, None),  # 3D Robotics (PX4)
    (0x1209, 0x5740),  # ArduPilot, ChibiOS
    (0x1209, 0x5741),  # ArduPilot bootloader
    (0x2DAE, None),  # CubePilot
    (0x3162, None),  # Holybro
    (0x3185, None),  # Auterion
    (0x27AC, None),  # Laser Navigation (VRBrain)
    (0x0483, 0x5740),  # STM32 virtual port, of many autopilots
    (0x0483, 0x374B),  # ST-Link
    (0x35A7, None),  # CUAV
)


@dataclass(frozen=True, slots=True)
class FoundPort:
    """A preset of a port: the device's path and the table it is made of."""

    device: str
    table: PresetTable


def find_ports(bases: BasesTable, used: Iterable[str] = (), there: Iterable[Any] | None = None) -> dict[str, FoundPort]:
    """Return the presets of the ports that are plugged in, by id; ``used`` are the paths that processes of the file have."""
    taken = {os.path.realpath(path) for path in used}
    found: dict[str, FoundPort] = {}
    for device, label in _devices(bases, comports() if there is None else there):
        if os.path.realpath(device) in taken or any(fnmatchcase(text, glob_) for glob_ in bases.exclude for text in (device, label)):
            continue
        for index, baud in enumerate(bases.bauds):
            title = f"{label or device} ({baud} baud)" if len(bases.bauds) > 1 else label or device
            table = PresetTable(sources=(f"serial://{device}?baud={baud}",), title=title[:200], auto_survey=True)
            found[port_id(device, index)] = FoundPort(device, table)
    return found


def port_id(device: str, index: int) -> str:
    """Return the preset's id of a port and baud rate: ``/dev/ttyACM0`` at the first one is ``-dev-ttyACM0-0``."""
    name = f"{device}/{index}".replace("/", "-")
    return "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "_" for c in name)[-64:]


def _devices(bases: BasesTable, there: Iterable[Any]) -> Iterator[tuple[str, str]]:
    """Yield path and label of each port that may be a base station's."""
    for port in sorted(there, key=lambda port: str(port.device)):
        if port.vid is not None and not is_autopilot(int(port.vid), int(port.pid or 0)):
            yield str(port.device), str(port.product or port.description or "")
    for pattern in bases.devices:
        for path in sorted(glob(pattern)):  # noqa: PTH207  a full pattern
            yield path, ""


def is_autopilot(vid: int, pid: int) -> bool:
    """Return whether USB ids are those of an autopilot or its programmer."""
    return any(vid == vendor and product in (None, pid) for vendor, product in _AUTOPILOTS)
