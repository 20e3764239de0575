"""The framed protocols and the whole way of a receiver's bytes. A new protocol is one row of ``PROTOCOLS``."""

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count, islice
from typing import Final

import numpy as np
from tests.fuzz import receiver_frames as own
from tests.fuzz.bodies import BINARY, Bytes, bodies
from tests.fuzz.harness import Reader, Target

from rtkmesh.codecs import rtcm3_encode, ubx_encode
from rtkmesh.codecs.framing import FRAMED, NMEA_MAX_LENGTH, Framer
from rtkmesh.codecs.messages import Decoder, DecodingCounters, Frame, Message, Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.codecs.novatel import NovatelDecoder
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS
from rtkmesh.codecs.sbf import SbfDecoder
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx import UbxDecoder
from rtkmesh.codecs.unicore import UnicoreDecoder
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream

START: Final = GpsTime(2400, 7200.0)
_RESTART: Final = 1000  # frames until a fresh decoder: what a hostile frame did to the state must not hide what others would do
_NMEA_SEEDS: Final = (
    b"GNGGA,092725.00,4717.11399,N,00833.91590,E,4,08,1.01,499.6,M,48.0,M,1.0,0123",
    b"GNRMC,092725.00,A,4717.11399,N,00833.91590,E,0.004,77.52,091202,,,R,V",
    b"GNGST,092725.00,1.8,,,,0.012,0.011,0.024",
    b"GPGSV,3,1,12,01,40,083,46,02,17,308,41,12,07,344,39,14,22,228,45,1",
    b"GNGSA,A,3,80,71,73,79,69,,,,,,,,1.83,1.09,1.47,1",
    b"PUBX,00,081350.00,4717.113210,N,00833.915187,E,546.589,G3,2.1,2.0,0.007,77.52,0.007,,0.92,1.19,0.77,9,0,0",
)
# Printable characters without $ and *: digits, commas, points and signs are what sentences are made of.
_NMEA_ALPHABET: Final = np.frombuffer(b",,,,,,,,0123456789..-ANSEWMVRG" + bytes(c for c in range(32, 127) if c not in b"$*"), np.uint8)
_MSM: Final = [10 * group + level for group in range(107, 114) for level in range(1, 8)]
_RTCM3: Final = (*range(1001, 1014), 1019, 1020, 1029, 1033, *range(1041, 1047), *_MSM, 1230, 4072, *LAYOUTS)
_UBX: Final = ("0215", "0213", "0107", "0135", "0a04", "0a09", "0a38", "013b", "013c", "0501", "0500", "0214")


@cache
def streams() -> dict[Protocol, bytes]:
    """Return seconds of what simulated receivers send: epochs, ephemerides, stations."""
    sent = {
        antenna: b"".join(epoch.data for epoch in islice(open_stream("demo", antenna, seed=3, rate_hz=5.0, start=START).epochs(), 40))
        for antenna in ("rover", "base")
    }
    return {Protocol.UBX: sent["rover"], Protocol.RTCM3: sent["base"]}


@cache
def messages() -> list[Message]:
    """Return what the simulated rover's stream says."""
    return [message for _, found in StreamDecoder(StreamOptions(approximate_time=START)).feed(streams()[Protocol.UBX]) for message in found]


def frames_of(data: bytes) -> list[Frame]:
    """Return the frames of a stream."""
    framer = Framer()
    return [*framer.feed(data), *framer.flush()]


def _ubx_pool() -> list[bytes]:
    return [frame.data[2:4] + frame.data[6:-2] for frame in frames_of(streams()[Protocol.UBX])]


def _rtcm3_pool() -> list[bytes]:
    frames = [frame.data for frame in frames_of(streams()[Protocol.RTCM3])]
    station = ReferenceStation(7, (3.8e6, 8.9e5, 5.0e6), 1.5, "TRM115000.00    NONE", "123", "RX")
    return [data[3:-3] for data in [*frames, *rtcm3_encode.encode_station(station)]]


def seal_nmea(text: bytes) -> bytes:
    """Return the sentence of a text (``$@`` begins a block of SBF)."""
    text = b"G" + text[1:] if text[:1] == b"@" else text
    check = 0
    for character in text:
        check ^= character
    return b"$%b*%02X\r\n" % (text, check)


