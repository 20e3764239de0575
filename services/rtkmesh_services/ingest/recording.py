"""Recordings on disk as streams of engine messages: RINEX, Hatanaka, UBX, RTCM 3 and mixed raw logs, each also compressed.

The kind is found from the content, never from the name. Raw logs are read in pieces of any size, RINEX files at once.
"""

import warnings
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import BinaryIO, Final

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import DecodingCounters, Frame, FramingCounters, Message, Protocol
from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.errors import FormatError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.errors import SourceError
from rtkmesh_services.runtime.time_tags import TimeTags, parse_tag, parse_times

_GZIP: Final = b"\x1f\x8b"
_COMPRESSED: Final = (b"\x1f\x9d", b"BZh", b"PK\x03\x04")  # LZW (.Z), bzip2, zip
_RINEX_LABEL: Final = b"RINEX VERSION / TYPE"
_HATANAKA_LABEL: Final = b"CRINEX VERS   / TYPE"
_LABEL_COLUMN: Final = 60
_GZIP_FORMAT: Final = 31  # zlib: gzip members with the largest window
_HEAD: Final = 1 << 18  # bytes that the kind of a raw log is found from
_CHUNK: Final = 1 << 16


class RecordingKind(StrEnum):
    """What a recording holds."""

    OBSERVATIONS = "rinex observations"
    NAVIGATION = "rinex navigation"
    UBX = "ubx"
    RTCM3 = "rtcm3"
    NMEA = "nmea"
    UNICORE = "unicore"
    NOVATEL = "novatel"
    SBF = "sbf"
    MIXED = "mixed log"


class Recording(ABC):
    """One recording: ``messages`` yields its engine messages in stream order, once.

    ``position`` of ``size`` bytes have been read (of the file as it is on disk where that can be told).
    """

    def __init__(self, path: Path, kind: RecordingKind, size: int, file: BinaryIO | None = None) -> None:
        self.path, self.kind, self.size = path, kind, size
        self._file = file

    @property
    @abstractmethod
    def position(self) -> int:
        """Bytes read so far."""

    @abstractmethod
    def messages(self) -> Iterator[Message]:
        """Yield the engine messages in stream order."""

    def parts(self) -> Iterator[tuple[Frame | None, list[Message]]]:
        """Yield each frame with its messages; text has no frames."""
        for message in self.messages():
            yield None, [message]

    def timed_parts(self) -> Iterator[tuple[GpsTime | None, Frame | None, list[Message]]]:
        """Yield each frame with its messages and, where it was recorded, when its last byte came (by the recording host's clock)."""
        for frame, messages in self.parts():
            yield None, frame, messages

    def begin(self) -> GpsTime | None:
        """Return the instant with which a replay begins: of the first bytes where that was recorded, else of the first epoch."""
        with closing(self):
            return next((message.time for message in self.messages() if isinstance(message, Epoch)), None)

    @property
    @abstractmethod
    def decoding(self) -> DecodingCounters:
        """What was decoded, ignored and rejected so far."""

    def close(self) -> None:
        """Give the file back; needed only where ``messages`` was not read to its end."""
        if self._file is not None:
            self._file.close()


class RawRecording(Recording):
    """A log of a receiver's bytes."""

    def __init__(self, path: Path, kind: RecordingKind, opened: "_Opened", options: StreamOptions) -> None:
        super().__init__(path, kind, path.stat().st_size, opened.file)
        self._opened = opened
        self._decoder = StreamDecoder(options)

    @property
    def position(self) -> int:
        """Bytes of the file on disk that have been read."""
        return self._opened.file.tell() if not self._opened.file.closed else self.size

    @property
    def decoding(self) -> DecodingCounters:
        """What was decoded, ignored and rejected so far."""
        counters = self._decoder.decoding
        if self._opened.damage:
            counters.rejected[self._opened.damage] += 1
        return counters

    @property
    def framing(self) -> FramingCounters:
        """Frames, failed checksums and skipped bytes so far."""
        return self._decoder.framing

    def chunks(self, size: int = _CHUNK) -> Iterator[bytes]:
        """Yield the bytes of the log from its beginning, at most ``size`` at a time, as far as its compression is whole."""
        with self._opened.file:
            yield from self._opened.chunks(size)

    def messages(self) -> Iterator[Message]:
        """Yield the engine messages in stream order."""
        for chunk in self.chunks():
            for _, messages in self._decoder.feed(chunk):
                if messages:  # most frames have none
                    yield from messages
        yield from self._decoder.flush()

    def parts(self) -> Iterator[tuple[Frame | None, list[Message]]]:
        """Yield each whole frame with its messages, at the end what was left unfinished."""
        for chunk in self.chunks():
            yield from self._decoder.feed(chunk)
        yield None, self._decoder.flush()


