"""What goes over the wire between NTRIP clients, servers and casters, versions 1 and 2: no socket, no clock.

Rules of this file: an answer depends only on the bytes, never on how they were cut into pieces; nothing raises for what a
caster sent: ``fault`` says what is wrong; what is held back is bounded (``MAXIMUM_HEADER``, ``MAXIMUM_CHUNK_LINE``).

A caster of version 1 answers ``ICY 200 OK`` and sends data behind it, with or without header lines and a blank line between
them. So, after ICY, what does not look like a header line is data. Sources: NTRIP 1.0 (RTCM paper 200-2004), NTRIP 2.0 (RTCM
10410.1), RFC 9112, and what casters really do.
"""

import re
from base64 import b64encode
from dataclasses import dataclass, field
from typing import Final, Protocol

from rtkmesh import __version__
from rtkmesh_services.ntrip.address import CasterAddress

AGENT: Final = f"NTRIP rtkmesh/{__version__}"
MAXIMUM_HEADER: Final = 16384
MAXIMUM_CHUNK_LINE: Final = 1024
_STATUS: Final = re.compile(r"(ICY|SOURCETABLE|HTTP/\d\.\d)\s+(\d{3})\b\s*(.*)")
_BEGINNINGS: Final = (b"ICY ", b"SOURCETABLE ", b"HTTP/", b"ERROR", b"OK")
_HEADER_LINE: Final = re.compile(rb"[A-Za-z][A-Za-z0-9-]*:[\t -~]*")
_HEADER_BEGINNING: Final = re.compile(rb"[A-Za-z][A-Za-z0-9-]*(?::[\t -~]*)?\r?|\r")
_CHUNK_SIZE: Final = re.compile(rb"\s*([0-9A-Fa-f]{1,8})\s*(?:;.*)?")
_LETTERS: Final = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a caster said before the data: ``protocol`` is ICY, SOURCETABLE, HTTP/1.1, OK or ERROR; header names in lower case."""

    protocol: str
    status: int
    reason: str
    headers: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def is_table(self) -> bool:
        """Whether the body is a source table."""
        return self.protocol == "SOURCETABLE" or self.headers.get("content-type", "").startswith("gnss/sourcetable")

    @property
    def is_loose(self) -> bool:
        """Whether it is of version 1, where header and blank line may be missing."""
        return self.protocol in ("ICY", "SOURCETABLE", "OK", "ERROR")

    @property
    def is_page(self) -> bool:
        """Whether the body is a web page."""
        return self.headers.get("content-type", "").startswith("text/html")


class Body(Protocol):
    """Undoes the transfer coding of a body."""

    ended: bool
    fault: str

    def feed(self, data: bytes) -> bytes:
        """Return the content in these further bytes."""
        ...


class PlainBody:
    """A body as it is, up to the end of the connection or for ``length`` bytes."""

    def __init__(self, length: int | None = None) -> None:
        self._left = length
        self.ended = length == 0
        self.fault = ""

    def feed(self, data: bytes) -> bytes:
        """Return the content."""
        if self._left is None:
            return data
        data = data[: self._left]
        self._left -= len(data)
        self.ended = self._left == 0
        return data


class ChunkedBody:
    """A chunked body (RFC 9112, 7.1): extensions are skipped, trailers too, chunks need not be frames."""

    def __init__(self) -> None:
        self._pending = b""
        self._left = 0  # content bytes of the present chunk, then its line end
        self._content = False
        self.ended = False
        self.fault = ""

    def feed(self, data: bytes) -> bytes:
        """Return the content."""
        data, self._pending = self._pending + data, b""
        parts: list[bytes] = []
        while data and not self.ended and not self.fault:
            if self._content:
                parts.append(data[: self._left])
                data = self._after_content(data)
            else:
                data = self._line(data)
        return b"".join(parts)

    def _after_content(self, data: bytes) -> bytes:
        rest = data[self._left :]
        self._left -= min(self._left, len(data))
        self._content = self._left > 0
        return rest

    def _line(self, data: bytes) -> bytes:
        """Take one line between chunks; an unfinished one is kept."""
        line, found, rest = data.partition(b"\n")
        if len(line) > MAXIMUM_CHUNK_LINE:
            self.fault = "a chunk's header does not end"
        elif not found:
            self._pending = line
        elif line := line.rstrip(b"\r"):
            self._begin(line)
        return rest

    def _begin(self, line: bytes) -> None:
        size = _CHUNK_SIZE.fullmatch(line)
        if size is None:
            self.fault = f"{printable(line[:20])!r} is no chunk's header"
            return
        self._left = int(size[1], 16)
        self._content = self._left > 0
        self.ended = not self._content


class AnswerReader:
    """Cuts what a caster sends into its answer and the content of the body."""

    def __init__(self) -> None:
        self.answer: Answer | None = None
        self.fault = ""
        self._pending = b""
        self._header_bytes = 0
        self._status: tuple[str, int, str] | None = None
        self._headers: dict[str, str] = {}
        self._body: Body = PlainBody()

    @property
    def known(self) -> Answer | None:
        """What is known of the answer: its first line is enough where casters send no more of it before there is data."""
        return self.answer or (Answer(*self._status, self._headers) if self._status is not None else None)

    @property
    def ended(self) -> bool:
        """Whether the body says that it is complete."""
        return self._body.ended

    def feed(self, data: bytes) -> bytes:
        """Take further bytes; return what of the body's content they complete."""
        if self.answer is None:
            self._pending += data
            self._read_header()
            if self.answer is None:
                return b""
            data, self._pending = self._pending, b""
        content = self._body.feed(data)
        self.fault = self.fault or self._body.fault
        return content

    def end(self) -> None:
        """The connection is at its end: an answer without a blank line is complete, none at all is a fault."""
        if self.answer is not None or self.fault:
            return
        if self._status is None:
            self.fault = "closed the connection without an answer" if not self._pending else self._no_answer()
        else:
            self._complete()

    def _read_header(self) -> None:
        while self.answer is None and not self.fault and self._pending:
            before = len(self._pending)
            if self._status is None:
                self._read_status()
            else:
                self._read_header_line()
            self._header_bytes += before - len(self._pending)
            if self._header_bytes + (len(self._pending) if self.answer is None else 0) > MAXIMUM_HEADER:
                self.fault, self.answer = f"sends a header without end (more than {MAXIMUM_HEADER} bytes)", None
            if before == len(self._pending):
                return  # the line is not whole

    def _read_status(self) -> None:
        self._pending = pending = self._pending.lstrip(b"\r\n")
        if not any(pending[: len(word)] == word[: len(pending)] for word in _BEGINNINGS):
            self.fault = self._no_answer()
            return
        line, found, rest = pending.partition(b"\n")
        if not found:
            return
        self._pending, text = rest, printable(line.rstrip(b"\r"))
        match = _STATUS.fullmatch(text)
        if match is not None:
            self._status = match[1], int(match[2]), match[3]
        elif text.startswith("ERROR"):
            self._status = "ERROR", 0, text
        elif text.split()[0] == "OK":
            self._status = "OK", 200, ""
        else:
            self.fault = self._no_answer(line)

    def _read_header_line(self) -> None:
        assert self.known is not None, "the first line was read"
        loose, pending = self.known.is_loose, self._pending
        if loose and pending[0] not in _LETTERS and pending[:1] not in (b"\r", b"\n"):
            self._complete()
            return
        line, found, rest = pending.partition(b"\n")
        if not found:
            if loose and not _HEADER_BEGINNING.fullmatch(line):
                self._complete()
            return
        line = line.rstrip(b"\r")
        if loose and line and not _HEADER_LINE.fullmatch(line):
            self._complete()
            return
        self._pending = rest
        if not line:
            self._complete()
            return
        name, _, value = line.partition(b":")
        self._headers[printable(name).strip().lower()] = printable(value).strip()

    def _complete(self) -> None:
        assert self._status is not None, "the first line was read"
        self.answer = Answer(*self._status, self._headers)
        length = self._headers.get("content-length", "")
        if "chunked" in self._headers.get("transfer-encoding", "").lower():
            self._body = ChunkedBody()
        elif self.answer.is_table and length.isdecimal() and len(length) < 10:
            self._body = PlainBody(int(length))

    def _no_answer(self, line: bytes | None = None) -> str:
        return f"is no NTRIP caster: it sends {printable((self._pending if line is None else line)[:40])!r}"


