"""The bus as services see it: publish, subscribe, answer, ask, be alive. ``ZenohBus`` is the real one, ``MemoryBus`` its twin.

Rules: callbacks run on the bus's own thread and only hand over (see ``inbox``); every query is answered exactly once; a
publish never blocks and never raises for a network that is away. Keys come from ``rtkmesh_schemas.keys`` only.
"""

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Self, TypeVar

from rtkmesh_schemas.keys import LIVE, Stream
from rtkmesh_schemas.wire import JSON, MAXIMUM_BYTES, Wire, encode, encoding_of

BYTES: Final = "application/octet-stream"
TEXT: Final = "text/plain"

T = TypeVar("T")

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it came from the bus. ``received_mono_ns`` is this host's monotonic clock at its arrival."""

    key: str
    payload: bytes
    encoding: str
    attachment: bytes
    received_mono_ns: int


@dataclass(frozen=True, slots=True)
class Answer:
    """One answer to a ``get``. ``ok`` False: an error reply; ``timed_out``: the process was there and said nothing in time."""

    ok: bool
    key: str
    payload: bytes
    encoding: str
    timed_out: bool = False


@dataclass(frozen=True, slots=True)
class Liveliness:
    """A process came (``alive``) or went."""

    role: str
    id: str
    alive: bool


class Query(ABC):
    """A question to a queryable: to be answered once, by any thread, at any time before the asker's deadline.

    One that is dropped unanswered is answered with an error.
    """

    def __init__(self, key: str, payload: bytes, encoding: str, parameters: str) -> None:
        self.key, self.payload, self.encoding, self.parameters = key, payload, encoding, parameters
        self._lock = threading.Lock()
        self._answered = False

    @property
    def answered(self) -> bool:
        """Whether an answer was given."""
        return self._answered

    def reply(self, payload: bytes, encoding: str) -> None:
        """Answer; a second answer is ignored."""
        self._answer(payload, encoding, error=False)

    def reply_error(self, payload: bytes, encoding: str) -> None:
        """Answer that it failed; a second answer is ignored."""
        self._answer(payload, encoding, error=True)

    def _answer(self, payload: bytes, encoding: str, *, error: bool) -> None:
        with self._lock:
            if self._answered:
                return
            self._answered = True
        self._send(payload, encoding, error=error)

    @abstractmethod
    def _send(self, payload: bytes, encoding: str, *, error: bool) -> None:
        """Send the one answer."""

    def __del__(self) -> None:
        if not getattr(self, "_answered", True):
            self._answer(b'{"ok":false,"code":"failed","message":"the question was dropped"}', JSON, error=True)


class Handle(ABC):
    """Something declared on the bus."""

    @abstractmethod
    def close(self) -> None:
        """Take it back; twice is once."""


