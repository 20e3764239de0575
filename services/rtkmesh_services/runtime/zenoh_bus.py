"""The bus over one Zenoh session.

Facts that shape this module (measured, ``reference/zenoh_ros2.md``): Zenoh's defaults listen on all interfaces and scout by
multicast, so everything is said here; callbacks run *directly* on Zenoh's receiving task (``indirect=False``), which keeps the
order of messages over subscriptions, costs no thread hop and leaves no thread that hangs the interpreter at its end.
"""

# pyright: reportUnknownMemberType=false, reportMissingModuleSource=false
# (zenoh's stubs leave out what put, close, undeclare and reply return; its modules are compiled)

import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import zenoh
import zenoh.ext
from zenoh.handlers import Callback

from rtkmesh_schemas.keys import LIVE, STREAMS, Kind, Priority, Stream, live_key
from rtkmesh_schemas.wire import MAXIMUM_BYTES
from rtkmesh_services.errors import BusError, UnreachableError
from rtkmesh_services.runtime.bus import Answer, Bus, Handle, Liveliness, Query, Sample, guarded, live_of

LEASE_MS: Final = 2000
CLOSE_S: Final = 1.0
_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 2}
_HEARTBEAT_S: Final = 0.5  # after a cached message: lets subscribers find that they missed the last one
_QUEUE_BATCHES: Final = 16  # of 64 KiB, per priority, Zenoh's most: the bursts of a replay fit
_WAIT_CLIENT_US: Final = 100_000  # before a message is dropped: the hub always reads, so a process only waits for a hub that hangs
_WAIT_HUB_US: Final = 1_000  # the hub must not wait for one slow subscriber: all others would
_QUEUES: Final = ("real_time", "data_high", "data", "data_low", "background")
_PRIORITIES: Final = {
    Priority.REAL_TIME: zenoh.Priority.REAL_TIME,
    Priority.DATA_HIGH: zenoh.Priority.DATA_HIGH,
    Priority.DATA: zenoh.Priority.DATA,
    Priority.DATA_LOW: zenoh.Priority.DATA_LOW,
    Priority.BACKGROUND: zenoh.Priority.BACKGROUND,
}

_log = logging.getLogger(__name__)


def session_config(
    mode: str, *, connect: Sequence[str] = (), listen: Sequence[str] = (), namespace: str = "", connect_timeout_ms: int = -1
) -> zenoh.Config:
    """Return a configuration that leaves nothing to defaults: endpoints, no scouting, lease 2 s, quick retry, no shared memory."""
    config = zenoh.Config()
    values: dict[str, Any] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        "connect/timeout_ms": connect_timeout_ms,
        "connect/exit_on_failure": connect_timeout_ms >= 0,
        "connect/retry": _RETRY,
        "listen/endpoints": list(listen),
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/tx/keep_alive": 4,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _WAIT_HUB_US if mode == "router" else _WAIT_CLIENT_US,
        "transport/link/tx/queue/size": dict.fromkeys(_QUEUES, _QUEUE_BATCHES),
        "queries_default_timeout": 2000,
    }
    if namespace:
        values["namespace"] = namespace
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def router_config(*, listen: Sequence[str], connect: Sequence[str] = (), namespace: str = "") -> zenoh.Config:
    """Return the hub's configuration: a router that drops what is above 64 KiB and shows its state read-only."""
    config = session_config("router", connect=connect, listen=listen, namespace=namespace)
    config.insert_json5("connect/exit_on_failure", "false")
    limit = {"id": "size", "messages": ["put", "query", "reply"], "key_exprs": ["**"], "size_limit": MAXIMUM_BYTES, "flows": ["ingress"]}
    config.insert_json5("low_pass_filter", json.dumps([limit]))
    config.insert_json5("adminspace", json.dumps({"enabled": True, "permissions": {"read": True, "write": False}}))
    return config


def history_depth(expression: str) -> int:
    """Return how many messages of a key a subscription with history asks for: the deepest cache among the streams that it reaches.

    It also says how many live messages Zenoh holds back while the history is on its way. Without it, it holds back none, and the
    first live message makes it refuse all history of that key as old.
    """
    wanted = zenoh.KeyExpr(expression)
    return max((stream.cache for stream in STREAMS if stream.cache and wanted.intersects(stream.expression())), default=1)


