"""Every key of the network, in one table. No key string stands anywhere else.

Staleness, the monitor and the reference page derive from ``STREAMS``. Ids are ``[a-z0-9_]+`` and unique over all roles of a
site; the site prefix is the session's namespace, never code.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rtkmesh_schemas.errors import BadKeyError

ROOT: Final = "rtk"
CONTROL_ID: Final = "control"
HUB_ID: Final = "hub"
ID: Final = re.compile(r"[a-z0-9_]{1,64}")
# Second chunks that are no id of a process.
RESERVED_IDS: Final = frozenset({"flockwave"})


class Role(StrEnum):
    """The roles of the processes; also the folders of ``rtkmesh_services``."""

    HUB = "hub"
    INGEST = "ingest"
    SOLVER = "solver"
    ATTITUDE = "attitude"
    CONTROL = "control"
    OUTPUT = "output"
    RECORDER = "recorder"
    ROS2 = "ros2"
    MONITOR = "monitor"


class Kind(StrEnum):
    """How a key is served."""

    PUBLISH = "pub"
    CACHED = "advanced pub, cached"
    QUERYABLE = "queryable"
    SUBSCRIBE = "sub"
    TOKEN = "liveliness token"  # noqa: S105  no password


class Priority(StrEnum):
    """Zenoh priority by purpose. All messages of one receiver's stream share one: that keeps them in order."""

    REAL_TIME = "real_time"
    DATA_HIGH = "data_high"
    DATA = "data"
    DATA_LOW = "data_low"
    BACKGROUND = "background"


@dataclass(frozen=True, slots=True)
class Stream:
    """One row of the table.

    ``template`` has ``{id}`` for the owner and further fields in braces; ``type`` is the struct's name (empty: raw bytes or
    text); ``rate_hz`` is the nominal rate (0: on change, None: follows the source); ``cache`` is the depth kept for late joiners.
    """

    name: str
    template: str
    kind: Kind
    owner: tuple[Role, ...]
    type: str
    content: str
    rate_hz: float | None = None
    priority: Priority = Priority.DATA
    express: bool = False
    cache: int = 0

    def key(self, id: str, **fields: str) -> str:  # noqa: A002  the word of the design for a process's name
        """Return the key of this stream for one process; BadKeyError for a wrong id."""
        return self.template.format(id=check_id(id), **fields)

    def expression(self) -> str:
        """Return the key expression that matches this stream of every process."""
        return re.sub(r"\{[a-z_]+\}", "*", self.template)


_ALL = tuple(Role)
_WORKERS = tuple(role for role in Role if role is not Role.HUB)

