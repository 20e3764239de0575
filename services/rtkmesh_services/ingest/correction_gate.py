"""Which messages of a base's RTCM 3 a receiver gets, and which of them belong to one epoch.

A receiver waits for more systems of an epoch as long as the multiple-message bit says so (RTCM 10403.3, DF393, DF005, DF034): where
the last message of an epoch is left out, the bit of the one before it is cleared.
"""

from dataclasses import dataclass
from typing import Final

from rtkmesh.codecs.rtcm3_encode import frame as framed
from rtkmesh_schemas.config import CorrectionsTable
from rtkmesh_services.ntrip.frames import BASIC, message_number

HOLD_S: Final = 0.3  # so long a message waits for the next one of its epoch where the last one may be left out
_GLONASS_LEGACY: Final = range(1009, 1013)
_MORE_AT: Final = 9  # byte of a frame with the multiple-message bit
_SHORTEST: Final = 13


@dataclass(frozen=True, slots=True)
class Correction:
    """A whole frame for a receiver. ``epoch`` counts the epochs of its stream from 1; 0: it is of none."""

    frame: bytes
    number: int
    epoch: int
    received_s: float


def is_observation(number: int) -> bool:
    """Return whether a message number is of observations: MSM1 to MSM7, or 1001 to 1004 and 1009 to 1012."""
    return (1071 <= number <= 1137 and 1 <= number % 10 <= 7) or 1001 <= number <= 1004 or number in _GLONASS_LEGACY


def more_mask(number: int) -> int:
    """Return the mask of the multiple-message bit in its byte: bit 54 of the payload, 51 where the time has 27 bits."""
    return 0x10 if number in _GLONASS_LEGACY else 0x02


def without_more(frame: bytes, number: int) -> bytes:
    """Return an observation frame that says to be the last of its epoch."""
    payload = bytearray(frame[3:-3])
    payload[_MORE_AT - 3] &= ~more_mask(number) & 0xFF
    return framed(bytes(payload))


class EpochCounter:
    """Numbers the epochs of a stream; ``more`` of the newest observation says whether its epoch goes on."""

    def __init__(self) -> None:
        self._epoch = 0
        self._times: dict[int, bytes] = {}
        self.more = False

    def count(self, frame: bytes, number: int) -> int:
        """Return the number of the epoch that a frame belongs to, 0 for none."""
        if not is_observation(number) or len(frame) < _SHORTEST:
            return 0
        mask = more_mask(number)
        time = frame[6:9] + bytes((frame[9] & ~(2 * mask - 1) & 0xFF,))  # 24 bits and those before the multiple-message bit
        if not self.more or self._times.get(number, time) != time:
            self._epoch += 1
            self._times.clear()
        self._times[number] = time
        self.more = bool(frame[_MORE_AT] & mask)
        return self._epoch


class CorrectionGate:
    """Lets pass what a receiver shall get."""

    def __init__(self, table: CorrectionsTable) -> None:
        self._accepted, self._rejected = frozenset(table.accept), frozenset(table.reject)
        self._basic = table.set == "basic"
        self._epochs = EpochCounter()
        self._cuts = False  # an observation was left out: from then on the last one of an epoch may be
        self._held: Correction | None = None

    def passes(self, number: int) -> bool:
        """Return whether messages of a number pass."""
        if number in self._rejected:
            return False
        return number in self._accepted if self._accepted else not self._basic or number in BASIC

    def take(self, frame: bytes, now_s: float) -> list[Correction]:
        """Return what a frame lets go to the receiver: itself, or one that waited for it."""
        number = message_number(frame)
        found = Correction(frame, number, self._epochs.count(frame, number), now_s)
        out = self._close() if self._held is not None and found.epoch > self._held.epoch else []
        if not self.passes(number):
            self._cuts |= found.epoch > 0
            return out if self._epochs.more or not found.epoch else out + self._close()
        if not found.epoch:
            return [*out, found]
        if self._held is not None:
            out.append(self._held)
            self._held = None
        if self._cuts and self._epochs.more:
            self._held = found
            return out
        return [*out, found]

    def flush(self, now_s: float) -> list[Correction]:
        """Return what has waited long enough for the next message of its epoch."""
        return self._close() if self._held is not None and now_s - self._held.received_s > HOLD_S else []

    def _close(self) -> list[Correction]:
        held, self._held = self._held, None
        if held is None:
            return []
        return [Correction(without_more(held.frame, held.number), held.number, held.epoch, held.received_s)]
