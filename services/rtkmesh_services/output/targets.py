"""Where an output stream goes: a new file, TCP clients of ours, a TCP server, UDP. A slow or absent taker never slows the solver."""

import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol
from urllib.parse import parse_qsl, urlsplit

from rtkmesh_schemas.config import OutputTable
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.address import NTRIP_SCHEMES, PORT, CasterAddress, parse_caster, shown_url
from rtkmesh_services.ntrip.connection import TlsOptions
from rtkmesh_services.runtime.path_keywords import expanded, swap_number

SEND_BUFFER: Final = 1 << 20  # bytes that a TCP client may be behind before it is dropped
RETRY_TICKS: Final = 10


class Target(Protocol):
    """Takes whole lines."""

    detail: str

    def send(self, header: bytes, line: bytes) -> None:
        """Write a line; the header goes before the first one of every file or connection. OSError when it fails."""
        ...

    def tick(self) -> None:
        """Accept, reconnect, flush."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class FileTarget:
    """A new file, every ``swap_hours`` the next one; an existing one is never touched. The path may have RTKLIB's keywords."""

    def __init__(self, path: str, swap_hours: float = 0.0, utc_ns: Callable[[], int] = time.time_ns) -> None:
        self._path, self._swap_hours, self._utc_ns = path, swap_hours, utc_ns
        self.detail = path
        self._open()

    def send(self, header: bytes, line: bytes) -> None:
        """Append a line."""
        if swap_number(self._utc_ns(), self._swap_hours) != self._number:
            self._file.close()
            self._open()
        self._file.write(header + line if self._empty else line)
        self._empty = False

    def tick(self) -> None:
        """Hand what was written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _open(self) -> None:
        utc_ns = self._utc_ns()
        path = stem = Path(expanded(self._path, utc_ns))
        number = 0
        while path.exists():
            number += 1
            path = stem.with_name(f"{stem.stem}-{number}{stem.suffix}")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.detail, self._number, self._empty = str(path), swap_number(utc_ns, self._swap_hours), True
        self._file = path.open("xb")


class StdoutTarget:
    """The process's standard output."""

    detail = "standard output"

    def __init__(self) -> None:
        self._empty = True

    def send(self, header: bytes, line: bytes) -> None:
        """Write a line."""
        sys.stdout.buffer.write(header + line if self._empty else line)
        self._empty = False

    def tick(self) -> None:
        """Hand on what was written."""
        sys.stdout.buffer.flush()

    def close(self) -> None:
        """Hand on what was written; the rest is the process's."""
        with suppress(OSError):
            sys.stdout.buffer.flush()


