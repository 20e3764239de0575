"""Which serial ports there are, and who is behind them."""

import re
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from serial.tools.list_ports import comports

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers.configure import Talker, version_of
from rtkmesh_services.ingest.receivers.orders import Answer, Order
from rtkmesh_services.ingest.receivers.text_receivers import unicore
from rtkmesh_services.ingest.receivers.ublox import poll
from rtkmesh_services.ingest.serial_ports import BAUDS, SerialWire, listen
from rtkmesh_services.runtime.port_names import DEFAULT_BAUD
from rtkmesh_services.runtime.serial_device import BY_ID, open_port

FIRST_WITH_KEYS: Final = 27
ASKED_BAUDS: Final = BAUDS[:4]  # at which a receiver is asked that sends nothing by itself
_KNOWN: Final = {
    (0x1546, 0x01A8): "u-blox M8",
    (0x1546, 0x01A9): "u-blox F9 or later",
    (0x152A, 0x85C0): "Septentrio",
    (0x0403, 0x6001): "FTDI adapter",
    (0x0403, 0x6015): "FTDI adapter",
    (0x1A86, 0x7523): "CH340 adapter",
    (0x10C4, 0xEA60): "CP210x adapter",
}
_PROTOCOLS: Final = {"ubx": "u-blox", "rtcm3": "RTCM 3", "nmea": "NMEA"}


@dataclass(frozen=True, slots=True)
class Port:
    """A serial port. ``url`` is how a deployment file names it so that it is found again; ``looks_like`` says its USB ids in words."""

    device: str
    usb: str = ""
    serial_number: str = ""
    product: str = ""
    by_id: str = ""
    url: str = ""
    looks_like: str = ""


@dataclass(frozen=True, slots=True)
class Probed:
    """Who is behind a port: ``state`` is found, in use, silent or unknown; ``sends`` are protocols."""

    state: str
    baud: int = 0
    sends: tuple[str, ...] = ()
    receiver: str = ""
    version: str = ""
    detail: str = ""


def ports(there: Iterable[Any] | None = None) -> list[Port]:
    """Return the serial ports of this computer."""
    found = list(comports() if there is None else there)
    return [_port(port, found) for port in sorted(found, key=lambda port: str(port.device))]


def _port(port: Any, others: list[Any]) -> Port:
    device = str(port.device)
    if port.vid is None or port.pid is None:
        return Port(device, url=f"serial://{device}")
    usb, number = f"{port.vid:04x}:{port.pid:04x}", str(port.serial_number or "")
    twins = [other for other in others if (other.vid, other.pid) == (port.vid, port.pid)]
    by_id = by_id_name(device)
    if len(twins) == 1:
        url = f"serial://{usb}"
    elif number and sum(other.serial_number == number for other in twins) == 1:
        url = f"serial://{usb}:{number}"
    else:
        url = f"serial://by-id/{by_id}" if by_id else f"serial://{device}"
    return Port(device, usb, number, str(port.product or port.description or ""), by_id, url, _KNOWN.get((port.vid, port.pid), ""))


def by_id_name(device: str) -> str:
    """Return the name of a device in /dev/serial/by-id, or nothing."""
    real = Path(device).resolve()
    return next((link.name for link in sorted(BY_ID.glob("*")) if link.resolve() == real), "")


def probe(device: str) -> Probed:
    """Find out who is behind a port: listen at every baud rate, then ask. Never takes a port that is in use."""
    bauds = (DEFAULT_BAUD,) if "ttyACM" in device else BAUDS
    heard = 0
    try:
        for baud in bauds:
            port = open_port(device, baud)
            wire = SerialWire(port, device)
            try:
                data, frames = listen(port, device, threading.Event())
                heard += len(data)
                if frames:
                    return _named(wire, baud, Framer().feed(data))
            finally:
                wire.close()
        for baud in ASKED_BAUDS if not heard else ():
            wire = SerialWire(open_port(device, baud), device)
            try:
                receiver, version = _ask(wire)
                if receiver:
                    return Probed("found", baud, (), receiver, version)
            finally:
                wire.close()
    except SourceError as error:
        return Probed("in use" if "in use" in str(error) else "unknown", detail=str(error))
    return Probed("unknown", detail=f"{heard} bytes, but no whole frame at any baud rate") if heard else Probed("silent")


def _named(wire: SerialWire, baud: int, frames: list[Frame]) -> Probed:
    sends = tuple(sorted({_PROTOCOLS[frame.protocol.value] for frame in frames if frame.protocol.value in _PROTOCOLS}))
    receiver, version = _ask(wire)
    return Probed("found", baud, sends, receiver or "other", version)


def _ask(wire: SerialWire) -> tuple[str, str]:
    """Return language and version of the receiver behind an open port, nothing where it answers to neither question."""
    talker = Talker(wire)
    talker.tell(poll(0x0A, 0x04, "MON-VER"))
    versions = [version for heard in talker.heard if (version := version_of(heard))]
    if versions:
        return ublox_language(versions[0]), versions[0]
    order = unicore("VERSIONA")
    quick = Order(order.said, b"\r\n" + order.data, _is_version, needed=False, attempts=1)  # what was asked in UBX ends there
    talker.tell(quick)
    named = [line.partition(";")[2].partition("*")[0] for line in talker.heard if isinstance(line, str) and "#VERSIONA," in line]
    return ("unicore", named[0].replace('"', "")) if named else ("", "")


def ublox_language(version: str) -> str:
    """Return how a u-blox receiver is configured, by the version that it says: by keys from protocol 27 on (F9), else by messages."""
    found = re.search(r"PROTVER[= ](\d+)", version)
    return "ublox" if found is not None and int(found[1]) >= FIRST_WITH_KEYS else "ublox-legacy"


def _is_version(heard: object) -> Answer | None:
    return Answer(accepted=True) if isinstance(heard, str) and "#VERSIONA," in heard else None
