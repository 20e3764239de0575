"""How a process is: status, events, log records, metrics."""

from enum import StrEnum
from typing import Any

from rtkmesh_schemas.wire import Wire


class State(StrEnum):
    """States of every process (DESIGN.md 12)."""

    STARTING = "STARTING"
    WARMING = "WARMING"
    RUNNING = "RUNNING"
    DEGRADED = "DEGRADED"
    STALE = "STALE"
    STOPPED = "STOPPED"
    FAILED = "FAILED"


class Level(StrEnum):
    """Levels of events and log records."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class InputStatus(Wire, frozen=True, kw_only=True):
    """One input of a process: what it gives and how old it is."""

    name: str
    state: str
    detail: str = ""
    messages: int = 0
    bytes: int = 0
    age_s: float | None = None
    lost: int = 0
    dropped: int = 0
    errors: int = 0
    counters: dict[str, int] = {}


class Quantiles(Wire, frozen=True, kw_only=True):
    """A latency or duration over the last minute, milliseconds."""

    p50: float
    p95: float
    p99: float
    maximum: float
    count: int


class ServiceStatus(Wire, frozen=True, kw_only=True):
    """The state of a process, published on change and at 1 Hz from its work loop (``heartbeat`` counts those)."""

    id: str
    role: str
    state: State
    start_id: str
    heartbeat: int
    reason: str = ""
    pid: int = 0
    host: str = ""
    version: str = ""
    config_hash: str = ""
    uptime_s: float = 0.0
    mono_ns: int = 0
    last_epoch: tuple[int, float] | None = None
    inputs: list[InputStatus] = []
    counters: dict[str, int] = {}
    latencies_ms: dict[str, Quantiles] = {}
    data: dict[str, Any] = {}


class Event(Wire, frozen=True, kw_only=True):
    """Something happened: a stable ``code`` for programs, a ``text`` for people."""

    id: str
    level: Level
    code: str
    text: str
    sequence: int
    utc_ns: int
    mono_ns: int
    data: dict[str, Any] = {}


class LogRecord(Wire, frozen=True, kw_only=True):
    """One line of a process's log."""

    id: str
    role: str
    level: str
    logger: str
    text: str
    utc_ns: int
    fields: dict[str, Any] = {}


class Metrics(Wire, frozen=True, kw_only=True):
    """Numbers of a process."""

    id: str
    role: str
    utc_ns: int
    values: dict[str, float]
