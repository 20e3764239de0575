"""What all codecs share: frames, the messages that decoders give, and the counters of what they refuse.

A decoder has three outcomes: messages, need more bytes, or rejected with a reason that is counted. It never raises for
what a peer sent, and it never confuses the last two.
"""

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, NamedTuple
from typing import Protocol as Interface

from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, KlobucharParameters, ReceiverFix, ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.receiver import ReceiverReport


class Protocol(StrEnum):
    """Framing of a byte stream; also the last chunk of ``rtk/{rx}/raw/{protocol}``."""

    UBX = "ubx"
    RTCM3 = "rtcm3"
    NMEA = "nmea"
    UNICORE = "unicore"
    NOVATEL = "novatel"
    SBF = "sbf"


class Frame(NamedTuple):
    """One whole, checksum-verified frame as it came, header and checksum included.

    ``kind`` names the message: UBX ``"02-15"`` (class-id in hex), RTCM 3 ``"1077"``, NMEA ``"GNGGA"``,
    Unicore and NovAtel ``"OBSVMB"`` (binary) and ``"OBSVMA"`` (ASCII), or the number of a binary log that has no name here,
    SBF the number of the block, ``"4027"``.
    """

    protocol: Protocol
    kind: str
    data: bytes


Message = Epoch | Ephemeris | KlobucharParameters | ReferenceStation | GlonassBias | ReceiverFix | ReceiverReport


@dataclass(slots=True)
class FramingCounters:
    """What a framer saw: whole frames by ``protocol/kind``, failed checksums by protocol, bytes that belonged to no frame."""

    frames: Counter[str] = field(default_factory=Counter[str])
    checksum_failures: Counter[str] = field(default_factory=Counter[str])
    bytes_in: int = 0
    bytes_skipped: int = 0


MAX_IGNORED_KINDS: Final = 1000  # that get a counter of their own


@dataclass(slots=True)
class DecodingCounters:
    """What a decoder saw: epochs, frames understood, not understood and rejected, each by ``protocol/kind`` (and reason)."""

    epochs: int = 0
    decoded: Counter[str] = field(default_factory=Counter[str])
    ignored: Counter[str] = field(default_factory=Counter[str])
    rejected: Counter[str] = field(default_factory=Counter[str])

    def ignore(self, protocol: Protocol, kind: str, count: int = 1) -> None:
        """Count frames that are not understood (the odd kinds share a counter: a hostile stream must not fill memory)."""
        name = f"{protocol}/{kind}"
        self.ignored[name if name in self.ignored or len(self.ignored) < MAX_IGNORED_KINDS else f"{protocol}/other"] += count


class Decoder(Interface):
    """Decodes the frames of one protocol."""

    counters: DecodingCounters

    def decode(self, frame: Frame) -> list[Message]:
        """Return the messages that a frame completes; never raises for what a peer sent."""
        ...
