"""What RTK-STAT tells of the selected base: from its frames, epochs, position and status, each as old as it is by the monotonic clock."""

from collections import deque
from collections.abc import Iterable
from math import isfinite
from struct import iter_unpack
from typing import Any, Final

import msgspec

from rtkmesh_schemas import base
from rtkmesh_schemas.flockwave import (
    SURVEY_ACTIVE,
    SURVEY_SUPPORTED,
    SURVEY_VALID,
    AntennaInformation,
    MessageObservations,
    Statistics,
    SurveyStatus,
)
from rtkmesh_schemas.observation import Observation, ReferenceMessage
from rtkmesh_schemas.status import InputStatus, ServiceStatus
from rtkmesh_services.control.flockwave.coordinates import Position, coordinate, millimetres
from rtkmesh_services.ntrip.frames import BASIC, message_number

_S: Final = 1_000_000_000
WINDOW_NS: Final = 10 * _S  # of bit rates, also in the first ten seconds
POSITION_NS: Final = 30 * _S  # a base that has not said its position for so long has none
STRENGTH_NS: Final = 15 * _S  # a satellite that was not heard for so long is gone
_OVERHEAD: Final = 6  # preamble, length and checksum of a frame: a message is what stands between
_POSITIONS: Final = (1005, 1006)
_LETTERS: Final = {letter: letter for letter in "GREC"} | {"J": "Q"}
_ACTIVE: Final = ("surveying", "averaging")
_KNOWN: Final = ("surveyed", "averaged", "fixed")


class Forwarding:
    """Which messages of a base go on: not those that its preset rejects, only those that it accepts, and only those of the set."""

    def __init__(self, accept: Iterable[str] = (), reject: Iterable[str] = (), *, basic: bool = True) -> None:
        self._accept, self._reject, self._basic = frozenset(accept), frozenset(reject), basic

    def passes(self, number: int) -> bool:
        """Return whether a message number passes."""
        name = f"rtcm3/{number}"
        if name in self._reject or (self._accept and name not in self._accept):
            return False
        return not self._basic or number in BASIC


class _Figures:
    """The messages of one number."""

    def __init__(self) -> None:
        self._sizes: deque[tuple[int, int]] = deque()
        self._bytes = 0
        self.newest_ns = 0

    def add(self, now_ns: int, size: int) -> None:
        self._sizes.append((now_ns, size))
        self._bytes += size
        self.newest_ns = now_ns
        self._forget(now_ns)

    def told(self, now_ns: int) -> tuple[float, float]:
        """Return age (ms) and bits per second."""
        self._forget(now_ns)
        return (now_ns - self.newest_ns) // 1_000_000, 8.0 * self._bytes * _S / WINDOW_NS

    def _forget(self, now_ns: int) -> None:
        while self._sizes and now_ns - self._sizes[0][0] > WINDOW_NS:
            self._bytes -= self._sizes.popleft()[1]