@dataclass(frozen=True, slots=True)
class Framed:
    """A framed protocol: how a body becomes a frame, bodies that our encoders make, heads of known messages, its decoder.

    ``longest``: bytes of a body; ``name`` of the target where it is not the protocol's: its frames may be of any.
    """

    protocol: Protocol
    seal: Callable[[bytes], bytes]
    pool: Callable[[], Sequence[bytes]]
    heads: Sequence[bytes]
    longest: int
    decoder: Callable[[GpsTime | None], Decoder]
    share: float
    alphabet: Bytes
    name: str = ""

    def frames(self, seed: int) -> Iterator[bytes]:
        """Yield random frames for ever, right in length and checksum."""
        return map(self.seal, bodies(seed, self.pool(), self.heads, self.alphabet, self.longest))

    def reader(self) -> Reader:
        """Return a reader that cuts and decodes frames, with a fresh decoder every so often, every second one without a time."""
        framer, total = Framer(FRAMED if self.name else [self.protocol]), DecodingCounters()
        decoders = (self.decoder(None if number % 2 else START) for number in count())
        decoder, left = next(decoders), _RESTART

        def feed(data: bytes) -> None:
            nonlocal decoder, left
            if left == 0:
                _add(total, flushed(decoder))
                decoder, left = next(decoders), _RESTART
            left -= 1
            for frame in framer.feed(data):
                decoder.decode(frame)

        def end() -> DecodingCounters:
            _add(total, flushed(decoder))
            return total

        return Reader(feed, end)


def flushed(decoder: Decoder) -> DecodingCounters:
    """End a decoder's stream and return its counters."""
    if isinstance(decoder, Rtcm3Decoder):
        decoder.flush()
    return decoder.counters


def _add(total: DecodingCounters, more: DecodingCounters) -> None:
    total.decoded.update(more.decoded)
    total.ignored.update(more.ignored)
    total.rejected.update(more.rejected)


PROTOCOLS: Final = (
    Framed(
        Protocol.UBX, lambda body: ubx_encode.frame(body[0], body[1], body[2:]), _ubx_pool, [bytes.fromhex(head) for head in _UBX],
        2000, UbxDecoder, 0.17, BINARY,
    ),
    Framed(
        Protocol.RTCM3, rtcm3_encode.frame, _rtcm3_pool, [struct.pack(">H", number << 4) for number in _RTCM3],
        1023, Rtcm3Decoder, 0.17, BINARY,
    ),
    Framed(
        Protocol.NMEA, seal_nmea, lambda: _NMEA_SEEDS, [seed[:6] for seed in _NMEA_SEEDS],
        NMEA_MAX_LENGTH - 8, NmeaDecoder, 0.1, _NMEA_ALPHABET,
    ),
    Framed(Protocol.SBF, own.seal_sbf, lambda: own.sbf_pool(messages(), START), own.SBF_HEADS, 4000, SbfDecoder, 0.12, BINARY),
    Framed(
        Protocol.UNICORE, own.seal_unicore, lambda: own.unicore_pool(messages(), START), own.UNICORE_HEADS,
        4000, lambda _: UnicoreDecoder(), 0.1, BINARY,
    ),
    Framed(
        Protocol.UNICORE, own.seal_ascii, lambda: own.ascii_pool(messages(), START), [b"OBSVMA,", b"GPSEPHA", b"BESTNAV", b"OBSVMCM"],
        4000, lambda _: UnicoreDecoder(), 0.04, _NMEA_ALPHABET, "ascii",
    ),
    Framed(
        Protocol.NOVATEL, own.seal_novatel, lambda: own.novatel_pool(messages(), START), own.NOVATEL_HEADS,
        4000, lambda _: NovatelDecoder(), 0.06, BINARY,
    ),
)  # fmt: skip


def mixed(seed: int) -> Iterator[bytes]:
    """Yield frames of all protocols in turn."""
    sources = [protocol.frames(seed + 1000 * number) for number, protocol in enumerate(PROTOCOLS)]
    while True:
        for source in sources:
            yield next(source)


def _stream_reader() -> Reader:
    decoder = StreamDecoder(StreamOptions(approximate_time=START))

    def end() -> DecodingCounters:
        decoder.flush()
        return decoder.decoding

    return Reader(decoder.feed, end)


def targets() -> list[Target]:
    """Return the targets of frames; counters of each must account for every frame."""
    each = [Target(framed.name or framed.protocol.value, framed.frames, framed.reader, framed.share) for framed in PROTOCOLS]
    return [*each, Target("stream", mixed, _stream_reader, 0.085)]
