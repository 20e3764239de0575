"""What a receiver computes itself and says of itself, as frozen values: never an input of the engine's filters.

Attitude takes headings, a base station its survey, status the health. What is not known is NaN or None, never zero. Angles are radians.
"""

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from math import isfinite, nan

from rtkmesh.gnss.time import GpsTime

Vector = tuple[float, float, float]


class CarrierSolution(IntEnum):
    """How the phases of a relative solution stand."""

    NONE = 0
    FLOAT = 1
    FIXED = 2


@dataclass(frozen=True, slots=True)
class ReceiverHeading:
    """A heading or relative position as a receiver computed it (UBX NAV-RELPOSNED, Unicore UNIHEADING, NMEA HDT and THS, SBF AttEuler).

    ``heading_rad`` is clockwise from true north, of the baseline from the base antenna to the rover antenna (``of_baseline``; Unicore:
    from antenna 1 to antenna 2) or of the vehicle; **it is NaN unless the receiver says that it is valid**. ``baseline_ned_m`` and
    ``length_m`` are valid or None and NaN in the same way. ``source`` names the message; ``solution`` is None where it does not say.
    ``extrapolated``: from old corrections. ``satellites`` is how many were used, None where it does not say.
    """

    time: GpsTime | None
    source: str
    solution: CarrierSolution | None
    of_baseline: bool = True
    heading_rad: float = nan
    heading_sigma_rad: float = nan
    pitch_rad: float = nan
    pitch_sigma_rad: float = nan
    roll_rad: float = nan
    roll_sigma_rad: float = nan
    length_m: float = nan
    length_sigma_m: float = nan
    baseline_ned_m: Vector | None = None
    baseline_sigma_ned_m: Vector | None = None
    extrapolated: bool = False
    satellites: int | None = None
    station: str = ""

    @property
    def valid(self) -> bool:
        """Whether there is a heading."""
        return isfinite(self.heading_rad)


@dataclass(frozen=True, slots=True)
class SurveyIn:
    """A receiver's survey of its own position (UBX NAV-SVIN). ``position_ecef_m`` is the mean so far, None before the first one."""

    time: GpsTime | None
    active: bool
    valid: bool
    duration_s: int
    observations: int
    position_ecef_m: Vector | None
    accuracy_m: float


@dataclass(frozen=True, slots=True)
class SatelliteInView:
    """One satellite as the receiver sees it. ``quality``: 0 no signal, 1 searched, 2 acquired, 3 unusable, 4 code, 5 to 7 and carrier."""

    satellite: int
    cn0_dbhz: float
    elevation_rad: float
    azimuth_rad: float
    residual_m: float
    quality: int
    used: bool
    healthy: bool | None
    corrected: bool


@dataclass(frozen=True, slots=True)
class SatellitesInView:
    """All satellites that a receiver knows of (UBX NAV-SAT)."""

    time: GpsTime | None
    satellites: tuple[SatelliteInView, ...]


@dataclass(frozen=True, slots=True)
class EventMark:
    """Edges at an event input (UBX TIM-TM2): GPST, None where there was no new edge or its time is not known. ``count`` of rising edges."""

    channel: int
    rising: GpsTime | None
    falling: GpsTime | None
    count: int
    accuracy_s: float


class AntennaState(StrEnum):
    """What the supervisor of an antenna says."""

    INITIALISING = "initialising"
    UNKNOWN = "unknown"
    OK = "ok"
    SHORT = "short"
    OPEN = "open"


class Jamming(StrEnum):
    """What the interference monitor says; ``critical``: there is interference and no fix."""

    UNKNOWN = "unknown"
    OK = "ok"
    WARNING = "warning"
    CRITICAL = "critical"


@dataclass(frozen=True, slots=True)
class RfBlock:
    """One radio front end. ``jamming_indicator`` is 0 (none) to 1, ``gain`` 0 to 1 of the range; ``powered`` is None where not known."""

    block: int
    antenna: AntennaState
    powered: bool | None
    jamming: Jamming
    jamming_indicator: float
    gain: float
    noise: int


@dataclass(frozen=True, slots=True)
class RfHealth:
    """The front ends of a receiver (UBX MON-RF, MON-HW)."""

    source: str
    blocks: tuple[RfBlock, ...]


@dataclass(frozen=True, slots=True)
class PortUse:
    """One port of a receiver: bytes pending, bytes so far and load (0 to 1, now) each way, and errors that were counted."""

    port: str
    sent_pending: int
    sent_bytes: int
    sent_load: float
    received_pending: int
    received_bytes: int
    received_load: float
    overruns: int
    skipped_bytes: int


@dataclass(frozen=True, slots=True)
class PortsHealth:
    """The ports of a receiver (UBX MON-COMMS). ``memory_full``, ``buffer_full``: it could not send all that it wanted to."""

    memory_full: bool
    buffer_full: bool
    ports: tuple[PortUse, ...]


@dataclass(frozen=True, slots=True)
class ReceiverVersion:
    """What a receiver is (UBX MON-VER, Unicore VERSION)."""

    model: str
    software: str
    hardware: str
    extensions: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CorrectionUse:
    """What a receiver made of one RTCM message that it was sent (UBX RXM-RTCM); ``used`` is None where it does not say."""

    message: int
    subtype: int
    station_id: int
    failed_crc: bool
    used: bool | None


@dataclass(frozen=True, slots=True)
class CommandAnswer:
    """What a receiver answered to a command (UBX ACK-ACK and ACK-NAK, Unicore ``$command,...,response: OK``)."""

    command: str
    accepted: bool
    text: str


ReceiverReport = (
    ReceiverHeading | SurveyIn | SatellitesInView | EventMark | RfHealth | PortsHealth | ReceiverVersion | CorrectionUse | CommandAnswer
)
