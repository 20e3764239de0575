"""RTKLIB's stream paths: what is in them (decodetcppath, openserial, openfile of its stream.c)."""

import re
from dataclasses import dataclass, field
from typing import Final

from rtkmesh_services.errors import ConfError
from rtkmesh_services.runtime.words import clip

_HOST: Final = re.compile(r"[A-Za-z0-9._-]*|\[[0-9A-Fa-f:.]+\]")
_SPEED: Final = re.compile(r"\d+(\.\d*)?")


@dataclass(frozen=True, slots=True)
class NetworkPath:
    """``[user[:password]@]host[:port][/mount[:string]]``. ``port`` 0: none is said."""

    user: str
    password: str
    host: str
    port: int
    mount: str
    string: str


@dataclass(frozen=True, slots=True)
class SerialPath:
    """``port[:baud[:bits[:parity[:stop[:flow]]]]][#tcpport]``."""

    device: str
    baud: int
    strange: str
    tcp_port: int


@dataclass(frozen=True, slots=True)
class FilePath:
    """``path[::T][::+start][::xspeed][::S=hours][::P=4 or 8]``."""

    path: str
    tags: bool = False
    start_s: str = ""
    speed: str = ""
    swap_hours: str = ""
    unknown: list[str] = field(default_factory=list[str])


def network_path(text: str) -> NetworkPath:
    """Return the parts of a path to the network; ConfError for a port that is none, or a host that cannot be one."""
    where, mount, string = text, "", ""
    slash = text.find("/", max(text.rfind("@"), 0))
    if slash >= 0:
        where, rest = text[:slash], text[slash + 1 :]
        mount, _, string = rest.partition(":")
    credentials, at, address = where.rpartition("@")
    user, _, password = credentials.partition(":") if at else ("", "", "")
    host, _, port = address.partition(":")
    if port and not (port.isdecimal() and 0 < int(port) < 65536):
        raise ConfError(f"{clip(port)!r} is no port from 1 to 65535")
    if not _HOST.fullmatch(host):
        raise ConfError(f"{clip(host)!r} is no host")
    return NetworkPath(user, password, host, int(port or 0), mount, string)


def serial_path(text: str) -> SerialPath:
    """Return the parts of a serial port's path; ConfError for a rate that is none."""
    text, _, relay = text.partition("#")
    device, *parts = text.split(":")
    given: dict[str, str] = dict(zip(("baud", "bits", "parity", "stop", "flow"), parts, strict=False))
    usual = {"bits": "8", "parity": "n", "stop": "1", "flow": "off"}
    strange = [f"{name} {given[name]}" for name in usual if given.get(name, "").lower() not in ("", usual[name])]
    baud = given.get("baud") or "115200"
    if not device or not baud.isdecimal():
        raise ConfError(f"{clip(text)!r} is no port:baud:bits:parity:stop:flow")
    return SerialPath(device.removeprefix("/dev/"), int(baud), ", ".join(strange), int(relay) if relay.isdecimal() else 0)


def file_path(text: str) -> FilePath:
    """Return the parts of a file's path."""
    path, *marks = text.split("::")
    values: dict[str, str | bool] = {}
    unknown: list[str] = []
    for mark in marks:
        if mark == "T":
            values["tags"] = True
        elif mark[:1] in ("+", "x") and _SPEED.fullmatch(mark[1:]):
            values["start_s" if mark[0] == "+" else "speed"] = mark[1:]
        elif mark.startswith("S=") and _SPEED.fullmatch(mark[2:]):
            values["swap_hours"] = mark[2:]
        else:
            unknown.append(f"::{mark}")
    return FilePath(path, unknown=unknown, **values)  # pyright: ignore[reportArgumentType]  by name
