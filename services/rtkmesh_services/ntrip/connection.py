"""Connections to casters: TCP or TLS, one request, the answer told in words, then the content of the body.

Everything is bounded: connecting and the answer by ``ANSWER_S``, a source table by ``MAXIMUM_TABLE`` bytes and ``TABLE_S``.
"""

import select
import socket
import ssl
from dataclasses import dataclass, replace
from email.utils import parsedate_to_datetime
from time import monotonic, time
from typing import Final

from rtkmesh_services.errors import RefusedError, SourceError
from rtkmesh_services.ntrip.address import CasterAddress, shown_url
from rtkmesh_services.ntrip.protocol import Answer, AnswerReader, push_request, stream_request
from rtkmesh_services.ntrip.source_table import END_OF_TABLE, MountPoint, nearest_names, parse_table

ANSWER_S: Final = 10.0
TABLE_S: Final = 20.0
POLL_S: Final = 0.25
READ_BYTES: Final = 65536
MAXIMUM_TABLE: Final = 8 << 20
MAXIMUM_WAIT_S: Final = 3600.0
_LISTED: Final = 1 << 18  # bytes of a table that is read only to name the nearest mount point
_WRONG_VERSION: Final = frozenset({400, 405, 411, 501, 505})
_PASSING: Final = frozenset({408, 425, 429})


class AnswerError(SourceError):
    """What a caster sends makes no sense in the version that it was asked in."""


@dataclass(frozen=True, slots=True)
class TlsOptions:
    """``authority``: a file with certificates to trust instead of the system's; ``verify`` False trusts anybody."""

    authority: str = ""
    verify: bool = True

    def context(self) -> ssl.SSLContext:
        """Return the settings of a client; SourceError for a file that holds no certificates."""
        try:
            context = ssl.create_default_context(cafile=self.authority or None)
        except (OSError, ssl.SSLError) as error:
            raise SourceError(f"ca={self.authority}: {error.strerror or error}") from error
        if not self.verify:
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        return context


class CasterConnection:
    """One connection to a caster: ``ask`` once, then ``read``."""

    def __init__(self, address: CasterAddress, tls: TlsOptions = TlsOptions()) -> None:
        self.address = address
        self.answer: Answer | None = None
        self._reader = AnswerReader()
        self._first = b""
        self._chunked = False
        self._socket = _connected(address, tls)

    def ask(self, request: bytes) -> Answer:
        """Send a request and return the answer when it is a success; SourceError says why it is none, RefusedError for how long."""
        self._socket.sendall(request)
        deadline_s = monotonic() + ANSWER_S
        while not self._answered() and monotonic() < deadline_s:
            self._receive()
        self.answer = self._reader.known
        if self._reader.fault or self.answer is None:
            raise AnswerError(f"{self.address}: {self._reader.fault or f'no whole answer within {ANSWER_S:.0f} s'}")
        if self.answer.status in _WRONG_VERSION:
            raise AnswerError(f"{self.address}: {self.answer.status} {self.answer.reason}")
        if self.answer.status != 200:
            raise refused(self.address, self.answer)
        return self.answer

    def read(self) -> bytes | None:
        """Return further content, b"" at its end, None when nothing came for a while; SourceError for damaged chunks."""
        if self._first:
            data, self._first = self._first, b""
            return data
        if self._reader.ended:
            return b""
        try:
            received = self._socket.recv(READ_BYTES)
        except (TimeoutError, ssl.SSLWantReadError):
            return None
        except ssl.SSLEOFError:  # closed without the farewell of TLS
            return b""
        if not received:
            return b""
        content = self._reader.feed(received)
        if self._reader.fault:
            raise AnswerError(f"{self.address}: {self._reader.fault}")
        return content or None

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._socket.sendall(data)

    def has_news(self) -> bool:
        """Return whether there is something to read, or the end."""
        return has_news(self._socket)

    def set_timeout(self, seconds: float) -> None:
        """Set how long ``read`` and ``write`` wait."""
        self._socket.settimeout(seconds)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def table(self, maximum: int = MAXIMUM_TABLE) -> list[MountPoint]:
        """Return the source table that the body is, as far as it came within ``TABLE_S``; its end may be said in three ways."""
        content, deadline_s = b"", monotonic() + TABLE_S
        while len(content) < maximum and monotonic() < deadline_s and END_OF_TABLE not in content[-200:]:
            data = self.read()
            if data == b"":
                break
            content += data or b""
        return parse_table(content)

    def _receive(self) -> None:
        try:
            data = self._socket.recv(READ_BYTES)
        except (TimeoutError, ssl.SSLWantReadError):
            return
        except (ConnectionResetError, ssl.SSLEOFError):
            data = b""
        if not data:
            self._reader.end()
        else:
            self._first += self._reader.feed(data)

    def _answered(self) -> bool:
        """Return whether enough has come: of version 1 the first line, of a refusal too unless the rest may say when, or where."""
        known = self._reader.known
        if self._reader.fault or known is None:
            return bool(self._reader.fault)
        refused = known.status != 200 and known.status not in _PASSING and known.status // 100 not in (3, 5)
        return refused or known.is_loose or self._reader.answer is not None


