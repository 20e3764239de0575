"""What the decoders of Unicore's and NovAtel's logs share: the counting, observations, headings and positions."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from math import hypot, isfinite, nan, radians
from typing import Final

from rtkmesh.codecs.messages import DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.unicore_logs import POSITION_TYPE, SOLUTION_STATUS, Log, Value
from rtkmesh.codecs.unicore_observations import (
    MAX_COMPRESSED_LOCK_S,
    MAX_LOCK_S,
    Form,
    compressed_measurements,
    epoch_of,
    full_measurements,
    new_slip_state,
)
from rtkmesh.gnss.ephemeris import ReceiverFix
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading

MAIN_ANTENNA, SECOND_ANTENNA = 1, 2
COMPUTED: Final = SOLUTION_STATUS["SOL_COMPUTED"]
_FIXED: Final = frozenset(POSITION_TYPE[name] for name in ("L1_INT", "WIDE_INT", "NARROW_INT", "INS_RTKFIXED"))
_FLOAT: Final = frozenset(POSITION_TYPE[name] for name in ("L1_FLOAT", "IONOFREE_FLOAT", "NARROW_FLOAT", "INS_RTKFLOAT"))
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT_M = 90.0, 360.0, 1e6

Found = list[Message] | str


class LogDecoder(ABC):
    """Decodes the logs of one antenna of a receiver. It remembers lock times."""

    def __init__(self, protocol: Protocol) -> None:
        self.counters = DecodingCounters()
        self._protocol = protocol
        self._slip_state = new_slip_state()

    @abstractmethod
    def _open(self, frame: Frame) -> Log | None:
        """Return the log of a whole frame, None where its header is none."""

    @abstractmethod
    def _read(self, log: Log) -> Found | None:
        """Return what a log says, why it is rejected, or None where it is of no use here."""

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages of one log."""
        label = f"{self._protocol}/{frame.kind}"
        log = self._open(frame)
        found = None if log is None else self._read(log)  # None is a reply to a command
        if found is None:
            self.counters.ignore(self._protocol, frame.kind)
            return []
        if isinstance(found, str):
            self.counters.rejected[f"{label} {found}"] += 1
            return []
        self.counters.decoded[label] += 1
        return found

    def _observations(self, log: Log, form: Form, *, compressed: bool) -> Found:
        measurements = (compressed_measurements if compressed else full_measurements)(log.body, form)
        if measurements is None:
            return "length"
        if log.time is None:
            return "time"
        epoch = epoch_of(measurements, log.time, MAX_COMPRESSED_LOCK_S if compressed else MAX_LOCK_S, form, self._slip_state)
        if len(epoch) < len(measurements.numbers):
            self.counters.rejected[f"{self._protocol}/{log.name} unknown signal"] += len(measurements.numbers) - len(epoch)
        self.counters.epochs += 1
        return [epoch]


def number(value: Value) -> float:
    """Return a value as a number, NaN where it is text."""
    return nan if isinstance(value, str) else float(value)


def whole(value: Value) -> int:
    """Return a value as a whole number, 0 where it is none."""
    return 0 if isinstance(value, str) or not isfinite(value) else int(value)


def heading_of(log: Log, values: tuple[Value, ...], satellites: Value) -> ReceiverHeading:
    """Return the heading of a log: its first nine values are status, type, length m, heading, pitch, -, their sigmas (deg), station."""
    status, kind = values[:2]
    length_m, heading_deg, pitch_deg, _, heading_sigma_deg, pitch_sigma_deg = (number(value) for value in values[2:8])
    solution = CarrierSolution.FIXED if kind in _FIXED else CarrierSolution.FLOAT if kind in _FLOAT else CarrierSolution.NONE
    used, station = whole(satellites), str(values[8])
    if status != COMPUTED or solution is CarrierSolution.NONE or not 0.0 <= heading_deg <= 360.0:
        return ReceiverHeading(log.time, log.name, CarrierSolution.NONE, satellites=used, station=station)
    return ReceiverHeading(
        log.time, log.name, solution, heading_rad=radians(heading_deg % 360.0), heading_sigma_rad=_sigma(radians(heading_sigma_deg)),
        pitch_rad=radians(pitch_deg) if abs(pitch_deg) <= 90.0 else nan, pitch_sigma_rad=_sigma(radians(pitch_sigma_deg)),
        length_m=length_m if length_m > 0.0 else nan, satellites=used, station=station,
    )  # fmt: skip


def _sigma(value: float) -> float:
    return value if value > 0.0 else nan


def fix_of(
    log: Log, values: tuple[Value, ...], fix_of_type: Mapping[int, int], velocity_ned_mps: tuple[float, float, float] | None
) -> ReceiverFix:
    """Return the position of a log, whose first 15 values are those of BESTNAV and BESTPOS.

    ``fix_of_type``: position type to ``ReceiverFix.fix``; types that are not there are no fix.
    """
    lat_deg, lon_deg, sea_height_m, undulation_m = (number(value) for value in values[2:6])
    lat_sigma_m, lon_sigma_m, height_sigma_m = (number(value) for value in values[7:10])
    fix = fix_of_type.get(whole(values[1]), 0) if values[0] == COMPUTED else 0
    height_m, satellites = sea_height_m + undulation_m, whole(values[14])
    inside = abs(lat_deg) <= _LATITUDE_DEG and abs(lon_deg) <= _LONGITUDE_DEG and abs(height_m) < _HEIGHT_M
    if fix == 0 or not inside:
        return ReceiverFix(log.time, 0, nan, nan, nan, nan, nan, None, satellites)
    return ReceiverFix(
        log.time, fix, radians(lat_deg), radians(lon_deg), height_m, hypot(lat_sigma_m, lon_sigma_m), height_sigma_m, velocity_ned_mps,
        satellites,
    )  # fmt: skip
