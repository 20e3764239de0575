"""Whole, checksum-verified frames out of a mixed byte stream of UBX, RTCM 3 and NMEA 0183.

Rules of this file: the frames depend only on the bytes, never on how they were cut into pieces; a false or damaged frame costs
one byte (the next candidate is searched from the byte after its first), so it never takes a good frame with it; nothing raises;
what is held back is bounded by the longest frame of the protocols.
"""

from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh._jit import kernel
from rtkmesh.codecs.checksums import crc24q_range, fletcher16_range
from rtkmesh.codecs.messages import Frame, FramingCounters, Protocol

FRAMED: Final = (Protocol.UBX, Protocol.RTCM3, Protocol.NMEA)  # the order is the kernels' numbering
_UBX, _RTCM3, _NMEA = 0, 1, 2

UBX_OVERHEAD: Final = 8
UBX_MAX_PAYLOAD: Final = 8192  # RXM-RAWX of 255 measurements has 8176; bounds the wait for a false header
RTCM3_OVERHEAD: Final = 6
NMEA_MAX_LENGTH: Final = 1024  # the standard says 82; proprietary sentences (PUBX,03) exceed 600

# What a candidate is (negative: not a whole frame).
_NO_FRAME, _NEEDS_MORE, _BAD_CHECKSUM = -1, -2, -3

_NMEA_ADDRESS, _MAX_KINDS = 8, 1000  # longest address, and number of kinds, that get a counter of their own

_RTCM3_KEYS = 1 << 16  # behind the keys of UBX: class * 256 + id

_BATCH = 512  # frames per call of the scan kernel
_new: Final = tuple[Protocol | str | bytes, ...].__new__  # takes half the time of the constructor of a named tuple


@kernel
def ubx_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the UBX frame at ``start`` (its first byte is B5), or why there is none."""
    if start + 2 > end:
        return _NEEDS_MORE
    if data[start + 1] != 0x62:
        return _NO_FRAME
    if start + 6 > end:
        return _NEEDS_MORE
    payload = int(data[start + 4]) | int(data[start + 5]) << 8
    if payload > UBX_MAX_PAYLOAD:
        return _NO_FRAME
    stop = start + payload + UBX_OVERHEAD
    if stop > end:
        return _NEEDS_MORE
    sent = int(data[stop - 2]) | int(data[stop - 1]) << 8
    return stop - start if fletcher16_range(data, start + 2, stop - 2) == sent else _BAD_CHECKSUM


@kernel
def rtcm3_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the RTCM 3 frame at ``start`` (its first byte is D3), or why there is none (RTCM 10403.3, 4)."""
    if start + 2 > end:
        return _NEEDS_MORE
    if data[start + 1] & 0xFC:
        return _NO_FRAME
    if start + 3 > end:
        return _NEEDS_MORE
    stop = start + (int(data[start + 1]) << 8 | int(data[start + 2])) + RTCM3_OVERHEAD
    if stop > end:
        return _NEEDS_MORE
    sent = int(data[stop - 3]) << 16 | int(data[stop - 2]) << 8 | int(data[stop - 1])
    return stop - start if crc24q_range(data, start, stop - 3) == sent else _BAD_CHECKSUM


def _hex_table() -> NDArray[np.int64]:
    """Return the values of hexadecimal digits by ASCII character, 256 where there is none."""
    table = np.full(256, 256, np.int64)
    for value, character in enumerate("0123456789ABCDEF"):
        table[ord(character)] = table[ord(character.lower())] = value
    return table


_HEX = _hex_table()


