"""One receiver's byte stream to messages: framing, all decoders, and one timeline of epochs.

Epochs leave in the order in which they came, each once; an epoch that was overtaken on its way by a few seconds is passed on
late (pairing puts it in its place), older ones are refused. A stream may carry the same observations in a raw protocol and as RTCM 3
(a base that logs what it sends): then only one of the two is used, because their time tags differ by milliseconds and their phases
by integers and a clock term, so that every change from one to the other breaks all ambiguities. Raw protocols are preferred: they say
more (Doppler, sigmas, all signals), and an epoch is whole or not there, while RTCM 3 may lose one system's message of five.
"""

from collections import Counter, deque
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import groupby
from operator import attrgetter
from typing import Final

import numpy as np

from rtkmesh.codecs.framing import FRAMED, Framer
from rtkmesh.codecs.messages import MAX_IGNORED_KINDS, Decoder, DecodingCounters, Frame, FramingCounters, Message, Protocol
from rtkmesh.codecs.nmea import NmeaDecoder
from rtkmesh.codecs.novatel import NovatelDecoder
from rtkmesh.codecs.option_stage import OptionStage
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.sbf import SbfDecoder
from rtkmesh.codecs.ubx import SFRBX, UbxDecoder
from rtkmesh.codecs.unicore import MAIN_ANTENNA, UnicoreDecoder
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, ReceiverFix
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.receiver_options import ReceiverOptions
from rtkmesh.gnss.time import GpsTime


class ObservationSource(StrEnum):
    """Which protocol's observations of a mixed stream are used."""

    AUTO = "auto"
    UBX = "ubx"
    RTCM3 = "rtcm3"
    UNICORE = "unicore"
    NOVATEL = "novatel"
    SBF = "sbf"


@dataclass(frozen=True, slots=True)
class StreamOptions:
    """Options of a stream decoder.

    ``receiver`` are RTKLIB's options. ``approximate_time`` (within three days of the first epoch) settles weeks until the stream does it
    itself. ``antenna`` 2 takes the observations of a receiver's second antenna (3: of its third): those that the receiver sends as
    RTCM 3 are of its first one and are refused then. Frames in ``reject`` and, with ``accept``, all but those (``rtcm3/1077``) are not
    decoded.
    """

    protocols: Collection[Protocol] = FRAMED
    observations: ObservationSource | str = ObservationSource.AUTO
    approximate_time: GpsTime | None = None
    receiver: ReceiverOptions = field(default_factory=ReceiverOptions)
    antenna: int = MAIN_ANTENNA
    accept: frozenset[str] = frozenset()
    reject: frozenset[str] = frozenset()

    def wants(self, frame: Frame) -> bool:
        """Return whether a frame is to be decoded."""
        name = f"{frame.protocol}/{frame.kind}"
        return name not in self.reject and (not self.accept or name in self.accept)


_SAME_EPOCH_S: Final = 5e-4  # epochs of one protocol that are closer than this are the same
_OVERTAKEN_S: Final = 5.0  # an epoch may come after newer ones by this much
_RECENT: Final = 256  # epochs that are remembered to tell a late one from a repeated one
_NEW_TIMELINE: Final = 5  # so many rising epochs in the past mean that the clock was set back, not that they are late
_TO_PREFERRED: Final = 3  # epochs of a raw protocol after which it is taken instead of RTCM 3
_TO_OTHER: Final = 30  # epochs of another protocol without one of the chosen one between after which that counts as gone
_TELL_TIME_S: Final = 3600.0
_KIND: Final = attrgetter("kind", "protocol")  # a sentence may be named like a number of UBX
_SUBFRAMES: Final = (SFRBX, Protocol.UBX)
_OF_SEVERAL_ANTENNAS: Final = (Protocol.UNICORE, Protocol.NOVATEL, Protocol.SBF)
_OTHER_SOURCE: Final = "of the other source"