def open_bus(
    id: str,  # noqa: A002  the word of the design
    connect: Sequence[str],
    *,
    namespace: str = "",
    timeout_s: float | None = None,
) -> "ZenohBus":
    """Connect to the hub and return the bus. ``timeout_s`` None waits for the hub; else UnreachableError after it."""
    config = session_config("client", connect=connect, namespace=namespace, connect_timeout_ms=-1)
    if timeout_s is None:
        return ZenohBus(id, _opened(config))
    deadline = time.monotonic() + timeout_s
    config.insert_json5("connect/timeout_ms", "0")
    config.insert_json5("connect/exit_on_failure", "true")
    while True:
        try:
            return ZenohBus(id, zenoh.open(config))
        except zenoh.ZError as error:
            if time.monotonic() > deadline:
                raise UnreachableError(f"no hub at {', '.join(connect)}: is it running? (rtkmesh up FILE)") from error
            time.sleep(0.05)


def open_router(id: str, config: zenoh.Config) -> "ZenohBus":  # noqa: A002
    """Open the hub's own session; BusError with the reason when an address cannot be listened on."""
    return ZenohBus(id, _opened(config), is_router=True)


def _opened(config: zenoh.Config) -> zenoh.Session:
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise BusError(f"Zenoh: {error}") from error


