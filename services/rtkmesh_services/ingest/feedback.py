"""What a receiver says of the corrections it gets: UBX RXM-RTCM (u-blox F9 HPG 1.32, 3.17.11), Unicore RTCMSTATUS (N4, 7.3)."""

from collections import Counter
from dataclasses import dataclass, field
from math import inf
from typing import Any, Final

from rtkmesh.codecs.messages import Frame
from rtkmesh.gnss.receiver import CorrectionUse
from rtkmesh_services.ingest.receivers.ublox import report_of
from rtkmesh_services.ntrip.frames import MAXIMUM_AGE_S

RXM_RTCM: Final = "02-32"
JUDGED_AFTER: Final = 5  # messages that were not used before it is said that none is
_WORDS: Final = {None: "unknown", False: "not_used", True: "used"}
_MAXIMUM_NUMBERS: Final = 200  # a receiver says whatever it likes: counters stay bounded


@dataclass(slots=True)
class Verdict:
    """What a receiver says of one message: ``used``, ``not_used``, ``unknown`` (it does not tell) or ``crc_failed``."""

    number: int
    word: str
    station: int = 0


@dataclass(slots=True)
class Feedback:
    """Counts what a receiver says of corrections."""

    words: dict[int, Counter[str]] = field(default_factory=dict[int, Counter[str]])
    crc_failed: int = 0
    station: int | None = None
    heard_s: float = -inf
    _used_s: float = -inf
    _unused_since_s: float = inf
    _unused: int = 0

    def hear(self, verdict: Verdict, now_s: float) -> None:
        """Take what was said of one message."""
        self.heard_s = now_s
        if verdict.word == "crc_failed":
            self.crc_failed += 1
            return
        self.station = verdict.station
        if verdict.number in self.words or len(self.words) < _MAXIMUM_NUMBERS:
            self.words.setdefault(verdict.number, Counter())[verdict.word] += 1
        if verdict.word == "used":
            self._used_s, self._unused, self._unused_since_s = now_s, 0, inf
        elif verdict.word == "not_used":
            self._unused, self._unused_since_s = self._unused + 1, min(self._unused_since_s, now_s)

    def complaint(self, now_s: float) -> str:
        """Return what is wrong with the corrections in the receiver's eyes, or nothing."""
        lately = now_s - self.heard_s < MAXIMUM_AGE_S
        if lately and self._unused >= JUDGED_AFTER and now_s - self._unused_since_s > MAXIMUM_AGE_S:
            return "the receiver gets corrections and uses none of them (other signals or another station than it wants?)"
        return ""

    def data(self, now_s: float) -> dict[str, Any]:
        """Return the counts for a status."""
        if self.heard_s == -inf:
            return {}
        numbers = {str(number): dict(words) for number, words in sorted(self.words.items())}
        return {"messages": numbers, "crc_failed": self.crc_failed, "station_id": self.station, "age_s": now_s - self.heard_s}


def verdict_of_frame(frame: Frame) -> Verdict | None:
    """Return what an RXM-RTCM says, None for other frames and for one that is too short."""
    use = report_of(frame) if frame.kind == RXM_RTCM else None
    if not isinstance(use, CorrectionUse):
        return None
    return Verdict(use.message, "crc_failed" if use.failed_crc else _WORDS[use.used], use.station_id)


def verdict_of_line(line: str) -> Verdict | None:
    """Return what an RTCMSTATUSA says, None for other lines. A Unicore receiver names what it decoded, not what it used."""
    _, found, rest = line.partition("#RTCMSTATUSA,")
    fields = rest.partition(";")[2].partition("*")[0].split(",")
    if not found or len(fields) < 4 or not all(text.isdecimal() and len(text) < 10 for text in fields[:4]):
        return None
    return Verdict(int(fields[0]), "unknown", int(fields[2]))
