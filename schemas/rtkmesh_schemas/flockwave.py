"""Flockwave's RTK messages: what Skybrush clients ask a ground station, and what they are answered.

flockwave-spec 2.10 (envelope, RTK-*, CONN-*, BCN-*, SYS-*) as a Skybrush server 2.50 speaks it. Names on the wire are the protocol's own.
Positions: ECEF in millimetres; geodetic as whole 1e-7 degrees and millimetres.
"""

from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

VERSION: Final = "1.0"
MAXIMUM_ID: Final = 36
NO_SCHEMA: Final = "Flockwave message does not match schema"
NO_HANDLER: Final = "No handler managed to parse this message in the server"
NO_PRESET: Final = "No such RTK preset"

MessageId = Annotated[str, Meta(min_length=1, max_length=MAXIMUM_ID)]
MessageType = Annotated[str, Meta(pattern="^[A-Z]{1,8}(-[A-Z]{2,8}){1,2}$")]
PresetId = Annotated[str, Meta(min_length=1, max_length=64)]
Ids = Annotated[list[PresetId], Meta(max_length=1000, extra_json_schema={"uniqueItems": True})]
Above0 = Annotated[float, Meta(gt=0.0)]
# Latitude and longitude (1e-7 degrees), heights (mm) above mean sea level, home and ground; trailing nulls may be left out.
# As Skybrush does, a base station has its ellipsoidal height in the place of the first height.
GPSCoordinate = Annotated[list[int | None], Meta(min_length=2, max_length=5)]
ECEFCoordinate = tuple[float, float, float]
MessageSet = Literal["msm4", "msm7"]
GnssType = Literal["gps", "glonass", "galileo", "sbas", "qzss", "beidou", "irnss"]
PresetFormat = Literal["auto", "rtcm2", "rtcm3", "ubx"]
GNSS_TYPES: Final[tuple[str, ...]] = GnssType.__args__
MESSAGE_SETS: Final[tuple[str, ...]] = MessageSet.__args__

SURVEY_SUPPORTED, SURVEY_ACTIVE, SURVEY_VALID = 1, 2, 4
PURPOSE_RTK: Final = 3  # of a connection: RTK corrections


