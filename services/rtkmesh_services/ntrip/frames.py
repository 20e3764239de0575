"""Whole frames on their way to somebody who may be slow or away: bounded, the oldest go first, never a part of one."""

from collections import deque
from collections.abc import Iterator
from typing import Final

MAXIMUM_BYTES: Final = 131072
MAXIMUM_AGE_S: Final = 15.0  # corrections that are older help nobody
BASIC: Final = frozenset({*range(1001, 1007), *range(1009, 1013), *range(1071, 1140), 1230})  # what Skybrush calls so
STATION_NUMBERS: Final = frozenset({1005, 1006, 1007, 1008, 1033, 1230})
_SYSTEMS: Final = {107: "GPS", 108: "GLO", 109: "GAL", 110: "SBAS", 111: "QZS", 112: "BDS", 113: "IRN"}
_LEGACY: Final = {1002: "GPS", 1004: "GPS", 1010: "GLO", 1012: "GLO"}


class FrameQueue:
    """Frames that wait to be sent; ``dropped`` counts those that had to go."""

    def __init__(self, maximum_bytes: int = MAXIMUM_BYTES, maximum_age_s: float = MAXIMUM_AGE_S) -> None:
        self._frames: deque[tuple[float, bytes]] = deque()
        self._maximum_bytes, self._maximum_age_s = maximum_bytes, maximum_age_s
        self.bytes = self.dropped = 0

    def put(self, frame: bytes, now_s: float) -> None:
        """Take a frame; what is too old or too much goes, oldest first."""
        self._frames.append((now_s, frame))
        self.bytes += len(frame)
        while self._frames and (self.bytes > self._maximum_bytes or now_s - self._frames[0][0] > self._maximum_age_s):
            self._drop()

    def get(self) -> bytes | None:
        """Return the oldest frame, None when there is none."""
        if not self._frames:
            return None
        _, frame = self._frames.popleft()
        self.bytes -= len(frame)
        return frame

    def get_some(self, maximum_bytes: int) -> list[bytes]:
        """Return the oldest frames, at least one if there is any, together about so many bytes."""
        frames: list[bytes] = []
        size = 0
        while size < maximum_bytes and (frame := self.get()) is not None:
            frames.append(frame)
            size += len(frame)
        return frames

    def _drop(self) -> None:
        _, frame = self._frames.popleft()
        self.bytes -= len(frame)
        self.dropped += 1


class StreamPicture:
    """What a source table says of a stream, and what a newcomer gets at once: the last word of the station on itself."""

    def __init__(self) -> None:
        self._station: dict[int, bytes] = {}
        self._kinds: dict[int, list[float]] = {}  # count, first and last instant
        self._bytes = 0
        self._first_s: float | None = None
        self._last_s = 0.0

    def add(self, frame: bytes, now_s: float) -> None:
        """Take note of a frame."""
        number = message_number(frame)
        row = self._kinds.setdefault(number, [0.0, now_s, now_s])
        row[0], row[2] = row[0] + 1.0, now_s
        self._first_s = now_s if self._first_s is None else self._first_s
        self._last_s = now_s
        self._bytes += len(frame)
        if number in STATION_NUMBERS:
            self._station[number] = frame

    def station_frames(self) -> Iterator[bytes]:
        """Yield the newest frames about the station."""
        yield from self._station.values()

    @property
    def format(self) -> str:
        """The stream's format in the words of source tables."""
        return "RTCM 3.3" if any(self._kinds) else "RAW" if self._kinds else ""

    @property
    def details(self) -> str:
        """Message numbers with their periods in seconds: ``1005(10),1077(1)``."""
        rows = sorted((number, row) for number, row in self._kinds.items() if number)
        return ",".join(f"{number}({max(1, round((last - first) / max(1.0, count - 1)))})" for number, (count, first, last) in rows)

    @property
    def systems(self) -> str:
        """The satellite systems: ``GPS+GAL``."""
        names = [_SYSTEMS.get(number // 10) or _LEGACY.get(number) for number in sorted(self._kinds)]
        return "+".join(dict.fromkeys(name for name in names if name))

    @property
    def has_phases(self) -> bool:
        """Whether carrier phases are in it."""
        return bool(self.systems)

    @property
    def bitrate(self) -> int:
        """Bits per second since the first frame."""
        return round(8 * self._bytes / max(1.0, self._last_s - (self._first_s or 0.0)))


def message_number(frame: bytes) -> int:
    """Return the message number of an RTCM 3 frame, 0 for other frames."""
    return frame[3] << 4 | frame[4] >> 4 if len(frame) > 6 and frame[0] == 0xD3 else 0