class TcpListenTarget:
    """A TCP server: every client gets every line; one that does not read is dropped."""

    def __init__(self, host: str, port: int) -> None:
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._clients: list[socket.socket] = []
        self.detail = f"{host}:{port}, no clients"
        self._where = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line to all clients."""
        self._accept(header)
        for client in tuple(self._clients):
            try:
                client.sendall(line)
            except OSError:
                client.close()
                self._clients.remove(client)
        self.detail = f"{self._where}, {len(self._clients)} clients"

    def tick(self) -> None:
        """Nothing to do: clients are accepted with the next line."""

    def close(self) -> None:
        """Close all."""
        for client in (*self._clients, self._listener):
            client.close()

    def _accept(self, header: bytes) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            client.send(header)
            self._clients.append(client)


class TcpTarget:
    """A connection to a server, made anew when it breaks."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket: socket.socket | None = None
        self._ticks = RETRY_TICKS
        self._fresh = True
        self.detail = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line; lines are lost while nothing is connected."""
        if self._socket is None:
            raise ConnectionError(f"{self.detail} is not connected")
        try:
            self._socket.sendall(header + line if self._fresh else line)
            self._fresh = False
        except OSError:
            self.close()
            raise

    def tick(self) -> None:
        """Connect when it is time to try again."""
        self._ticks += 1
        if self._socket is not None or self._ticks < RETRY_TICKS:
            return
        self._ticks = 0
        try:
            self._socket = socket.create_connection(self._address, timeout=0.2)
            self._fresh = True
        except OSError:
            self._socket = None

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class UdpTarget:
    """Datagrams, one line each, without header."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.detail = f"{host}:{port}"

    def send(self, header: bytes, line: bytes) -> None:
        """Send a line."""
        del header
        self._socket.sendto(line, self._address)

    def tick(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


_OPEN: Final[dict[str, Callable[[str, int], Target]]] = {"tcp-listen": TcpListenTarget, "tcp": TcpTarget, "udp": UdpTarget}
CASTER_SCHEME: Final = "ntrip-caster"
_PUSH_OPTIONS: Final = {"version": "1 or 2; default 2 with a user, 1 without", "ca": "as for sources", "verify": "as for sources"}


@dataclass(frozen=True, slots=True)
class TargetUrl:
    """Where a stream goes: a path, or host and port, or a mount point of a caster that is fed."""

    scheme: str
    path: str = ""
    host: str = ""
    port: int = 0
    caster: CasterAddress | None = None
    version: int = 0
    swap_hours: float = 0.0
    tls: TlsOptions = field(default_factory=TlsOptions)

    def __str__(self) -> str:
        return str(self.caster) if self.caster is not None else f"{self.scheme}://{self.path or f'{self.host}:{self.port}'}"


def open_target(url: str) -> Target:
    """Return the target of a URL: file://PATH, stdout://, tcp-listen://HOST:PORT, tcp://HOST:PORT, udp://HOST:PORT."""
    target = parse_target(url)
    if target.scheme == "stdout":
        return StdoutTarget()
    return FileTarget(target.path, target.swap_hours) if target.scheme == "file" else _OPEN[target.scheme](target.host, target.port)


def parse_target(url: str) -> TargetUrl:
    """Return the parts of a target's URL; SourceError says what is wrong with it."""
    scheme, found, rest = url.partition("://")
    if scheme == "file" and rest:
        return _file_target(url, rest)
    if scheme == "stdout" and not rest:
        return TargetUrl(scheme)
    if scheme in NTRIP_SCHEMES:
        return _push_target(url, scheme)
    if not found or scheme not in (*_OPEN, CASTER_SCHEME):
        known = ("file", "stdout", *_OPEN, *NTRIP_SCHEMES, CASTER_SCHEME)
        raise SourceError(f"{shown_url(url)!r}: unknown target; targets are {', '.join(s + '://' for s in known)}")
    parts = urlsplit(url)
    try:
        port = parts.port or (PORT if scheme == CASTER_SCHEME else None)
    except ValueError:
        port = None
    if not port:
        raise SourceError(f"{shown_url(url)!r}: needs host:port")
    return TargetUrl(scheme, host=parts.hostname or "127.0.0.1", port=port)


def check_output(table: OutputTable) -> None:
    """SourceError for a target that does not fit what is to be sent, or that lets in everybody without being told to."""
    target = parse_target(table.target)
    if table.solver and (target.caster is not None or target.scheme == CASTER_SCHEME):
        raise SourceError(f"'{target}': casters take a receiver's frames, not a solver's lines: say receiver or mounts")
    if target.scheme == CASTER_SCHEME and not (table.users or table.anonymous or _is_loopback(target.host)):
        raise SourceError(f"'{target}': everybody could read: say users, or anonymous = true to allow it")


def _file_target(url: str, rest: str) -> TargetUrl:
    """Return the target of a file, with ``?swap=HOURS`` or RTKLIB's ``::S=HOURS``."""
    path, _, query = rest.partition("?")
    path, *marks = path.split("::")
    options = dict(parse_qsl(query, keep_blank_values=True))
    for mark in marks:
        options.update({"swap": mark[2:]} if mark.startswith("S=") else {f"::{mark}": ""})
    unknown = next((name for name in options if name != "swap"), None)
    if unknown is not None or not path:
        raise SourceError(f"{url!r}: {f'unknown option {unknown!r}; a file has swap=HOURS' if unknown else 'needs a path'}")
    try:
        hours = float(options.get("swap", "0"))
    except ValueError:
        hours = -1.0
    if not 0.0 <= hours <= 1e6:
        raise SourceError(f"{url!r}: swap={options['swap']!r} is no number of hours")
    return TargetUrl("file", path=path, swap_hours=hours)


def _push_target(url: str, scheme: str) -> TargetUrl:
    address, query = parse_caster(url)
    if not address.mount:
        raise SourceError(f"'{address}': says no mount point to feed")
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name, value in options.items():
        allowed = {"version": ("1", "2"), "verify": ("yes", "no")}.get(name, (value,))
        if name not in _PUSH_OPTIONS or (scheme == "ntrip" and name != "version"):
            raise SourceError(f"'{address}': unknown option {name!r}; known are {', '.join(_PUSH_OPTIONS)}")
        if value not in allowed:
            raise SourceError(f"'{address}': {name}={value!r}: allowed are {', '.join(allowed)}")
    version = int(options.get("version", "2" if address.user else "1"))
    if version == 1 and any(character.isspace() for character in address.password):
        raise SourceError(f"'{address}': a password with spaces needs version=2")
    tls = TlsOptions(authority=options.get("ca", ""), verify=options.get("verify") != "no")
    return TargetUrl(scheme, host=address.host, port=address.port, caster=address, version=version, tls=tls)


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