class TimedRecording(RawRecording):
    """A log whose bytes are played as they came: in the pieces and at the instants that its time tags say."""

    def __init__(self, path: Path, kind: RecordingKind, opened: "_Opened", options: StreamOptions, tags: TimeTags) -> None:
        super().__init__(path, kind, opened, options)
        self._tags = tags

    def timed_parts(self) -> Iterator[tuple[GpsTime | None, Frame | None, list[Message]]]:
        """Yield each frame with its messages and the instant of its last byte."""
        time = self._tags.start
        for time, piece in self.pieces():
            for frame, messages in self._decoder.feed(piece):
                yield time, frame, messages
        yield time, None, self._decoder.flush()

    def pieces(self) -> Iterator[tuple[GpsTime, bytes]]:
        """Yield the bytes of the log with their instants; what no tag speaks of came with the last one."""
        tags, read = self._tags, 0
        with self._opened.file as file:
            file.seek(0)
            for index, offset in enumerate(tags.offsets):
                if offset > read and (data := file.read(offset - read)):
                    read += len(data)
                    yield tags.time(index), data
            while data := file.read(_CHUNK):
                yield tags.time(-1), data

    def begin(self) -> GpsTime | None:
        """Return the instant of the first bytes."""
        self.close()
        first = next((index for index, offset in enumerate(self._tags.offsets) if offset), None)
        return None if first is None else self._tags.time(first)


class ObservationRecording(Recording):
    """A RINEX observation file: its station first, then its epochs."""

    def __init__(self, path: Path, text: bytes) -> None:
        super().__init__(path, RecordingKind.OBSERVATIONS, len(text))
        self._reader = ObservationReader(text)

    @property
    def position(self) -> int:
        """Bytes of the uncompressed text that have been read."""
        return self._reader.position

    @property
    def decoding(self) -> DecodingCounters:
        """What was decoded, ignored and rejected so far."""
        return self._reader.counters

    def messages(self) -> Iterator[Message]:
        """Yield the station, then the epochs."""
        yield self._reader.header.station()
        yield from self._reader


class NavigationRecording(Recording):
    """A RINEX navigation file: ionosphere first, then the ephemerides."""

    def __init__(self, path: Path, text: bytes) -> None:
        super().__init__(path, RecordingKind.NAVIGATION, len(text))
        self._content = read_navigation(text)
        self._read = 0

    @property
    def position(self) -> int:
        """All, as soon as messages were asked for."""
        return self._read

    @property
    def decoding(self) -> DecodingCounters:
        """What was decoded, ignored and rejected."""
        return self._content.counters

    def messages(self) -> Iterator[Message]:
        """Yield ionosphere parameters, then ephemerides in the order of the file."""
        self._read = self.size
        yield from self._content.klobuchar
        yield from self._content.ephemerides


class _Opened:
    """A file and its uncompressed bytes, as far as they can be had: a log that was cut short is read up to its end.

    ``damage`` says after reading what is wrong with the compression.
    """

    def __init__(self, path: Path) -> None:
        try:
            self.file = path.open("rb")
        except IsADirectoryError as error:
            raise SourceError(f"{path} is a folder, not a recording") from error
        except FileNotFoundError as error:
            raise SourceError(f"{path} does not exist") from error
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror}") from error
        self.damage = ""
        self._compressed = self.file.read(2) == _GZIP

    def chunks(self, size: int) -> Iterator[bytes]:
        """Yield the uncompressed bytes from the beginning, at most ``size`` at a time."""
        self.file.seek(0)
        if self._compressed:
            yield from self._inflated(size)
            return
        while data := self.file.read(size):
            yield data

    def head(self, size: int) -> bytes:
        """Return the first uncompressed bytes."""
        data = b""
        for chunk in self.chunks(size):
            data += chunk
            if len(data) >= size:
                break
        return data

    def _inflated(self, size: int) -> Iterator[bytes]:
        """Yield what the members of a gzip file hold (RFC 1952)."""
        inflater, packed = zlib.decompressobj(_GZIP_FORMAT), b""
        self.damage = ""
        while packed := packed or self.file.read(_CHUNK):
            try:
                data = inflater.decompress(packed, size)
            except zlib.error:
                self.damage = "file/damaged compression"
                return
            packed = inflater.unconsumed_tail
            if data:
                yield data
            if inflater.eof:
                packed = inflater.unused_data.lstrip(b"\0") or self.file.read(_CHUNK)
                if not packed.startswith(_GZIP):  # padding
                    return
                inflater = zlib.decompressobj(_GZIP_FORMAT)
        self.damage = "file/compression cut short"