@kernel
def nmea_candidate(data: bytes, start: int, end: int) -> int:
    """Return the length of the NMEA sentence at ``start`` (its first byte is ``$``), or why there is none.

    ``$...*hh`` and CR LF (a lone LF is accepted), printable ASCII, checksum obligatory.
    """
    star, check = start + 1, 0
    while True:
        if star >= start + NMEA_MAX_LENGTH:
            return _NO_FRAME
        if star >= end:
            return _NEEDS_MORE
        character = int(data[star])
        if character == 42:
            break
        if character < 32 or character > 126 or character == 36:
            return _NO_FRAME
        check ^= character  # NMEA 0183 5.2.2
        star += 1
    stop = star + 3
    if end > stop and data[stop] == 13:
        stop += 1
    if end <= stop:
        return _NEEDS_MORE
    high, low = int(_HEX[data[star + 1]]), int(_HEX[data[star + 2]])
    if data[stop] != 10 or high > 15 or low > 15:
        return _NO_FRAME
    return stop + 1 - start if check == high * 16 + low else _BAD_CHECKSUM


@kernel
def scan_frames(
    data: bytes, start: int, final: bool, protocols: int, found: NDArray[np.int64], failures: NDArray[np.int64]
) -> tuple[int, int, int]:
    """Find whole frames from ``start`` on.

    ``protocols`` is a mask of the protocols looked for; ``found`` is filled with frames (rows: start, end, key),
    ``failures`` counts failed checksums by protocol. With ``final`` no candidate waits for more bytes. Returns the number of
    frames, the first byte not decided yet, and the number of bytes that belong to no frame.
    """
    end, position, count, skipped = len(data), start, 0, 0
    while position < end and count < len(found):
        head = data[position]
        length, protocol = _NO_FRAME, 0
        if head == 0xB5 and protocols & 1:
            length, protocol = ubx_candidate(data, position, end), _UBX
        elif head == 0xD3 and protocols & 2:
            length, protocol = rtcm3_candidate(data, position, end), _RTCM3
        elif head == 36 and protocols & 4:
            length, protocol = nmea_candidate(data, position, end), _NMEA
        if length > 0:
            key = -position
            if protocol == _UBX:
                key = int(data[position + 2]) << 8 | int(data[position + 3])
            elif protocol == _RTCM3:
                number = int(data[position + 3]) << 4 | int(data[position + 4]) >> 4
                key = _RTCM3_KEYS + (number if length > RTCM3_OVERHEAD + 1 else 0)
            else:
                while data[-key] != 44 and data[-key] != 42:
                    key -= 1
            found[count, 0], found[count, 1], found[count, 2] = position, position + length, key
            count += 1
            position += length
            continue
        if length == _NEEDS_MORE and not final:
            break
        if length == _BAD_CHECKSUM:
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
        self._found = np.zeros((_BATCH, 3), np.int64)
        self._failures = np.zeros(len(FRAMED), np.int64)
        self._kinds: dict[bytes | int, tuple[Protocol, str, str]] = {}

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
                self.counters.checksum_failures[protocol] += failures
            self._failures[:] = 0

    def _append_frames(self, frames: list[Frame], data: bytes, found: list[list[int]]) -> None:
        kinds = self._kinds
        seen: list[str] = []
        for start, end, key in found:
            name: bytes | int = key if key >= 0 else data[start + 1 : -key]
            protocol, kind, label = kinds.get(name) or self._name(name)
            seen.append(label)
            frames.append(_new(Frame, (protocol, kind, data[start:end])))
        self.counters.frames.update(seen)

    def _name(self, key: bytes | int) -> tuple[Protocol, str, str]:
        """Return the kind of a message and its name in the counters (the odd ones share one: a hostile stream must not fill memory)."""
        odd = len(self._kinds) >= _MAX_KINDS
        if isinstance(key, bytes):
            protocol, kind, odd = Protocol.NMEA, key.decode("ascii"), odd or len(key) > _NMEA_ADDRESS
        elif key >= _RTCM3_KEYS:
            protocol, kind = Protocol.RTCM3, str(key - _RTCM3_KEYS)
        else:
            protocol, kind = Protocol.UBX, f"{key >> 8:02x}-{key & 255:02x}"
        if odd:
            return protocol, kind, f"{protocol}/other"
        self._kinds[key] = protocol, kind, f"{protocol}/{kind}"
        return self._kinds[key]