def open_stream(address: CasterAddress, *, version: int = 2, gga: str = "", tls: TlsOptions = TlsOptions()) -> CasterConnection:
    """Return a connection that brings a mount point's data; SourceError says in words why there is none."""
    connection = CasterConnection(address, tls)
    try:
        answer = connection.ask(stream_request(address, version, gga))
        if answer.is_table:
            near = nearest_names(address.mount, connection.table(_LISTED))
            raise RefusedError(f"{address}: there is no mount point {address.mount!r}{near}", lasting=True)
        if answer.is_page:
            raise RefusedError(f"{address}: a web server answers, no caster", lasting=True)
    except BaseException:
        connection.close()
        raise
    return connection


def open_push(address: CasterAddress, *, version: int = 2, description: str = "", tls: TlsOptions = TlsOptions()) -> CasterConnection:
    """Return a connection that takes a mount point's data; SourceError says in words why there is none."""
    connection = CasterConnection(address, tls)
    try:
        connection.ask(push_request(address, version, description))
    except BaseException:
        connection.close()
        raise
    return connection


def fetch_table(address: CasterAddress, *, version: int = 2, tls: TlsOptions = TlsOptions()) -> list[MountPoint]:
    """Return the source table of a caster; SourceError says why there is none."""
    address = replace(address, mount="")
    connection = CasterConnection(address, tls)
    try:
        answer = connection.ask(stream_request(address, version))
        if answer.is_page:
            raise RefusedError(f"{address}: a web server answers, no caster", lasting=True)
        return connection.table()
    finally:
        connection.close()


def refused(address: CasterAddress, answer: Answer) -> RefusedError:
    """Return what an answer other than success means, and how long to leave the caster alone."""
    status, said = answer.status, f"{answer.status} {answer.reason}".strip() if answer.status else answer.reason
    wait_s = _retry_after_s(answer.headers.get("retry-after", ""))
    lasting = status // 100 in (0, 3, 4) and status not in _PASSING
    return RefusedError(f"{address}: {said}{_meaning(address, answer)}", wait_s, lasting=lasting)


def _meaning(address: CasterAddress, answer: Answer) -> str:
    status = answer.status
    if status == 401 and not address.user and not address.password:
        return ": the mount point wants a user and a password (ntrip://USER:PASSWORD@HOST/MOUNT)"
    if status == 401:
        return f": the caster does not take this password of user {address.user!r}"
    if status == 404:
        return f": there is no mount point {address.mount!r}"
    if status // 100 == 3:
        return f": it sends us to {shown_url(answer.headers.get('location', '')) or 'nowhere'}; if that is right, write it into the file"
    return {403: ": this user may not have this mount point", 409: ": somebody else feeds this mount point"}.get(status, "")


def _retry_after_s(text: str) -> float:
    """Return how long the header Retry-After asks to wait (RFC 9110, 10.2.3): seconds, or a date."""
    if text.isdecimal() and len(text) < 10:
        return min(float(text), MAXIMUM_WAIT_S)
    try:
        return min(max(0.0, parsedate_to_datetime(text).timestamp() - time()), MAXIMUM_WAIT_S) if text else 0.0
    except (ValueError, TypeError, OverflowError, OSError):  # what dates far from ours raise
        return 0.0


def _connected(address: CasterAddress, tls: TlsOptions) -> socket.socket:
    try:
        plain = socket.create_connection((address.host, address.port), timeout=ANSWER_S)
    except OSError as error:
        raise SourceError(f"{address}: {error.strerror or error}") from error
    plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        connection = tls.context().wrap_socket(plain, server_hostname=address.host) if address.tls else plain
    except (OSError, ssl.SSLError) as error:
        plain.close()
        raise _tls_refusal(address, error) from error
    except BaseException:
        plain.close()
        raise
    connection.settimeout(POLL_S)
    return connection


def _tls_refusal(address: CasterAddress, error: OSError) -> SourceError:
    if isinstance(error, ssl.SSLCertVerificationError):
        return RefusedError(
            f"{address}: its certificate is not trusted: {error.verify_message} (another authority: ?ca=FILE)", lasting=True
        )
    return SourceError(f"{address}: no TLS: {getattr(error, 'reason', '') or error.strerror or error}")


def has_news(connection: socket.socket) -> bool:
    """Return whether there is something to read, or the end; OSError when another thread of ours has closed it."""
    try:
        return bool(select.select([connection], [], [], 0.0)[0])
    except ValueError:  # it has no number any more
        raise ConnectionAbortedError("closed by us") from None