STREAMS: Final = (
    Stream("cmd", "rtk/{id}/cmd", Kind.QUERYABLE, _ALL, "Reply", "commands: start stop restart load shutdown status config set get"),
    Stream("raw", "rtk/{id}/raw/{protocol}", Kind.PUBLISH, (Role.INGEST,), "", "one whole, checked frame; attachment: sequence, receive times", None, Priority.DATA_LOW),
    Stream("made", "rtk/{id}/made/{output}", Kind.PUBLISH, (Role.INGEST,), "", "RTCM 3 frames made of the decoded stream for an output with encode; attachment as raw", None, Priority.DATA_LOW),
    Stream("obs", "rtk/{id}/obs", Kind.PUBLISH, (Role.INGEST,), "Observation", "decoded epoch, columnar", None, Priority.DATA_HIGH),
    Stream("eph", "rtk/{id}/eph/{satellite}", Kind.CACHED, (Role.INGEST,), "EphemerisMessage", "broadcast ephemeris; a late joiner starts warm", 0.0, Priority.DATA_HIGH, cache=2),
    Stream("iono", "rtk/{id}/iono", Kind.CACHED, (Role.INGEST,), "IonosphereMessage", "broadcast ionosphere coefficients", 0.0, Priority.DATA_HIGH, cache=2),
    Stream("ref", "rtk/{id}/ref", Kind.CACHED, (Role.INGEST,), "ReferenceMessage", "base position, antenna, datum, source", 0.0, Priority.DATA_HIGH, cache=1),
    Stream("end", "rtk/{id}/end", Kind.PUBLISH, (Role.INGEST,), "EndOfStream", "a replayed source is at its end", 0.0, Priority.DATA_HIGH),
    Stream("credit", "rtk/{id}/credit", Kind.SUBSCRIBE, (Role.INGEST,), "Credit", "how far a consumer has got: paces replays faster than real time", None, Priority.DATA_HIGH),
    Stream("write", "rtk/{id}/write", Kind.SUBSCRIBE, (Role.INGEST,), "", "frames to write to the receiver (corrections)"),
    Stream("sol", "rtk/{id}/sol", Kind.PUBLISH, (Role.SOLVER,), "SolutionMessage", "solution: time, status, position, velocity, baseline, covariances, ages, ratio, grade", None, Priority.REAL_TIME),
    Stream("sol_text", "rtk/{id}/sol/{format}", Kind.PUBLISH, (Role.SOLVER,), "", "RTKRCV's formats as text: llh xyz enu vel_enu nmea stat; only when matched"),
    Stream("sat", "rtk/{id}/sat", Kind.PUBLISH, (Role.SOLVER,), "SatellitesMessage", "per satellite and signal: residuals, slips, lock, ambiguity, C/N0, azimuth, elevation", 1.0),
    Stream("candidates", "rtk/{id}/candidates", Kind.PUBLISH, (Role.SOLVER,), "CandidatesMessage", "the best integer vectors of a moving base's epoch, with the baseline under each; only when matched", None, Priority.REAL_TIME),
    Stream("text", "rtk/{id}/text", Kind.PUBLISH, (Role.OUTPUT,), "", "an output's text as its table wants it (target zenoh://), an epoch a message; attachment: the header"),
    Stream("screen", "rtk/{id}/screen/{word}", Kind.PUBLISH, (Role.SOLVER,), "", "what RTKRCV's console shows, as text: status satellite observ navidata stream at 1 Hz, solution per epoch, error when it occurs; only when matched"),
    Stream("att", "rtk/{id}/att", Kind.PUBLISH, (Role.ATTITUDE,), "AttitudeMessage", "heading, pitch, roll, covariance, integrity, antennas used", None, Priority.REAL_TIME),
    Stream("att_filtered", "rtk/{id}/att/filtered", Kind.PUBLISH, (Role.ATTITUDE,), "AttitudeMessage", "the same from its filter: predicted between epochs, with turn rates", None, Priority.REAL_TIME),
    Stream("att_nmea", "rtk/{id}/att/nmea", Kind.PUBLISH, (Role.ATTITUDE,), "", "the heading as NMEA HDT and THS, text; THS says V where there is none; only when matched"),
    Stream("heading", "rtk/{id}/heading", Kind.PUBLISH, (Role.INGEST,), "HeadingMessage", "heading that the receiver computed itself", None, Priority.REAL_TIME),
    Stream("status", "rtk/{id}/status", Kind.CACHED, _ALL, "ServiceStatus", "state machine, counters, input ages, latencies; from the work loop", 1.0, cache=1),
    Stream("event", "rtk/{id}/event/{level}", Kind.CACHED, _ALL, "Event", "what happened", 0.0, cache=100),
    Stream("log", "rtk/{id}/log", Kind.PUBLISH, _ALL, "LogRecord", "what was said", 0.0, Priority.BACKGROUND),
    Stream("metrics", "rtk/{id}/metrics", Kind.PUBLISH, _ALL, "Metrics", "numbers", 1.0, Priority.DATA_LOW),
    Stream("latest", "rtk/{id}/latest", Kind.QUERYABLE, _WORKERS, "", "pull of the newest sol, att, status: ?what=sol,status"),
    Stream("preset", "rtk/control/preset/{name}", Kind.QUERYABLE, (Role.CONTROL,), "Reply", "a base station's preset: a get tells it with state and score; op select, update, delete"),
    Stream("flockwave", "rtk/flockwave", Kind.QUERYABLE, (Role.CONTROL,), "", "Flockwave RTK messages"),
    Stream("live", "rtk/@live/{role}/{id}", Kind.TOKEN, _ALL, "", "declared only when warm and attached; invisible to rtk/**"),
)  # fmt: skip

BY_NAME: Final = {stream.name: stream for stream in STREAMS}
CMD, RAW, MADE, OBS, EPH, IONO, REF, END, CREDIT, WRITE = (
    BY_NAME[n] for n in ("cmd", "raw", "made", "obs", "eph", "iono", "ref", "end", "credit", "write")
)
SOL, SOL_TEXT, SAT, SCREEN, TEXT, ATT, STATUS, EVENT, LOG = (
    BY_NAME[n] for n in ("sol", "sol_text", "sat", "screen", "text", "att", "status", "event", "log")
)
ATT_FILTERED, ATT_NMEA, HEADING, CANDIDATES = (BY_NAME[n] for n in ("att_filtered", "att_nmea", "heading", "candidates"))
METRICS, LATEST, PRESET, FLOCKWAVE, LIVE = (BY_NAME[n] for n in ("metrics", "latest", "preset", "flockwave", "live"))

STALE_PERIODS: Final = 10.0  # a stream with a nominal rate is stale after this many missing periods


def check_id(id: str) -> str:  # noqa: A002  the word of the design
    """Return the id; BadKeyError unless it is ``[a-z0-9_]+`` and not reserved. ``*`` passes: it names all."""
    if id != "*" and (not ID.fullmatch(id) or id in RESERVED_IDS):
        raise BadKeyError(f"{id!r} is no id: ids are 1 to 64 of a-z, 0-9 and _ and not one of {', '.join(sorted(RESERVED_IDS))}")
    return id


def stream_of(key: str) -> tuple[Stream, str] | None:
    """Return (stream, id) of a concrete key, or None when the table does not know it."""
    for stream in STREAMS:
        pattern = re.sub(r"\\\{([a-z_]+)\\\}", r"(?P<\1>[^/]+)", re.escape(stream.template))
        if match := re.fullmatch(pattern, key):
            return stream, match.groupdict().get("id", CONTROL_ID)
    return None


def live_key(role: Role | str, id: str) -> str:  # noqa: A002
    """Return the liveliness token of a process."""
    return LIVE.template.format(role=role, id=check_id(id))
