"""Whole, checksum-verified frames out of a mixed byte stream of UBX, RTCM 3, NMEA 0183, Unicore's and NovAtel's logs, SBF.

Rules of this file: the frames depend only on the bytes, never on how they were cut into pieces; a false or damaged frame costs
one byte (the next candidate is searched from the byte after its first), so it never takes a good frame with it; nothing raises;
what is held back is bounded by the longest frame of the protocols.
"""

from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.candidates import BAD_CHECKSUM, NEEDS_MORE, NO_FRAME, hex_value
from rtkmesh.codecs.checksums import crc24q_range, fletcher16_range
from rtkmesh.codecs.framing_novatel import NOVATEL_LOGS, novatel_candidate
from rtkmesh.codecs.framing_sbf import SBF_SECOND, sbf_candidate, sbf_number
from rtkmesh.codecs.framing_unicore import (
    ASCII_LOG_MAX_LENGTH,
    UNICORE_LOGS,
    UNICORE_THIRD,
    ascii_log_candidate,
    is_novatel_log,
    unicore_candidate,
)
from rtkmesh.codecs.messages import Frame, FramingCounters, Protocol

# The order is the numbering of the kernels, and of the bits of their masks.
FRAMED: Final = (Protocol.UBX, Protocol.RTCM3, Protocol.NMEA, Protocol.UNICORE, Protocol.NOVATEL, Protocol.SBF)
_UBX, _RTCM3, _NMEA, _UNICORE, _NOVATEL, _SBF = range(6)

UBX_OVERHEAD: Final = 8
UBX_MAX_PAYLOAD: Final = 8192  # RXM-RAWX of 255 measurements has 8176; bounds the wait for a false header
RTCM3_OVERHEAD: Final = 6
NMEA_MAX_LENGTH: Final = 1024  # the standard says 82; proprietary sentences (PUBX,03) exceed 600

LONGEST_FRAME: Final = ASCII_LOG_MAX_LENGTH  # of all protocols: no more is held back

_NAME_LENGTH, _MAX_KINDS = 16, 1000  # longest name of a sentence or log, and number of kinds, that get a counter of their own

_BATCH = 512  # frames per call of the scan kernel
_new: Final = tuple[Protocol | str | bytes, ...].__new__  # takes half the time of the constructor of a named tuple


@kernel
def ubx_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the UBX frame at ``start`` (its first byte is B5), or why there is none."""
    if start + 2 > end:
        return NEEDS_MORE
    if data[start + 1] != 0x62:
        return NO_FRAME
    if start + 6 > end:
        return NEEDS_MORE
    payload = int(data[start + 4]) | int(data[start + 5]) << 8
    if payload > UBX_MAX_PAYLOAD:
        return NO_FRAME
    stop = start + payload + UBX_OVERHEAD
    if stop > end:
        return NEEDS_MORE
    sent = int(data[stop - 2]) | int(data[stop - 1]) << 8
    return stop - start if fletcher16_range(data, start + 2, stop - 2) == sent else BAD_CHECKSUM


@kernel
def rtcm3_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the RTCM 3 frame at ``start`` (its first byte is D3), or why there is none (RTCM 10403.3, 4)."""
    if start + 2 > end:
        return NEEDS_MORE
    if data[start + 1] & 0xFC:
        return NO_FRAME
    if start + 3 > end:
        return NEEDS_MORE
    stop = start + (int(data[start + 1]) << 8 | int(data[start + 2])) + RTCM3_OVERHEAD
    if stop > end:
        return NEEDS_MORE
    sent = int(data[stop - 3]) << 16 | int(data[stop - 2]) << 8 | int(data[stop - 1])
    return stop - start if crc24q_range(data, start, stop - 3) == sent else BAD_CHECKSUM


@kernel
def nmea_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the NMEA sentence at ``start`` (its first byte is ``$``), or why there is none.

    ``$...*hh`` and CR LF (a lone LF is accepted), printable ASCII, checksum obligatory.
    """
    star, check = start + 1, 0
    while True:
        if star >= start + NMEA_MAX_LENGTH:
            return NO_FRAME
        if star >= end:
            return NEEDS_MORE
        character = int(data[star])
        if character == 42:
            break
        if character < 32 or character > 126 or character == 36:
            return NO_FRAME
        check ^= character  # NMEA 0183 5.2.2
        star += 1
    stop = star + 3
    if end > stop and data[stop] == 13:
        stop += 1
    if end <= stop:
        return NEEDS_MORE
    sent = hex_value(data, star + 1, 2)
    if data[stop] != 10 or sent < 0:
        return NO_FRAME
    return stop + 1 - start if check == sent else BAD_CHECKSUM


@kernel
def candidate_at(data: bytes, start: int, end: int, protocols: int) -> tuple[int, int]:
    """Return the length of the frame at ``start`` (or why there is none) and the number of its protocol, one of the mask ``protocols``."""
    head = data[start]
    if head == 0xB5 and protocols & 1 << _UBX:
        return ubx_candidate(data, start, end), _UBX
    if head == 0xD3 and protocols & 1 << _RTCM3:
        return rtcm3_candidate(data, start, end), _RTCM3
    if head == 36 and protocols & 1 << _SBF and (start + 1 == end or data[start + 1] == SBF_SECOND):
        return sbf_candidate(data, start, end), _SBF
    if head == 36 and protocols & 1 << _NMEA:
        return nmea_candidate(data, start, end), _NMEA
    if head == 0xAA and protocols & 1 << _NOVATEL and (start + 3 > end or data[start + 2] != UNICORE_THIRD):
        return novatel_candidate(data, start, end), _NOVATEL
    if head == 0xAA and protocols & 1 << _UNICORE:
        return unicore_candidate(data, start, end), _UNICORE
    if head == 35 and protocols & (1 << _UNICORE | 1 << _NOVATEL):
        length = ascii_log_candidate(data, start, end)
        protocol = _NOVATEL if length > 0 and is_novatel_log(data, start) else _UNICORE
        return length if protocols & 1 << protocol or length < 0 else NO_FRAME, protocol
    return NO_FRAME, 0


@kernel
def key_of(data: bytes, start: int, length: int, protocol: int) -> int:
    """Return what tells the kind of a whole frame: a number of its protocol's, or minus the end of its name where it is text."""
    head = data[start]
    if protocol == _SBF:
        return sbf_number(data, start)
    if head == 36 or head == 35:
        end = start
        while data[end] != 44 and data[end] != 42:
            end += 1
        return -end
    if protocol == _UBX:
        return int(data[start + 2]) << 8 | int(data[start + 3])
    if protocol == _RTCM3:
        return int(data[start + 3]) << 4 | int(data[start + 4]) >> 4 if length > RTCM3_OVERHEAD + 1 else 0
    return int(data[start + 4]) | int(data[start + 5]) << 8


