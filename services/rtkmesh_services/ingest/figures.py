"""What a source of an ingest has brought: counted by a dictionary update a frame, made into figures only when somebody asks.

A hostile stream has any number of kinds of messages: counters are bounded, and what a status tells of them even more.
"""

from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

from rtkmesh.codecs.messages import DecodingCounters, Frame, FramingCounters, Message
from rtkmesh.gnss.ephemeris import ReferenceStation
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, SYSTEMS, signal_code
from rtkmesh_schemas.status import FrameFigures, ReferenceStatus, SignalStrength, StreamStatus
from rtkmesh_services.ingest.links import Chunk

TOLD: Final = 64  # kinds of frames, or reasons, that a status tells one by one: it has to fit into a message
_MAX_KINDS: Final = 500
_WINDOW_NS: Final = 10_000_000_000  # that rates are taken over
_KEPT_NS: Final = 400_000_000  # a status is made anew after this time only
_OTHER: Final = "other"

Kind = tuple[str, str]  # protocol and kind of a frame


class SourceFigures:
    """The figures of one source. ``known``: a configured position of the antenna, which replaces what the stream says."""

    def __init__(self, known: tuple[float, float, float] | None = None) -> None:
        self._known = known
        self._frames: dict[Kind, list[int]] = {}  # (protocol, kind): count, newest instant
        self._bytes = self._epochs = 0
        self._epoch: Epoch | None = None
        self._epoch_ns = 0
        self._station = ReferenceStation(station_id=0), 0
        self._past: deque[tuple[int, int, int, dict[Kind, int]]] = deque()
        self._made: tuple[int, StreamStatus] | None = None

    def chunk(self, chunk: Chunk, frames: list[tuple[Frame, list[Message]]]) -> None:
        """Take note of bytes that came, and of what was in them."""
        self._bytes += len(chunk.data)
        for frame, messages in frames:
            self.frame(frame, chunk.mono_ns)
            for message in messages:
                self.message(message, chunk.mono_ns)

    def frame(self, frame: Frame, mono_ns: int) -> None:
        """Take note of a whole frame."""
        entry = self._frames.get(frame[:2])
        if entry is None:
            key = frame[:2] if len(self._frames) < _MAX_KINDS else (frame.protocol, _OTHER)
            entry = self._frames.setdefault(key, [0, 0])
        entry[0] += 1
        entry[1] = mono_ns

    def replayed(self, frame: Frame, mono_ns: int) -> None:
        """Take note of a whole frame of a recording."""
        self._bytes += len(frame.data)
        self.frame(frame, mono_ns)

    def message(self, message: Message, mono_ns: int) -> None:
        """Take note of a decoded message."""
        if isinstance(message, Epoch):
            self._epochs += 1
            self._epoch, self._epoch_ns = message, mono_ns
        elif isinstance(message, ReferenceStation):
            self._station = message, mono_ns

    def status(self, now_ns: int, framing: FramingCounters, decoding: DecodingCounters) -> StreamStatus:
        """Return the figures; what the framer and the decoders of the source have refused goes into them."""
        if self._made is not None and 0 <= now_ns - self._made[0] < _KEPT_NS:
            return self._made[1]
        then_ns, bytes_then, epochs_then, frames_then = self._remember(now_ns)
        span_s = (now_ns - then_ns) * 1e-9
        per_s = 1.0 / span_s if span_s > 0.0 else 0.0
        epoch = self._epoch
        status = StreamStatus(
            bytes_per_s=(self._bytes - bytes_then) * per_s,
            frames=self._frame_figures(now_ns, frames_then, per_s),
            checksum_failures=told(framing.checksum_failures),
            bytes_skipped=framing.bytes_skipped,
            refused=told(decoding.rejected),
            epochs=self._epochs,
            epochs_per_s=(self._epochs - epochs_then) * per_s,
            epoch_age_s=None if epoch is None else (now_ns - self._epoch_ns) * 1e-9,
            satellites={} if epoch is None else satellites_of(epoch),
            signals=[] if epoch is None else signals_of(epoch),
            cn0_dbhz={} if epoch is None else strengths_of(epoch),
            reference=self._reference(now_ns),
        )
        self._made = now_ns, status
        return status

    def _remember(self, now_ns: int) -> tuple[int, int, int, dict[Kind, int]]:
        """Keep how far the counts are, and return how far they were at the beginning of the window."""
        self._past.append((now_ns, self._bytes, self._epochs, {key: entry[0] for key, entry in self._frames.items()}))
        while len(self._past) > 2 and now_ns - self._past[1][0] >= _WINDOW_NS:
            self._past.popleft()
        return self._past[0]

    def _frame_figures(self, now_ns: int, then: Mapping[Kind, int], per_s: float) -> dict[str, FrameFigures]:
        first = sorted(self._frames.items(), key=lambda item: -item[1][0])[:TOLD]
        return {
            f"{protocol}/{kind}": FrameFigures(
                count=count, age_s=(now_ns - newest_ns) * 1e-9, per_s=(count - then.get((protocol, kind), 0)) * per_s
            )
            for (protocol, kind), (count, newest_ns) in sorted(first)
        }

    def _reference(self, now_ns: int) -> ReferenceStatus | None:
        """Return where the antenna stands, who says so, and how long ago it was said last."""
        if self._known is not None:
            return ReferenceStatus(position_ecef_m=self._known, origin="configuration")
        station, changed_ns = self._station
        if station.position_ecef_m is None:
            return None
        said_ns = [entry[1] for (_, kind), entry in self._frames.items() if kind in ("1005", "1006")]  # repeated ones are no messages
        age_s = (now_ns - max([changed_ns, *said_ns])) * 1e-9
        return ReferenceStatus(position_ecef_m=station.position_ecef_m, origin=station.source, station_id=station.station_id, age_s=age_s)


def told(counter: Counter[str]) -> dict[str, int]:
    """Return the most frequent of a counter, and all the others as one."""
    first = {str(name): count for name, count in counter.most_common(TOLD) if count}
    others = counter.total() - sum(first.values())
    return {**first, _OTHER: others} if others else first


def satellites_of(epoch: Epoch) -> dict[str, int]:
    """Return the number of satellites by system."""
    systems = Counter(satellite // SATELLITES_PER_SYSTEM for satellite in set(epoch.satellite.tolist()))
    return {SYSTEMS[system]: count for system, count in sorted(systems.items())}


def signals_of(epoch: Epoch) -> list[str]:
    """Return the RINEX codes of the epoch's signals, each with the letter of its system."""
    pairs = {(s // SATELLITES_PER_SYSTEM, code) for s, code in zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True)}
    return sorted(f"{SYSTEMS[system]}{signal_code(code)}" for system, code in pairs)


def strengths_of(epoch: Epoch) -> dict[str, SignalStrength]:
    """Return C/N0 by frequency band (the digit of the RINEX codes); signals that say none are left out."""
    bands: dict[str, list[float]] = {}
    for signal, cn0 in zip(epoch.signal.tolist(), epoch.cn0_dbhz.tolist(), strict=True):
        if 0.0 < cn0 < 100.0:
            bands.setdefault(signal_code(signal)[0], []).append(cn0)
    return {
        band: SignalStrength(mean=round(sum(values) / len(values), 1), minimum=round(min(values), 1), count=len(values))
        for band, values in sorted(bands.items())
    }