def open_recording(path: Path, date: GpsTime | None = None, *, options: StreamOptions | None = None, timed: bool = False) -> Recording:
    """Return the recording at ``path``, opened for reading; ``timed``: with the instants of arrival that are recorded beside it.

    ``date`` (within three days of its beginning) settles the week of RTCM 3 logs, which carry none. SourceError if the file
    is missing, empty, damaged, or of no known kind.
    """
    opened = _Opened(path)
    try:
        head = opened.head(_HEAD)
        if not head:
            raise SourceError(f"{path} is empty" if not opened.damage else f"{path}: {opened.damage}")
        if head.startswith(_COMPRESSED) or _label(head) in (_RINEX_LABEL, _HATANAKA_LABEL):
            return _text_recording(path, opened)
        kind = _kind_of_log(head)
        if kind is None:
            kinds = "UBX, RTCM 3, SBF, Unicore, NovAtel or NMEA"
            raise SourceError(f"{path} is no recording of a known kind: no RINEX header, and no frame of {kinds} in its beginning")
    except BaseException:
        opened.file.close()
        raise
    options = options or StreamOptions(approximate_time=date)
    if not timed:
        return RawRecording(path, kind, opened, options)
    try:
        return TimedRecording(path, kind, opened, options, _tags_of(path))
    except BaseException:
        opened.file.close()
        raise


def _tags_of(path: Path) -> TimeTags:
    """Return the time tags of a log: RTKLIB's PATH.tag, or our recorder's PATH.times."""
    beside = {ending: path.with_name(path.name + ending) for ending in (".tag", ".times")}
    found = next((ending for ending, file in beside.items() if file.is_file()), None)
    if found is None:
        raise SourceError(f"{path}: there is neither {beside['.tag'].name} nor {beside['.times'].name} with the times of arrival")
    content = beside[found].read_bytes()
    tags = parse_tag(content, path.stat().st_size) if found == ".tag" else parse_times(content)
    if tags is None or not tags.offsets:
        raise SourceError(f"{beside[found]} holds no times of this log")
    return tags


def _label(head: bytes) -> bytes:
    return head[_LABEL_COLUMN : _LABEL_COLUMN + 20]


def _text_recording(path: Path, opened: _Opened) -> Recording:
    """Return the recording of a RINEX file, of Hatanaka text, or of either in LZW, bzip2 or zip."""
    with opened.file:
        text = b"".join(opened.chunks(_CHUNK))
    if _label(text) != _RINEX_LABEL:
        text = _decompressed(path, text)
    try:
        recording = ObservationRecording(path, text) if text[20:21] == b"O" else NavigationRecording(path, text)
    except FormatError as error:
        raise SourceError(f"{path}: {error}") from error
    if opened.damage:
        recording.decoding.rejected[opened.damage] += 1
    return recording


def _decompressed(path: Path, content: bytes) -> bytes:
    import hatanaka  # noqa: PLC0415  0.15 s that plain recordings need not pay

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a log cut short is read as far as it goes
            text = hatanaka.decompress(content, skip_strange_epochs=True)
    except (hatanaka.HatanakaException, ValueError, OSError, EOFError, zlib.error) as error:
        raise SourceError(f"{path}: {str(error).strip() or 'cannot be uncompressed'}") from error
    if _label(text) != _RINEX_LABEL:
        raise SourceError(f"{path} holds no RINEX file")
    return text


def _kind_of_log(head: bytes) -> RecordingKind | None:
    """Return the kind of a raw log from the whole frames in its head, None if there are none."""
    framer = Framer()
    protocols = {frame.protocol for frame in (*framer.feed(head), *framer.flush())} - {Protocol.NMEA}
    if protocols:
        return RecordingKind(protocols.pop().value) if len(protocols) == 1 else RecordingKind.MIXED
    return RecordingKind.NMEA if any(key.startswith("nmea") for key in framer.counters.frames) else None
