"""What a client asks a caster, and what it is told: no socket, no clock."""

import hmac
import re
from base64 import b64decode
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from email.utils import formatdate
from typing import Final
from urllib.parse import unquote

from rtkmesh_services.ntrip.protocol import AGENT, printable
from rtkmesh_services.ntrip.source_table import END_OF_TABLE, MountPoint, table_row

MAXIMUM_REQUEST: Final = 8192
_LINE: Final = re.compile(r"([A-Z]+) +(\S*)(?: +\S+)?")


@dataclass(frozen=True, slots=True)
class Request:
    """A client's request. ``version`` is 2 where the client says so."""

    method: str
    mount: str
    version: int
    user: str = ""
    password: str = ""
    agent: str = ""


def parse_request(data: bytes) -> Request | None:
    """Return the request whose header is whole in ``data``; the method is empty where it is none; None: more is needed."""
    header, found, _ = data.replace(b"\r\n", b"\n").partition(b"\n\n")
    if not found:
        return Request("", "", 1) if len(data) > MAXIMUM_REQUEST else None
    first, *lines = (printable(line) for line in header.split(b"\n"))
    match = _LINE.fullmatch(first)
    if match is None:
        return Request("", "", 1)
    fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    version = 2 if fields.get("ntrip-version", "").lower().startswith("ntrip/2") else 1
    user, password = _credentials(fields.get("authorization", ""))
    mount = unquote(match[2].partition("?")[0]).lstrip("/")
    return Request(match[1], mount, version, user, password, fields.get("user-agent", "")[:100])


def _credentials(text: str) -> tuple[str, str]:
    scheme, _, code = text.partition(" ")
    if scheme.lower() != "basic":
        return "", ""
    try:
        user, _, password = b64decode(code.strip(), validate=True).decode().partition(":")
    except ValueError:  # no base64, no UTF-8
        return "", ""
    return user, password


def is_allowed(request: Request, users: Mapping[str, str]) -> bool:
    """Return whether a request carries one of the users with the right password; without users everybody is allowed."""
    known = users.get(request.user)
    right = hmac.compare_digest(request.password.encode(), (known or "").encode())
    return not users or (known is not None and right)


def stream_answer(version: int) -> bytes:
    """Return what goes before the data. Version 1 has a blank line: clients that want none take it for two bytes of noise."""
    if version == 1:
        return b"ICY 200 OK\r\n\r\n"
    return _answer("200 OK", "Content-Type: gnss/data", "Cache-Control: no-store", "Transfer-Encoding: chunked")


def table_answer(version: int, rows: Iterable[MountPoint]) -> bytes:
    """Return the whole source table."""
    lines = [table_row(row) for row in rows]
    body = "".join(f"{line}\r\n" for line in lines).encode() + END_OF_TABLE + b"\r\n"
    if version == 1:
        return f"SOURCETABLE 200 OK\r\nServer: {AGENT}\r\nContent-Type: text/plain\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body
    return _answer("200 OK", "Content-Type: gnss/sourcetable", f"Content-Length: {len(body)}") + body


def source_refusal() -> bytes:
    """Return what a server of version 1 is told."""
    return b"ERROR - this caster takes no sources\r\n"


def refusal_answer(version: int, status: str, *headers: str) -> bytes:
    """Return an answer without content."""
    return _answer(status, *headers, "Content-Length: 0", protocol="HTTP/1.0" if version == 1 else "HTTP/1.1")


def _answer(status: str, *headers: str, protocol: str = "HTTP/1.1") -> bytes:
    fixed = ("Ntrip-Version: Ntrip/2.0", f"Server: {AGENT}", f"Date: {formatdate(usegmt=True)}", "Connection: close")
    return "".join(f"{line}\r\n" for line in (f"{protocol} {status}", *fixed, *headers, "")).encode()