class Bus(ABC):
    """One process's connection to the network. Use as a context manager; ``close`` takes back all that was declared."""

    def __init__(self, id: str) -> None:  # noqa: A002  the word of the design
        self.id = id
        self.counters: dict[str, int] = {"published": 0, "too_large": 0, "not_sent": 0, "callback_errors": 0}
        self._keys: dict[tuple[str, ...], str] = {}
        self._newest: dict[str, tuple[bytes, str]] = {}

    def publish(
        self, stream: Stream, value: Wire | bytes | str, *, attachment: bytes | None = None, encoding: str = "", **fields: str
    ) -> None:
        """Publish a struct, bytes or text on this process's key of ``stream``, with the QoS of the table.

        ``fields`` fill the template (``satellite="G05"``). Messages above 64 KiB are counted and not sent: the hub would drop
        them silently.
        """
        self.publish_as(self.id, stream, value, attachment=attachment, encoding=encoding, **fields)

    def publish_as(
        self,
        owner: str,
        stream: Stream,
        value: Wire | bytes | str,
        *,
        attachment: bytes | None = None,
        encoding: str = "",
        **fields: str,
    ) -> None:
        """As ``publish``, on another process's key: for keys that their owner subscribes to (``credit``, ``write``)."""
        payload, name = _encoded(value)
        if len(payload) > MAXIMUM_BYTES:
            self.counters["too_large"] += 1
            _log.warning("%s: %d bytes are more than a message may have (%d)", stream.name, len(payload), MAXIMUM_BYTES)
            return
        key = self._key(owner, stream, fields)
        encoding = encoding or name
        if owner == self.id:
            self._newest[key] = (payload, encoding)
        self.counters["published"] += 1
        self._put(key, stream, payload, encoding, attachment)

    def newest(self, stream: Stream, **fields: str) -> tuple[bytes, str] | None:
        """Return (payload, encoding) of what this process last published on the stream, or None."""
        return self._newest.get(self._key(self.id, stream, fields))

    @abstractmethod
    def matched(self, stream: Stream, **fields: str) -> bool:
        """Return whether somebody listens to this process's key of ``stream``, as far as is known: skip costly encodings when not."""

    @abstractmethod
    def subscribe(self, expression: str, on_sample: Callable[[Sample], None], *, history: bool = False) -> Handle:
        """Call ``on_sample`` for each message that matches; ``history`` asks for cached ones first and recovers lost ones.

        Callbacks of one bus come one after the other, messages of one publisher with one priority in their order.
        """

    @abstractmethod
    def queryable(self, key: str, on_query: Callable[[Query], None]) -> Handle:
        """Call ``on_query`` for each question to ``key``."""

    @abstractmethod
    def get(self, selector: str, *, payload: bytes = b"", encoding: str = "", timeout_s: float) -> list[Answer]:
        """Ask all that match; return all answers, unconsolidated. Empty: nobody there, forbidden, or a broken handler."""

    @abstractmethod
    def live_token(self, role: str, id: str) -> Handle:  # noqa: A002
        """Say that this process is warm and attached, until closed."""

    @abstractmethod
    def live(self, timeout_s: float = 1.0) -> dict[str, str]:
        """Return id -> role of all that hold a token."""

    @abstractmethod
    def on_live(self, callback: Callable[[Liveliness], None]) -> Handle:
        """Call for each process there is, then for each that comes or goes."""

    @abstractmethod
    def connected(self) -> bool:
        """Return whether a hub is reached right now."""

    @abstractmethod
    def neighbours(self) -> int:
        """Return how many sessions this one is connected to: for the hub, its clients and other hubs."""

    @abstractmethod
    def close(self) -> None:
        """Take everything back and leave; never hangs; twice is once."""

    @abstractmethod
    def _put(self, key: str, stream: Stream, payload: bytes, encoding: str, attachment: bytes | None) -> None:
        """Send one message."""

    def _key(self, owner: str, stream: Stream, fields: dict[str, str]) -> str:
        name = (owner, stream.name, *fields.values())
        key = self._keys.get(name)
        if key is None:
            key = self._keys[name] = stream.key(owner, **fields)
        return key

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def guarded(bus: Bus, callback: Callable[[T], None]) -> Callable[[T], None]:
    """Return the callback with its exceptions logged and counted: one must not end the bus's thread."""

    def call(item: T) -> None:
        try:
            callback(item)
        except Exception:  # noqa: BLE001  the boundary to a foreign thread
            bus.counters["callback_errors"] += 1
            _log.exception("a callback of the bus failed")

    return call


def live_of(key: str) -> tuple[str, str] | None:
    """Return (role, id) of a liveliness key, or None."""
    parts, pattern = key.split("/"), LIVE.template.split("/")
    if len(parts) != len(pattern) or parts[:-2] != pattern[:-2]:
        return None
    return parts[-2], parts[-1]


def endpoints_for(connect: Sequence[str], listen: Sequence[str]) -> tuple[str, ...]:
    """Return where a process of this host connects to: ``connect``, else the hub's own ``listen`` (all interfaces: loopback)."""
    return tuple(connect) or tuple(address.replace("0.0.0.0", "127.0.0.1").replace("[::]", "[::1]") for address in listen)  # noqa: S104  an address to reach, not to bind


def _encoded(value: Wire | bytes | str) -> tuple[bytes, str]:
    if isinstance(value, Wire):
        return encode(value), encoding_of(type(value))
    return (value.encode(), TEXT) if isinstance(value, str) else (value, BYTES)