class Flockwave(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Root of the messages and their types: unknown fields are faults, fields that are not known are left out."""


class RTKConfigurationPreset(Flockwave, frozen=True, kw_only=True):
    """A base station that can be selected; ``sources`` are URLs."""

    id: PresetId
    title: str
    format: PresetFormat
    sources: list[Annotated[str, Meta(min_length=1)]]
    type: Literal["builtin", "dynamic", "user"]


class AntennaInformation(Flockwave, frozen=True, kw_only=True):
    """What the base says of its antenna (RTCM 1005 to 1008, 1033)."""

    station_id: int | UnsetType = msgspec.field(name="stationId", default=UNSET)
    descriptor: str | UnsetType = UNSET
    serial_number: str | UnsetType = msgspec.field(name="serialNumber", default=UNSET)
    position: GPSCoordinate | UnsetType = UNSET
    position_ecef: ECEFCoordinate | UnsetType = msgspec.field(name="positionECEF", default=UNSET)


MessageObservation = tuple[float, float]  # age (ms), bits per second over the last ten seconds
MessageObservations = dict[Annotated[str, Meta(pattern="^rtcm[23]/[0-9]+$")], MessageObservation]
Strengths = dict[Annotated[str, Meta(pattern="^[GREQC][0-9]{2}$")], float]  # dB-Hz


class SurveyStatus(Flockwave, frozen=True, kw_only=True, omit_defaults=False):
    """How the base's survey is. ``flags``: 1 supported, 2 active, 4 valid; ``accuracy`` (m) holds with 4."""

    accuracy: float = 0.0
    flags: Annotated[int, Meta(ge=0, le=7)] = 0


class RTKSurveySettings(Flockwave, frozen=True, kw_only=True):
    """What a base is to do. ``position``: it stands there, known to ``accuracy``; without: it surveys to that, ``duration`` s or longer.

    ``gnssTypes``: without it all.
    """

    duration: Above0
    accuracy: Above0
    message_set: MessageSet | UnsetType = msgspec.field(name="messageSet", default=UNSET)
    position: ECEFCoordinate | UnsetType = UNSET
    gnss_types: list[GnssType] | UnsetType = msgspec.field(name="gnssTypes", default=UNSET)


class ConnectionInfo(Flockwave, frozen=True, kw_only=True):
    """The link to a base; ``timestamp``: ms since 1970."""

    id: str
    description: str
    purpose: int
    status: Literal["disconnected", "connecting", "connected", "disconnecting"]
    timestamp: int


class BeaconStatusInfo(Flockwave, frozen=True, kw_only=True):
    """A base as a beacon on the map; not ``active``: it has not said its position for a while."""

    id: str
    position: GPSCoordinate
    heading: int | None
    active: bool
    timestamp: int


class BeaconBasicProperties(Flockwave, frozen=True, kw_only=True):
    """What a beacon is called."""

    id: str
    name: str


class Body(Flockwave, frozen=True, kw_only=True):
    """Root of the bodies; ``type`` of an answer is that of its request, with X- where that has it."""

    type: MessageType


# Requests


class PlainRequest(Body, frozen=True, kw_only=True):
    """A request without fields."""


class IdsRequest(Body, frozen=True, kw_only=True):
    """A request about some presets, connections, beacons or clocks."""

    ids: Ids


class SourceRequest(Body, frozen=True, kw_only=True):
    """RTK-SOURCE: without ``id`` a question, null: no source."""

    id: PresetId | UnsetType | None = UNSET


class SurveyRequest(Body, frozen=True, kw_only=True):
    """RTK-SURVEY: without ``settings`` a question."""

    settings: RTKSurveySettings | UnsetType = UNSET


class ObjectListRequest(Body, frozen=True, kw_only=True):
    """OBJ-LIST: of some types only."""

    filter: list[str] | UnsetType = UNSET


REQUESTS: Final[dict[str, type[Body]]] = {
    **dict.fromkeys(("RTK-LIST", "RTK-STAT", "SYS-VER", "SYS-PING", "CONN-LIST", "CLK-LIST", "AUTH-INF", "AUTH-WHOAMI"), PlainRequest),
    **dict.fromkeys(("RTK-INF", "CONN-INF", "CLK-INF", "BCN-INF", "BCN-PROPS"), IdsRequest),
    "RTK-SOURCE": SourceRequest,
    "RTK-SURVEY": SurveyRequest,
    "OBJ-LIST": ObjectListRequest,
}

# Answers and notifications


class Acknowledged(Body, frozen=True, kw_only=True):
    """ACK-ACK."""

    type: Literal["ACK-ACK"]


class Refused(Body, frozen=True, kw_only=True):
    """ACK-NAK with the reason."""

    type: Literal["ACK-NAK"]
    reason: str = ""


class IdList(Body, frozen=True, kw_only=True):
    """The answer of RTK-LIST, CONN-LIST, OBJ-LIST, CLK-LIST; the notifications CONN-DEL and OBJ-DEL."""

    ids: list[str]


class PresetInformation(Body, frozen=True, kw_only=True):
    """The answer of RTK-INF."""

    preset: dict[str, RTKConfigurationPreset]
    error: dict[str, str] = {}


class Statistics(Body, frozen=True, kw_only=True):
    """The answer of RTK-STAT: of the selected base; empty where none is."""

    antenna: AntennaInformation
    messages: MessageObservations
    messages_tx: MessageObservations
    cnr: Strengths
    survey: SurveyStatus


class Source(Body, frozen=True, kw_only=True):
    """The answer of RTK-SOURCE without an id: the selected preset."""

    id: str | None


class Survey(Body, frozen=True, kw_only=True):
    """The answer of RTK-SURVEY without settings."""

    settings: RTKSurveySettings


class NewPreset(Body, frozen=True, kw_only=True):
    """The answer of X-RTK-NEW."""

    id: str


class Results(Body, frozen=True, kw_only=True):
    """The answer of X-RTK-UPDATE and X-RTK-DEL, and of BCN-PROPS: of each id the result or the error."""

    result: dict[str, bool | BeaconBasicProperties]
    error: dict[str, str] = {}


class Statuses(Body, frozen=True, kw_only=True):
    """The answer of CONN-INF, BCN-INF and CLK-INF; also notifications."""

    status: dict[str, dict[str, Any]]
    error: dict[str, str] = {}


class ServerVersion(Body, frozen=True, kw_only=True):
    """The answer of SYS-VER."""

    software: str
    version: str


class Authentication(Body, frozen=True, kw_only=True):
    """The answer of AUTH-INF."""

    methods: list[str]
    required: bool


class User(Body, frozen=True, kw_only=True):
    """The answer of AUTH-WHOAMI."""

    user: str


ANSWERS: Final[dict[str, type[Body]]] = {
    "ACK-ACK": Acknowledged,
    "ACK-NAK": Refused,
    **dict.fromkeys(("RTK-LIST", "CONN-LIST", "OBJ-LIST", "CLK-LIST", "CONN-DEL", "OBJ-DEL"), IdList),
    "RTK-INF": PresetInformation,
    "RTK-STAT": Statistics,
    "RTK-SOURCE": Source,
    "RTK-SURVEY": Survey,
    "RTK-NEW": NewPreset,
    **dict.fromkeys(("RTK-UPDATE", "RTK-DEL", "BCN-PROPS"), Results),
    **dict.fromkeys(("CONN-INF", "BCN-INF", "CLK-INF"), Statuses),
    "SYS-VER": ServerVersion,
    "AUTH-INF": Authentication,
    "AUTH-WHOAMI": User,
}

# Types of flockwave-spec 2.10 about drones, shows and the like: right, and nobody here to answer them.
_ELSEWHERE: Final = {
    "ASYNC": "CANCEL RESUME",
    "AUTH": "REQ",
    "DEV": "INF LIST LISTSUB SUB UNSUB",
    "DOCK": "INF",
    "EXT": "CFG INF LIST LOAD RELOAD SETCFG UNLOAD",
    "LCN": "INF",
    "LOG": "DATA INF",
    "OBJ": "CMD",
    "PRM": "GET SET",
    "SHOW": "CFG LIGHTS SETCFG SETLIGHTS",
    "SYS": "CLOSE MSG TIME TIMESYNC",
    "UAV": "CALIB FLY HALT HOVER INF LAND LIST MOTOR PREFLT RST RTH SIGNAL SLEEP TAKEOFF TEST VER WAKEUP",
    "WTH": "AT INF LIST",
}
ELSEWHERE: Final = frozenset(f"{major}-{minor}" for major, minors in _ELSEWHERE.items() for minor in minors.split())


class Error(Flockwave, frozen=True, kw_only=True):
    """What stands in place of a body; one of the two at least."""

    code: int | UnsetType = UNSET
    message: str | UnsetType = UNSET


class Message(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The envelope. ``refs``: the id of the request that this answers. Other keys are left to extensions.

    Either ``body`` (an object with ``type``) or ``error``.
    """

    version: Annotated[str, Meta(pattern=r"^[0-9]+(\.[0-9]+){0,2}$")] = msgspec.field(name="$fw.version")
    id: MessageId
    refs: str | UnsetType = UNSET
    body: dict[str, Any] | UnsetType = UNSET
    error: Error | UnsetType = UNSET


class Unknown(Flockwave, frozen=True, kw_only=True):
    """A body that is read for its type only."""

    type: str


def request_of(body: dict[str, Any]) -> Body:
    """Return the request in a body; ``msgspec.ValidationError`` where it breaks the schema, also for a type that has none."""
    kind = body.get("type")
    type_ = REQUESTS.get(kind) if isinstance(kind, str) else None
    if type_ is None:
        raise msgspec.ValidationError(f"no request {kind!r}")
    found = msgspec.convert(body, type_)
    if isinstance(found, IdsRequest) and len(set(found.ids)) != len(found.ids):
        raise msgspec.ValidationError("ids are not unique")
    return found


def schema() -> dict[str, Any]:
    """Return the JSON Schema of the messages: the envelope, whose body is a request or an answer by its ``type``."""
    bodies = [*dict.fromkeys(REQUESTS.values()), *dict.fromkeys(ANSWERS.values())]
    others = [Message, ConnectionInfo, BeaconStatusInfo]
    (envelope, *_), components = msgspec.json.schema_components([*others, *bodies], ref_template="#/$defs/{name}")
    by_type = [_by_type(table, role) for table, role in ((REQUESTS, "request"), (ANSWERS, "answer"))]
    components["Message"]["oneOf"] = [{"required": ["body"], "not": {"required": ["error"]}}, {"required": ["error"]}]
    return {**envelope, "$defs": components, "x-bodies": {role: rows for part in by_type for role, rows in part.items()}}


def _by_type(table: dict[str, type[Body]], role: str) -> dict[str, dict[str, dict[str, str]]]:
    return {role: {name: {"$ref": f"#/$defs/{type_.__name__}"} for name, type_ in sorted(table.items())}}
