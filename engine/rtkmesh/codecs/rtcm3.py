"""RTCM 3 frames to epochs, ephemerides and stations (RTCM 10403.3). Sans-I/O; nothing that a peer sends raises.

Epochs need the GPS week, which the messages do not carry: it comes from ``approximate_time``, from ephemerides, and then from the
stream's own epochs. Until one is known observation messages wait (the newest ``MAX_HELD``, the rest is counted).
"""

from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs import rtcm3_legacy, rtcm3_station
from rtkmesh.codecs.messages import DecodingCounters, Frame, Message
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS as EPHEMERIDES
from rtkmesh.codecs.rtcm3_ephemeris import decode_ephemeris
from rtkmesh.codecs.rtcm3_epochs import EpochGatherer
from rtkmesh.codecs.rtcm3_legacy import LegacyDecoder
from rtkmesh.codecs.rtcm3_msm import SYSTEM_OF_GROUP, Observations, decode_msm
from rtkmesh.codecs.rtcm3_station import StationDecoder
from rtkmesh.gnss.ephemeris import GlonassEphemeris
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import NO_CHANNEL, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime

MAX_HELD: Final = 256
OVERHEAD: Final = 3  # bytes before and behind the payload
MSM: Final = frozenset(10 * group + level for group in SYSTEM_OF_GROUP for level in (4, 5, 6, 7))
_TEN_BIT_WEEKS: Final = (1019, 1044)
_HALF_AN_ERA: Final = 512  # weeks
OBSERVATIONS: Final = MSM | frozenset(rtcm3_legacy.NUMBERS)


class Rtcm3Decoder:
    """Decoder of one stream. ``approximate_time`` must be within three days of the stream's first epoch."""

    def __init__(self, approximate_time: GpsTime | None = None) -> None:
        self.counters = DecodingCounters()
        self._channels: NDArray[np.int8] = np.full(SATELLITES_PER_SYSTEM, NO_CHANNEL, np.int8)
        self._gatherer = EpochGatherer(approximate_time, self.counters.rejected)
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
        if number in OBSERVATIONS:
            if self._gatherer.clock is None:
                return self._hold(frame, kind)
            held = self._release() if self._held else []
            return [*held, *self._observations(payload, number, kind)]
        if number in EPHEMERIDES:
            return self._ephemeris(payload, number, kind)
        if number in rtcm3_station.NUMBERS:
            return self._station(payload, number, kind)
        self.counters.ignored[kind] += 1
        return []

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
        observations = self._read_observations(payload, number, kind)
        if observations is None:
            return []
        self.counters.decoded[kind] += 1
        epochs = self._gatherer.add(kind, observations)
        self.counters.epochs += len(epochs)
        return epochs

    def _read_observations(self, payload: bytes, number: int, kind: str) -> Observations | None:
        if number not in MSM:
            observations = self._legacy.decode(payload, number)
            if observations is None:
                self.counters.rejected[f"{kind} too short"] += 1
            return observations
        result = decode_msm(payload, number, self._channels)
        if result.observations is None:
            self.counters.rejected[f"{kind} {result.reason}"] += 1
        if result.unknown_cells:
            self.counters.rejected[f"{kind} cell of unknown satellite or signal"] += result.unknown_cells
        if result.unknown_channels:
            self.counters.rejected[f"{kind} cell of unknown frequency channel"] += result.unknown_channels
        return result.observations

    def _ephemeris(self, payload: bytes, number: int, kind: str) -> list[Message]:
        ephemeris = decode_ephemeris(payload, number, self._gatherer.clock)
        if isinstance(ephemeris, str):
            self.counters.rejected[f"{kind} {ephemeris}"] += 1
            return []
        self.counters.decoded[kind] += 1
        if isinstance(ephemeris, GlonassEphemeris):
            self._channels[ephemeris.satellite % SATELLITES_PER_SYSTEM] = ephemeris.channel
        self._learn_time(ephemeris.toe, number)
        return [ephemeris, *self._release()]

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
