"""RTCM 3 frames to epochs, ephemerides and stations (RTCM 10403.3). Sans-I/O; nothing that a peer sends raises.

Epochs need the GPS week, which the messages do not carry: it comes from ``approximate_time``, from ephemerides, and then from the
stream's own epochs. Until one is known observation messages wait (the newest ``MAX_HELD``, the rest is counted).
"""

from collections import deque
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs import rtcm3_legacy, rtcm3_station
from rtkmesh.codecs.messages import DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS as EPHEMERIDES
from rtkmesh.codecs.rtcm3_ephemeris import EphemerisDecoder
from rtkmesh.codecs.rtcm3_epochs import EpochGatherer
from rtkmesh.codecs.rtcm3_known import known_name
from rtkmesh.codecs.rtcm3_legacy import LegacyDecoder
from rtkmesh.codecs.rtcm3_msm import SYSTEM_OF_GROUP, Part, decode_msm
from rtkmesh.codecs.rtcm3_station import StationDecoder
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import NO_CHANNEL, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

MAX_HELD: Final = 256
OVERHEAD: Final = 3  # bytes before and behind the payload
MSM: Final = frozenset(10 * group + level for group in SYSTEM_OF_GROUP for level in (4, 5, 6, 7))
_TEN_BIT_WEEKS: Final = (1019, 1041, 1044)
_HALF_AN_ERA: Final = 512  # weeks
OBSERVATIONS: Final = MSM | frozenset(rtcm3_legacy.NUMBERS)
_WITH_STATION: Final = OBSERVATIONS | frozenset(rtcm3_station.NUMBERS)


def _never(_: Ephemeris) -> bool:
    return False


class Rtcm3Decoder:
    """Decoder of one stream. ``approximate_time`` must be within three days of the stream's first epoch.

    An ephemeris that repeats the last one of its satellite is left out if ``is_known`` says so of that one (by default never). ``station``:
    messages of other stations are left out.
    """

    def __init__(
        self, approximate_time: GpsTime | None = None, is_known: Callable[[Ephemeris], bool] = _never, *, station: int | None = None
    ) -> None:  # fmt: skip
        self._station_id = station
        self.counters = DecodingCounters()
        self._channels: NDArray[np.int8] = np.full(SATELLITES_PER_SYSTEM, NO_CHANNEL, np.int8)
        self._gatherer = EpochGatherer(approximate_time, self.counters.rejected)
        self._ephemerides = EphemerisDecoder()
        self._is_known = is_known
        self._legacy = LegacyDecoder(self._channels)
        self._stations = StationDecoder()
        self._held: deque[Frame] = deque()
        self._given = approximate_time is not None

    def set_approximate_time(self, time: GpsTime) -> None:
        """Give a time from elsewhere (UBX messages of the same stream, the caller's date); it only ever decides the week."""
        self._given = True
        self._gatherer.set_clock(time)

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages that this frame completes."""
        payload = frame.data[OVERHEAD:-OVERHEAD]
        if len(payload) < 2:
            self.counters.rejected["rtcm3 too short"] += 1
            return []
        number = payload[0] << 4 | payload[1] >> 4
        kind = f"rtcm3/{number}"
        if self._is_of_another_station(payload, number):
            self.counters.ignore(Protocol.RTCM3, f"{number} of another station")
            return []
        if number in OBSERVATIONS:
            if self._gatherer.clock is None:
                return self._hold(frame, kind)
            held = self._release() if self._held else ()
            return [*held, *self._observations(payload, number, kind)]
        if number in EPHEMERIDES:
            return self._ephemeris(payload, number, kind)
        if number in rtcm3_station.NUMBERS:
            return self._station(payload, number, kind)
        self.counters.ignore(Protocol.RTCM3, f"{number} {known_name(number)}".rstrip())
        return []

    def _is_of_another_station(self, payload: bytes, number: int) -> bool:
        """Return whether a message names a station (12 bits behind its number), and it is not the wanted one."""
        if self._station_id is None or len(payload) < 3 or number not in _WITH_STATION:
            return False
        return int.from_bytes(payload[1:3], "big") & 0xFFF != self._station_id

    def flush(self) -> list[Message]:
        """End the stream: return the unfinished epoch; what still waits for a time is counted as rejected."""
        messages = self._release()
        for frame in self._held:
            self.counters.rejected[f"rtcm3/{frame.kind} time unknown"] += 1
        self._held.clear()
        epochs = self._gatherer.flush()
        self.counters.epochs += len(epochs)
        return [*messages, *epochs]

    def _hold(self, frame: Frame, kind: str) -> list[Message]:
        if len(self._held) == MAX_HELD:
            self._held.popleft()
            self.counters.rejected[f"{kind} time unknown"] += 1
        self._held.append(frame)
        return []

    def _release(self) -> list[Message]:
        """Decode what waited for a time, if there is one now."""
        messages: list[Message] = []
        while self._held and self._gatherer.clock:
            payload = self._held.popleft().data[OVERHEAD:-OVERHEAD]
            number = payload[0] << 4 | payload[1] >> 4
            messages += self._observations(payload, number, f"rtcm3/{number}")
        return messages

    def _observations(self, payload: bytes, number: int, kind: str) -> list[Epoch]:
        part = self._read_observations(payload, number, kind)
        if part is None:
            return []
        self.counters.decoded[kind] += 1
        epochs = self._gatherer.add(kind, part)
        self.counters.epochs += len(epochs)
        return epochs

    def _read_observations(self, payload: bytes, number: int, kind: str) -> Part | None:
        """Decode a message into the gatherer's rows; return what it is, None if it was rejected."""
        if number not in MSM:
            part = self._legacy.decode(payload, number, self._gatherer.rows)
            if part is None:
                self.counters.rejected[f"{kind} too short"] += 1
            return part
        part, reason, unknown_cells, unknown_channels = decode_msm(payload, number, self._channels, self._gatherer.rows)
        if part is None:
            self.counters.rejected[f"{kind} {reason}"] += 1
        if unknown_cells:
            self.counters.rejected[f"{kind} cell of unknown satellite or signal"] += unknown_cells
        if unknown_channels:
            self.counters.rejected[f"{kind} cell of unknown frequency channel"] += unknown_channels
        return part

    def _ephemeris(self, payload: bytes, number: int, kind: str) -> list[Message]:
        ephemeris, repeats = self._ephemerides.decode(payload, number, self._gatherer.clock, self._is_known)
        if isinstance(ephemeris, str):
            self.counters.rejected[f"{kind} {ephemeris}"] += 1
            return []
        self.counters.decoded[kind] += 1
        if isinstance(ephemeris, GlonassEphemeris):
            self._channels[ephemeris.satellite % SATELLITES_PER_SYSTEM] = ephemeris.channel
        self._learn_time(ephemeris.toe, number)
        return self._release() if repeats else [ephemeris, *self._release()]

    def _learn_time(self, toe: GpsTime, number: int) -> None:
        """Take the clock from ephemerides if none was given; a ten-bit week that proves to be of another era gives way."""
        clock = self._gatherer.clock
        if clock is None or (not self._given and number not in _TEN_BIT_WEEKS and abs(toe.week - clock.week) > _HALF_AN_ERA):
            self._gatherer.set_clock(toe)

    def _station(self, payload: bytes, number: int, kind: str) -> list[Message]:
        station = self._stations.decode(payload, number)
        if isinstance(station, str):
            self.counters.rejected[f"{kind} {station}"] += 1
            return []
        self.counters.decoded[kind] += 1
        return [] if station is None else [station]