class BaseStatistics:
    """One selected base from its selection on. ``position_said`` counts how often it has said where it stands."""

    def __init__(self, forwarding: Forwarding) -> None:
        self._forwarding = forwarding
        self._messages: dict[int, _Figures] = {}
        self._strengths: dict[str, tuple[int, float]] = {}
        self._reference: tuple[int, ReferenceMessage] | None = None
        self._status: tuple[int, ServiceStatus] | None = None
        self._told: tuple[int, Position] | None = None
        self.position_said = 0

    def frame(self, frame: bytes, now_ns: int) -> None:
        """Take a whole RTCM 3 frame."""
        number = message_number(frame)
        if number:
            self._messages.setdefault(number, _Figures()).add(now_ns, len(frame) - _OVERHEAD)
            self.position_said += number in _POSITIONS

    def epoch(self, observation: Observation, now_ns: int) -> None:
        """Take the strengths of an epoch: of each satellite its strongest signal."""
        strongest: dict[str, float] = {}
        values = iter_unpack("<d", observation.cn0_dbhz[: len(observation.cn0_dbhz) // 8 * 8])
        for satellite, (cn0_dbhz,) in zip(observation.satellite, values, strict=False):
            letter = _LETTERS.get(satellite[:1])
            if letter and isfinite(cn0_dbhz) and cn0_dbhz > 0.0:
                name = letter + satellite[1:]
                strongest[name] = max(cn0_dbhz, strongest.get(name, 0.0))
        self._strengths.update((name, (now_ns, value)) for name, value in strongest.items())

    def reference(self, message: ReferenceMessage, now_ns: int) -> None:
        """Take what the base's stream, or its configuration, says of the antenna."""
        self._reference = now_ns, message

    def status(self, status: ServiceStatus, now_ns: int) -> None:
        """Take the status of the base's ingest."""
        self._status = now_ns, status

    def tell_position(self, position_ecef_m: Position, now_ns: int) -> None:
        """Take a position that the receiver is being told: it is shown until the stream says one."""
        self._told = now_ns, position_ecef_m

    def is_connected(self) -> bool:
        """Return whether the link to the base stands."""
        return self._input() is not None and getattr(self._input(), "state", "") == "connected"

    def answer(self, kind: str, now_ns: int) -> Statistics:
        """Return the answer to RTK-STAT."""
        messages = {number: figures.told(now_ns) for number, figures in sorted(self._messages.items())}
        return Statistics(
            type=kind,
            antenna=self.antenna(now_ns),
            messages=_named(messages),
            messages_tx=_named({number: row for number, row in messages.items() if self._forwarding.passes(number)}),
            cnr=self._present_strengths(now_ns),
            survey=self._survey(),
        )

    def antenna(self, now_ns: int) -> AntennaInformation:
        """Return what is known of the antenna."""
        known: dict[str, Any] = {}
        message = None if self._reference is None else self._reference[1]
        if message is not None and (message.origin or message.antenna):
            known["station_id"] = message.station_id
            known |= {"descriptor": message.antenna} if message.antenna else {}
            known |= {"serial_number": message.antenna_serial} if message.antenna_serial else {}
        if (position := self.position(now_ns)) is not None:
            known |= {"position": coordinate(position), "position_ecef": millimetres(position)}
        return AntennaInformation(**known)

    def position(self, now_ns: int) -> Position | None:
        """Return where the antenna stands (ECEF, m), as far as that was said in the last 30 s or is known otherwise."""
        sent_ns, sent = self._sent()
        if self._told is not None and self._told[0] >= sent_ns:
            return self._told[1]
        if sent is not None:
            return sent if now_ns - sent_ns <= POSITION_NS else None
        return None if self._reference is None else self._reference[1].position_ecef_m

    def _sent(self) -> tuple[int, Position | None]:
        """Return the position that the stream says, and when it said it last."""
        said_ns = max((figures.newest_ns for number, figures in self._messages.items() if number in _POSITIONS), default=0)
        if self._reference is not None and self._reference[1].origin == "rtcm3":
            return max(said_ns, self._reference[0] if not said_ns else 0), self._reference[1].position_ecef_m
        row = self._input()
        stream = None if row is None or row.stream is None else row.stream.reference
        if self._status is None or stream is None or stream.age_s is None:
            return said_ns, None
        return max(said_ns, self._status[0] - round(stream.age_s * _S)), stream.position_ecef_m

    def _input(self) -> InputStatus | None:
        """Return the status of the source in use."""
        return self._status[1].inputs[0] if self._status is not None and self._status[1].inputs else None

    def _present_strengths(self, now_ns: int) -> dict[str, float]:
        self._strengths = {name: row for name, row in self._strengths.items() if now_ns - row[0] <= STRENGTH_NS}
        return {name: value for name, (_, value) in sorted(self._strengths.items())}

    def _survey(self) -> SurveyStatus:
        """Return how the survey goes: what the base station of the ingest says, else what the receiver says of itself."""
        data = {} if self._status is None else self._status[1].data
        station = _converted(data.get("base_station"))
        if station is not None and station.state in (*_ACTIVE, *_KNOWN):
            active, valid = station.state in _ACTIVE, station.state in _KNOWN and station.valid
            return _survey(active=active, valid=valid, accuracy_m=station.accuracy_m)
        told = data.get("survey_in")
        if isinstance(told, dict) and (told.get("active") or told.get("valid")):  # pyright: ignore[reportUnknownMemberType]  data is of any kind
            return _survey(active=told.get("active") is True, valid=told.get("valid") is True, accuracy_m=told.get("accuracy_m"))  # pyright: ignore[reportUnknownMemberType, reportUnknownArgumentType]
        return SurveyStatus()


def empty(kind: str) -> Statistics:
    """Return the answer to RTK-STAT where no base is selected."""
    return Statistics(type=kind, antenna=AntennaInformation(), messages={}, messages_tx={}, cnr={}, survey=SurveyStatus())


def _named(rows: dict[int, tuple[float, float]]) -> MessageObservations:
    return {f"rtcm3/{number}": row for number, row in rows.items()}


def _survey(*, active: bool, valid: bool, accuracy_m: Any) -> SurveyStatus:
    accuracy = float(accuracy_m) if isinstance(accuracy_m, int | float) else 0.0
    return SurveyStatus(accuracy=accuracy, flags=SURVEY_SUPPORTED + SURVEY_ACTIVE * active + SURVEY_VALID * valid)


def _converted(value: Any) -> base.SurveyStatus | None:
    try:
        return None if value is None else msgspec.convert(value, base.SurveyStatus)
    except msgspec.ValidationError:
        return None