class Timeline:
    """Decides which epochs of the protocols of one stream are passed on."""

    def __init__(self, source: ObservationSource) -> None:
        self._fixed = None if source is ObservationSource.AUTO else Protocol(source.value)
        self._chosen = self._fixed
        self._others: Counter[Protocol] = Counter()  # epochs of the other protocols since the last one of the chosen protocol
        self._last: GpsTime | None = None
        self._recent: deque[GpsTime] = deque(maxlen=_RECENT)
        self._past: list[GpsTime] = []

    def refusal(self, epoch: Epoch, protocol: Protocol) -> str:
        """Return why an epoch is not passed on, or nothing."""
        if self._chosen is None:
            self._chosen = protocol
        if protocol is not self._chosen:
            return _OTHER_SOURCE
        if self._last is None or epoch.time - self._last >= _SAME_EPOCH_S:
            self._past.clear()
            self._last = epoch.time
        elif any(abs(epoch.time - recent) < _SAME_EPOCH_S for recent in self._recent):
            return "repeated"
        elif self._last - epoch.time > _OVERTAKEN_S:
            if not self._clock_was_set_back(epoch.time):
                return "out of order"
            self._recent.clear()
            self._last = epoch.time
        self._recent.append(epoch.time)
        return ""

    def switches(self, protocol: Protocol) -> bool:
        """Count an epoch of a protocol; return whether it becomes the chosen one with it.

        A raw one is taken instead of RTCM 3 when it has come a few times, any other one when the chosen one is gone.
        """
        if self._fixed or self._chosen is None:
            return False
        if protocol is self._chosen:
            if protocol is not Protocol.RTCM3:  # beside RTCM 3 each epoch of a raw protocol counts
                self._others.clear()
            return False
        self._others[protocol] += 1
        if self._others[protocol] < (_TO_PREFERRED if self._chosen is Protocol.RTCM3 else _TO_OTHER):
            return False
        self._chosen = protocol
        self._others.clear()
        return True

    def _clock_was_set_back(self, time: GpsTime) -> bool:
        if self._past and time - self._past[-1] < _SAME_EPOCH_S:
            self._past.clear()
        self._past.append(time)
        if len(self._past) < _NEW_TIMELINE:
            return False
        self._past.clear()
        return True


