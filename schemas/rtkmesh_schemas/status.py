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


class FrameFigures(Wire, frozen=True, kw_only=True):
    """Whole frames of one kind: how many, how long ago the newest came, and how many come a second."""

    count: int
    age_s: float
    per_s: float = 0.0


class SignalStrength(Wire, frozen=True, kw_only=True):
    """C/N0 over the signals of one frequency band of the newest epoch, dB-Hz."""

    mean: float
    minimum: float
    count: int


class ReferenceStatus(Wire, frozen=True, kw_only=True):
    """Where a base stands. ``origin``: rtcm3, configuration ...; ``age_s``: since it was said last, None for a configured one."""

    position_ecef_m: tuple[float, float, float]
    origin: str = ""
    station_id: int = 0
    age_s: float | None = None


class StreamStatus(Wire, frozen=True, kw_only=True):
    """What a source of an ingest brings. Rates are over the last ten seconds.

    ``frames`` by ``protocol/kind``; ``checksum_failures`` by protocol; ``refused``: frames or parts of them that could not be decoded,
    by kind and reason; ``satellites`` by system, ``signals`` (system and RINEX code, as G1C) and ``cn0_dbhz`` by band are of the newest
    epoch. At most 64 kinds and reasons are told one by one, the rest is ``other``.
    """

    bytes_per_s: float = 0.0
    frames: dict[str, FrameFigures] = {}
    checksum_failures: dict[str, int] = {}
    bytes_skipped: int = 0
    refused: dict[str, int] = {}
    epochs: int = 0
    epochs_per_s: float = 0.0
    epoch_age_s: float | None = None
    satellites: dict[str, int] = {}
    signals: list[str] = []
    cn0_dbhz: dict[str, SignalStrength] = {}
    reference: ReferenceStatus | None = None


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
    stream: StreamStatus | None = None


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