@kernel
def scan_frames(
    data: bytes, start: int, final: bool, protocols: int, found: NDArray[np.int64], failures: NDArray[np.int64]
) -> tuple[int, int, int]:
    """Find whole frames from ``start`` on.

    ``protocols`` is a mask of the protocols looked for; ``found`` is filled with frames (rows: start, end, key, protocol),
    ``failures`` counts failed checksums by protocol. With ``final`` no candidate waits for more bytes. Returns the number of
    frames, the first byte not decided yet, and the number of bytes that belong to no frame.
    """
    end, position, count, skipped = len(data), start, 0, 0
    while position < end and count < len(found):
        length, protocol = candidate_at(data, position, end, protocols)
        if length > 0:
            found[count, 0], found[count, 1], found[count, 3] = position, position + length, protocol
            found[count, 2] = key_of(data, position, length, protocol)
            count += 1
            position += length
            continue
        if length == NEEDS_MORE and not final:
            break
        if length == BAD_CHECKSUM:
            failures[protocol] += 1
        position += 1
        skipped += 1
    return count, position, skipped


class Framer:
    """Cuts a byte stream into frames. ``flush`` at the end of the stream gives what an unfinished candidate was hiding."""

    def __init__(self, protocols: Collection[Protocol] = FRAMED) -> None:
        self.counters = FramingCounters()
        self._mask = sum(1 << index for index, protocol in enumerate(FRAMED) if protocol in protocols)
        self._pending = b""
        self._found = np.zeros((_BATCH, 4), np.int64)
        self._failures = np.zeros(len(FRAMED), np.int64)
        self._kinds: list[dict[bytes | int, tuple[Protocol, str, str]]] = [{} for _ in FRAMED]

    @property
    def pending(self) -> int:
        """Number of bytes held back until it is known what they are."""
        return len(self._pending)

    def feed(self, data: bytes) -> list[Frame]:
        """Return the frames that are whole with these further bytes."""
        self.counters.bytes_in += len(data)
        return self._scan(self._pending + data if self._pending else data, final=False)

    def flush(self) -> list[Frame]:
        """End the stream: return the frames behind an unfinished candidate, and forget the rest."""
        return self._scan(self._pending, final=True)

    def _scan(self, data: bytes, *, final: bool) -> list[Frame]:
        frames: list[Frame] = []
        position, all_skipped = 0, 0
        while True:
            count, position, skipped = scan_frames(data, position, final, self._mask, self._found, self._failures)
            all_skipped += skipped
            if count:
                self._append_frames(frames, data, self._found[:count].tolist())
            if count < _BATCH:
                break
        self._pending = data[position:]
        if all_skipped:  # what fails its checksum skips a byte
            self.counters.bytes_skipped += all_skipped
            self._count_failures()
        return frames

    def _count_failures(self) -> None:
        if self._failures.any():
            for protocol, failures in zip(FRAMED, self._failures.tolist(), strict=True):
                if failures:
                    self.counters.checksum_failures[protocol] += failures
            self._failures[:] = 0

    def _append_frames(self, frames: list[Frame], data: bytes, found: list[list[int]]) -> None:
        kinds = self._kinds
        seen: list[str] = []
        for start, end, key, number in found:
            name: bytes | int = key if key >= 0 else data[start + 1 : -key]
            protocol, kind, label = kinds[number].get(name) or self._name(number, name)
            seen.append(label)
            frames.append(_new(Frame, (protocol, kind, data[start:end])))
        self.counters.frames.update(seen)

    def _name(self, number: int, key: bytes | int) -> tuple[Protocol, str, str]:
        """Return the kind of a message and its name in the counters (the odd ones share one: a hostile stream must not fill memory)."""
        protocol, kinds = FRAMED[number], self._kinds[number]
        kind = key.decode("ascii") if isinstance(key, bytes) else _numbered_kind(number, key)
        if len(kind) > _NAME_LENGTH or len(kinds) > _MAX_KINDS:
            return protocol, kind, f"{protocol}/other"
        kinds[key] = protocol, kind, f"{protocol}/{kind}"
        return kinds[key]


def _numbered_kind(number: int, key: int) -> str:
    """Return the kind of a message that has a number."""
    if number == _UBX:
        return f"{key >> 8:02x}-{key & 255:02x}"
    names = {_UNICORE: UNICORE_LOGS, _NOVATEL: NOVATEL_LOGS}.get(number, {})
    return f"{names[key]}B" if key in names else str(key)