class ZenohBus(Bus):
    """The bus over one Zenoh session; see ``Bus`` for the contract."""

    def __init__(self, id: str, session: zenoh.Session, *, is_router: bool = False) -> None:  # noqa: A002
        super().__init__(id)
        self._session, self._is_router = session, is_router
        self._lock = threading.Lock()
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._matching: dict[str, zenoh.Publisher] = {}
        self._encodings: dict[str, zenoh.Encoding] = {}
        self._handles: set[_ZenohHandle] = set()
        self._closed = False

    def matched(self, stream: Stream, **fields: str) -> bool:
        """See ``Bus``."""
        try:
            publisher = self._publisher(self._key(self.id, stream, fields), stream)
            if not isinstance(publisher, zenoh.Publisher):
                return True  # an advanced publisher cannot tell
            status: Any = publisher.matching_status  # the stub says bool
            return bool(status.matching)
        except zenoh.ZError:  # closed, perhaps at this moment
            return False

    def subscribe(self, expression: str, on_sample: Callable[[Sample], None], *, history: bool = False) -> Handle:
        """See ``Bus``."""

        def call(sample: zenoh.Sample) -> None:
            on_sample(_sample_of(sample))

        handler = Callback(guarded(self, call), indirect=False)
        if not history:
            return self._keep(self._session.declare_subscriber(expression, handler))
        return self._keep(
            zenoh.ext.declare_advanced_subscriber(
                self._session,
                expression,
                handler,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=history_depth(expression)),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            )
        )

    def queryable(self, key: str, on_query: Callable[[Query], None]) -> Handle:
        """See ``Bus``."""

        def call(query: zenoh.Query) -> None:
            on_query(_ZenohQuery(key, query))

        return self._keep(self._session.declare_queryable(key, Callback(guarded(self, call), indirect=False)))

    def get(self, selector: str, *, payload: bytes = b"", encoding: str = "", timeout_s: float) -> list[Answer]:
        """See ``Bus``."""
        try:
            replies = self._session.get(
                selector,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
                payload=payload or None,
                encoding=encoding or None,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
            )
            return [_answer_of(reply) for reply in replies]
        except zenoh.ZError as error:
            raise BusError(f"cannot ask {selector!r}: {error}") from error

    def live_token(self, role: str, id: str) -> Handle:  # noqa: A002
        """See ``Bus``."""
        return self._keep(self._session.liveliness().declare_token(live_key(role, id)))

    def live(self, timeout_s: float = 1.0) -> dict[str, str]:
        """See ``Bus``."""
        replies = self._session.liveliness().get(LIVE.expression(), timeout=timeout_s)
        names = (live_of(str(reply.ok.key_expr)) for reply in replies if reply.ok is not None)
        return {name[1]: name[0] for name in names if name is not None}

    def on_live(self, callback: Callable[[Liveliness], None]) -> Handle:
        """See ``Bus``."""
        present: set[tuple[str, str]] = set()
        lock = threading.Lock()

        def call(sample: zenoh.Sample) -> None:
            name, alive = live_of(str(sample.key_expr)), sample.kind == zenoh.SampleKind.PUT
            if name is None:
                return
            with lock:  # a token that comes while the history is asked for is told twice
                known = name in present
                (present.add if alive else present.discard)(name)
            if alive != known:
                callback(Liveliness(*name, alive=alive))

        handler = Callback(guarded(self, call), indirect=False)
        return self._keep(self._session.liveliness().declare_subscriber(LIVE.expression(), handler, history=True))

    def connected(self) -> bool:
        """See ``Bus``; a hub is connected to itself."""
        return not self._closed and (self._is_router or bool(self._session.info.routers_zid()))

    def neighbours(self) -> int:
        """See ``Bus``."""
        return 0 if self._closed else len(self._session.info.transports())

    def close(self) -> None:
        """See ``Bus``."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        closing = threading.Thread(target=self._close, name="bus-close", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
        if closing.is_alive():
            _log.warning("the session did not close within %.1f s", CLOSE_S)

    def _close(self) -> None:
        for handle in list(self._handles):
            handle.close()
        for publisher in self._publishers.values():
            _undeclare(publisher)
        self._session.close()

    def _put(self, key: str, stream: Stream, payload: bytes, encoding: str, attachment: bytes | None) -> None:
        publisher = self._publishers.get(key)
        try:
            if publisher is None:
                publisher = self._publisher(key, stream)
            publisher.put(payload, encoding=self._encoding(encoding), attachment=attachment)
        except zenoh.ZError:
            self.counters["not_sent"] += 1
            if not self._closed:
                _log.debug("%s was not sent", key, exc_info=True)

    def _encoding(self, name: str) -> zenoh.Encoding:
        encoding = self._encodings.get(name)
        if encoding is None:
            encoding = self._encodings[name] = zenoh.Encoding(name)
        return encoding

    def _publisher(self, key: str, stream: Stream) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        with self._lock:
            publisher = self._publishers.get(key)
            if publisher is None:
                publisher = self._publishers[key] = self._declared(key, stream)
            return publisher

    def _declared(self, key: str, stream: Stream) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        if stream.kind is not Kind.CACHED:
            return self._session.declare_publisher(
                key, priority=_PRIORITIES[stream.priority], express=stream.express, congestion_control=zenoh.CongestionControl.DROP
            )
        return zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            priority=_PRIORITIES[stream.priority],
            express=stream.express,
            congestion_control=zenoh.CongestionControl.DROP,
            cache=zenoh.ext.CacheConfig(max_samples=stream.cache),
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
            publisher_detection=True,
        )

    def _keep(self, declared: Any) -> "_ZenohHandle":
        handle = _ZenohHandle(declared, self._handles)
        self._handles.add(handle)
        return handle


class _ZenohHandle(Handle):
    def __init__(self, declared: Any, among: set["_ZenohHandle"]) -> None:
        self._declared, self._among = declared, among

    def close(self) -> None:
        """Undeclare."""
        if self in self._among:
            self._among.discard(self)
            _undeclare(self._declared)


class _ZenohQuery(Query):
    def __init__(self, key: str, query: zenoh.Query) -> None:
        payload, encoding = query.payload, query.encoding
        super().__init__(
            key, b"" if payload is None else payload.to_bytes(), "" if encoding is None else str(encoding), str(query.parameters)
        )
        self._query = query

    def _send(self, payload: bytes, encoding: str, *, error: bool) -> None:
        try:
            if error:
                self._query.reply_err(payload, encoding=encoding)
            else:
                self._query.reply(self.key, payload, encoding=encoding)
        except zenoh.ZError:
            _log.debug("an answer on %s came too late", self.key, exc_info=True)
        finally:
            self._query.drop()


def _sample_of(sample: zenoh.Sample) -> Sample:
    attachment = sample.attachment
    return Sample(
        key=str(sample.key_expr),
        payload=sample.payload.to_bytes(),
        encoding=str(sample.encoding),
        attachment=b"" if attachment is None else attachment.to_bytes(),
        received_mono_ns=time.monotonic_ns(),
    )


def _answer_of(reply: zenoh.Reply) -> Answer:
    if (sample := reply.ok) is not None:
        return Answer(True, str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding))
    error = reply.err
    assert error is not None  # a reply is one or the other
    payload = error.payload.to_bytes()
    return Answer(False, "", payload, str(error.encoding), timed_out=payload == b"Timeout")


def _undeclare(declared: Any) -> None:
    try:
        declared.undeclare()
    except zenoh.ZError:
        _log.debug("could not undeclare", exc_info=True)