def stream_request(address: CasterAddress, version: int, gga: str = "") -> bytes:
    """Return the request for a mount point, or for the source table where the mount point is empty."""
    lines = [f"GET /{address.mount} HTTP/1.{0 if version == 1 else 1}"]
    if version != 1:
        lines += [f"Host: {address.host_header}", "Ntrip-Version: Ntrip/2.0"]
    lines += [f"User-Agent: {AGENT}", *_authorization(address)]
    if version != 1:
        lines += [f"Ntrip-GGA: {gga.strip()}"] if gga else []
        lines += ["Connection: close"]
    return _joined(lines)


def push_request(address: CasterAddress, version: int, description: str = "") -> bytes:
    """Return the request of a server that will send a mount point's data: SOURCE of version 1, POST of version 2."""
    if version == 1:
        return _joined([f"SOURCE {address.password} /{address.mount}", f"Source-Agent: {AGENT}", f"STR: {description}"])
    lines = [f"POST /{address.mount} HTTP/1.1", f"Host: {address.host_header}", "Ntrip-Version: Ntrip/2.0", f"User-Agent: {AGENT}"]
    lines += [*_authorization(address), "Content-Type: gnss/data", "Transfer-Encoding: chunked", "Connection: close"]
    return _joined(lines)


def chunk(data: bytes) -> bytes:
    """Return a chunk of a chunked body."""
    return b"%x\r\n%b\r\n" % (len(data), data)


def printable(data: bytes) -> str:
    """Return foreign bytes as text without control characters."""
    return "".join(character if character.isprintable() else "�" for character in data.decode("cp1252", "replace"))


def _authorization(address: CasterAddress) -> list[str]:
    if not address.user and not address.password:
        return []
    return [f"Authorization: Basic {b64encode(f'{address.user}:{address.password}'.encode()).decode()}"]


def _joined(lines: list[str]) -> bytes:
    return "".join(f"{line}\r\n" for line in [*lines, ""]).encode()