class StreamDecoder:
    """Decodes the bytes of one receiver."""

    def __init__(self, options: StreamOptions | None = None) -> None:
        self.options = options = options or StreamOptions()
        self._filters = bool(options.accept or options.reject)
        self._wanted: dict[tuple[str, Protocol], bool] = {}
        self._framer = Framer(options.protocols)
        near, wanted = options.approximate_time, options.receiver
        self._repeats, self._stage = wanted.all_ephemerides, OptionStage(wanted)
        self._ubx = UbxDecoder(near, repeats=self._repeats)
        self._rtcm3 = Rtcm3Decoder(near, self._is_published, station=wanted.station)
        antenna = max(options.antenna, MAIN_ANTENNA + wanted.antenna)
        self._sbf = SbfDecoder(near, antenna - MAIN_ANTENNA, repeats=self._repeats)
        self._decoders: dict[Protocol, Decoder] = {
            Protocol.UBX: self._ubx,
            Protocol.RTCM3: self._rtcm3,
            Protocol.NMEA: NmeaDecoder(near),
            Protocol.UNICORE: UnicoreDecoder(antenna),
            Protocol.NOVATEL: NovatelDecoder(antenna),
            Protocol.SBF: self._sbf,
        }
        self._is_main = antenna == MAIN_ANTENNA
        self._timeline = Timeline(ObservationSource(options.observations))
        self._told: GpsTime | None = None
        self._published: dict[tuple[int, int], tuple[object, ...]] = {}
        self._latest: dict[tuple[type, object], Message] = {}
        self._dropped = DecodingCounters()

    @property
    def framing(self) -> FramingCounters:
        """What the framer saw."""
        return self._framer.counters

    @property
    def decoding(self) -> DecodingCounters:
        """What the decoders saw, all together; ``epochs`` are those passed on."""
        total = DecodingCounters(epochs=self._dropped.epochs)
        for counters in (*(decoder.counters for decoder in self._decoders.values()), self._dropped):
            total.decoded.update(counters.decoded)
            total.ignored.update(counters.ignored)
            total.rejected.update(counters.rejected)
        return total

    @property
    def clock_resets(self) -> int:
        """How often the receiver said that it had reset its clock."""
        return self._ubx.clock_resets + self._sbf.clock_resets

    @property
    def pending(self) -> int:
        """Number of bytes held back until it is known what they are."""
        return self._framer.pending

    def feed(self, data: bytes) -> list[tuple[Frame, list[Message]]]:
        """Return the frames that are whole with these further bytes, each with the messages that it completes."""
        return self._decode_all(self._framer.feed(data))

    def flush(self) -> list[Message]:
        """End the stream: return what was still waiting."""
        messages = [message for _, found in self._decode_all(self._framer.flush()) for message in found]
        return messages + self._pass_on(self._rtcm3.flush(), Protocol.RTCM3) + self._pass_on(self._sbf.flush(), Protocol.SBF)

    def _decode_all(self, frames: list[Frame]) -> list[tuple[Frame, list[Message]]]:
        found: list[tuple[Frame, list[Message]]] = []
        for kind, same in groupby(frames, _KIND):
            run = list(same)
            if self._filters and not self._wants(kind, run[0]):
                found += self._left_out(run)
            elif kind == _SUBFRAMES:
                lists = self._ubx.decode_subframes(run)
                found += [(frame, self._pass_on(some, Protocol.UBX) if some else some) for frame, some in zip(run, lists, strict=True)]
            else:
                found += [(frame, self._decode(frame)) for frame in run]
        return found

    def _wants(self, kind: tuple[str, Protocol], frame: Frame) -> bool:
        """Return whether frames of this kind are to be decoded (odd ones are not remembered: a hostile stream must not fill memory)."""
        wanted = self._wanted.get(kind)
        if wanted is None:
            wanted = self.options.wants(frame)
            if len(self._wanted) < MAX_IGNORED_KINDS:
                self._wanted[kind] = wanted
        return wanted

    def _left_out(self, frames: list[Frame]) -> list[tuple[Frame, list[Message]]]:
        """Count frames of one kind that nobody decodes; return each with nothing."""
        self._dropped.ignore(frames[0].protocol, frames[0].kind, len(frames))
        return [(frame, []) for frame in frames]

    def _decode(self, frame: Frame) -> list[Message]:
        decoder = self._decoders.get(frame.protocol)
        if decoder is None:
            return self._left_out([frame])[0][1]
        messages = decoder.decode(frame)
        return self._pass_on(messages, frame.protocol) if messages else messages

    def _pass_on(self, messages: list[Message], protocol: Protocol) -> list[Message]:
        passed: list[Message] = []
        for message in messages:
            if isinstance(message, Epoch):
                passed += self._epoch(self._stage.epoch(message, protocol), protocol)
            elif isinstance(message, ReceiverFix):
                if message.time is not None:
                    self._tell_time(message.time)
                passed.append(message)
            elif self._is_new(message):
                passed.append(message)
        return passed

    def _epoch(self, epoch: Epoch, protocol: Protocol) -> list[Epoch]:
        if protocol is not Protocol.RTCM3:  # raw protocols know their week
            self._tell_time(epoch.time)
        if not self._is_main and protocol not in _OF_SEVERAL_ANTENNAS:
            self._dropped.ignored[f"{protocol} epoch {_OTHER_SOURCE}"] += 1
            return []
        switched = self._timeline.switches(protocol)
        refusal = self._timeline.refusal(epoch, protocol)
        if refusal:
            counter = self._dropped.ignored if refusal == _OTHER_SOURCE else self._dropped.rejected
            counter[f"{protocol} epoch {refusal}"] += 1
            return []
        self._dropped.epochs += 1
        return [_with_all_slipped(epoch) if switched else epoch]

    def _tell_time(self, time: GpsTime) -> None:
        if self._told is None or abs(time - self._told) > _TELL_TIME_S:
            self._told = time
            self._rtcm3.set_approximate_time(time)

    def _is_new(self, message: Message) -> bool:
        """Return whether a message says something that the stream has not said before."""
        if isinstance(message, KeplerEphemeris | GlonassEphemeris):
            return self._stage.passes(message) and self._is_new_ephemeris(message)
        if isinstance(message, KlobucharParameters):
            key: tuple[type, object] = (KlobucharParameters, message.system)
        elif isinstance(message, GlonassBias):
            key = (GlonassBias, message.station_id)
        else:
            return True
        if self._latest.get(key) == message:
            return False
        self._latest[key] = message
        return True

    def _is_new_ephemeris(self, e: Ephemeris) -> bool:
        key, identity = _identity(e)
        if self._published.get(key) == identity and not self._repeats:
            return False
        self._published[key] = identity
        return True

    def _is_published(self, e: Ephemeris) -> bool:
        """Return whether the ephemeris that was passed on last for its satellite and message is this one."""
        key, identity = _identity(e)
        return self._published.get(key) == identity and not self._repeats


def _identity(e: Ephemeris) -> tuple[tuple[int, int], tuple[object, ...]]:
    """Return what an ephemeris replaces (satellite and message), and what tells it from others."""
    if isinstance(e, GlonassEphemeris):
        return (e.satellite, 0), (e.iode, e.toe, e.health, e.tau_s, e.channel)
    return (e.satellite, int(e.message)), (e.iode, e.iodc, e.toe, e.toc, e.health, e.af0_s)


def _with_all_slipped(epoch: Epoch) -> Epoch:
    return replace(epoch, flags=np.where(np.isfinite(epoch.phase_cyc), epoch.flags | SLIP, epoch.flags).astype(np.uint8))
