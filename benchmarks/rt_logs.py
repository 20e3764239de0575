"""Receivers' logs cut into epochs for ``rt_load``: bytes up to the end of each observation, with its time. Runs with numpy alone."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rt_judgement import WEEK

Vector = NDArray[np.float64]

LEAP_S: Final = 18  # GPS - UTC, for logs of 2017 and later
_GPS_UNIX_S: Final = 315964800  # begin of GPS time on the clock of Unix
_DAY_S: Final = 86400
_RAWX: Final = 0x0215
# Where RTCM ephemerides have their week (bit, width), and how many bits their satellite number has.
_WEEK_FIELDS: Final = {1019: (18, 10), 1044: (446, 10), 1042: (18, 13), 1045: (18, 12), 1046: (18, 12)}
_SATELLITE_BITS: Final = {1019: 6, 1020: 6, 1042: 6, 1044: 4, 1045: 6, 1046: 6}


class Log(NamedTuple):
    """Format; GPS times (s, continuous); bytes up to the end of each of these epochs; the first ephemeris frames of all satellites."""

    format: str
    times: Vector
    chunks: list[bytes]
    prime: bytes


def load_log(path: str, fmt: str = "auto", redate: bool = False) -> Log:
    """Cut a log into epochs. ``redate``: move the weeks of RTCM ephemerides so that the log lies within half a week of today."""
    data = Path(path).read_bytes()
    if fmt == "auto":
        fmt = "ubx" if any(kind == _RAWX for _, _, kind in ubx_frames(data[:200000])) else "rtcm3"
    return _load_ubx(data) if fmt == "ubx" else _load_rtcm(data, fmt, redate)


# --- UBX ---


def ubx_frames(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (start, end, class << 8 | id) of every whole frame with a right checksum."""
    i, n = 0, len(data)
    while (i := data.find(b"\xb5\x62", i)) >= 0 and i + 8 <= n:
        size = int.from_bytes(data[i + 4 : i + 6], "little") + 8
        if i + size <= n and _ubx_sum(data, i + 2, size - 4) == data[i + size - 2 : i + size]:
            yield i, i + size, data[i + 2] << 8 | data[i + 3]
            i += size
        else:
            i += 2


def _ubx_sum(data: bytes, start: int, size: int) -> bytes:
    body = np.frombuffer(data, np.uint8, size, start).astype(np.int64)
    return bytes((int(body.sum()) & 255, int((body * np.arange(size, 0, -1)).sum()) & 255))


def _load_ubx(data: bytes) -> Log:
    times, chunks, start = list[float](), list[bytes](), 0
    for a, b, kind in ubx_frames(data):
        if kind != _RAWX:
            continue
        week = int.from_bytes(data[a + 14 : a + 16], "little")
        time_s = week * WEEK + float(np.frombuffer(data, "<f8", 1, a + 6)[0])
        if week < 1000 or (times and time_s <= times[-1]):
            continue  # receiver without the date yet: its bytes go with the next epoch
        times.append(time_s)
        chunks.append(data[start:b])
        start = b
    return Log("ubx", np.array(times), chunks, b"")


# --- RTCM 3 ---


def _crc_table() -> list[int]:
    table = list[int]()
    for i in range(256):
        c = i << 16
        for _ in range(8):
            c = (c << 1) ^ (0x1864CFB if c & 0x800000 else 0)
        table.append(c & 0xFFFFFF)
    return table


_CRC: Final = _crc_table()


def crc24q(data: bytes) -> int:
    """Return the checksum of an RTCM frame."""
    c = 0
    for b in data:
        c = ((c << 8) & 0xFFFFFF) ^ _CRC[(c >> 16) ^ b]
    return c


def bits(payload: bytes, pos: int, length: int) -> int:
    """Return an unsigned field of a payload, bit position counted from its first bit."""
    first, last = pos // 8, (pos + length + 7) // 8
    return (int.from_bytes(payload[first:last], "big") >> (last * 8 - pos - length)) & ((1 << length) - 1)


def set_bits(payload: bytes, pos: int, length: int, value: int) -> bytes:
    """Return the payload with another value of a field."""
    shift = len(payload) * 8 - pos - length
    whole = int.from_bytes(payload, "big")
    whole = (whole & ~(((1 << length) - 1) << shift)) | ((value & ((1 << length) - 1)) << shift)
    return whole.to_bytes(len(payload), "big")


def rtcm_frames(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (start, end, message type) of every whole frame with a right CRC."""
    i, n = 0, len(data)
    while (i := data.find(0xD3, i)) >= 0 and i + 6 <= n:
        size = ((data[i + 1] & 3) << 8 | data[i + 2]) + 6
        if size > 7 and i + size <= n and crc24q(data[i : i + size - 3]) == int.from_bytes(data[i + size - 3 : i + size], "big"):
            yield i, i + size, bits(data[i + 3 : i + 6], 0, 12)
            i += size
        else:
            i += 1


def _load_rtcm(data: bytes, fmt: str, redate: bool) -> Log:
    found = list(rtcm_frames(data))
    frames = [(data[a:b], kind) for a, b, kind in found]
    between = [data[end:a] for end, (a, _, _) in zip((0, *(b for _, b, _ in found)), found, strict=False)]
    reference = next((t for t in (_tow_s(kind, frame[3:-3], None) for frame, kind in frames) if t is not None), None)
    shift = _week_shift(frames, reference) if redate and reference is not None else 0
    out, prime, marks = bytearray(), dict[tuple[int, int], bytes](), list[tuple[float, int]]()
    for gap, (told, kind) in zip(between, frames, strict=True):
        frame = _moved(told, kind, shift) if shift and kind in _WEEK_FIELDS else told
        if kind in _SATELLITE_BITS:
            prime.setdefault((kind, bits(frame[3:-3], 12, _SATELLITE_BITS[kind])), frame)
        out += gap + frame
        tow = _tow_s(kind, frame[3:-3], reference)
        if tow is None:
            continue
        reference = tow
        if marks and abs((tow - marks[-1][0] + WEEK / 2) % WEEK - WEEK / 2) < 0.01:
            tow = marks.pop()[0]
        marks.append((tow, len(out)))
    return Log(fmt, *_cut(bytes(out), marks), b"".join(prime.values()))


def _tow_s(kind: int, payload: bytes, reference: float | None) -> float | None:
    """Return the GPS time of week of an observation message; None of others, and of GLONASS while no other system has said the day."""
    if 1071 <= kind <= 1137 and 1 <= kind % 10 <= 7:
        if kind // 10 != 108:
            return (bits(payload, 24, 30) / 1000 + (14 if kind // 10 == 112 else 0)) % WEEK
        moscow = bits(payload, 27, 27)
    elif 1001 <= kind <= 1004:
        return bits(payload, 24, 30) / 1000
    elif 1009 <= kind <= 1012:
        moscow = bits(payload, 24, 27)
    else:
        return None
    if reference is None:
        return None
    tod = moscow / 1000 - 10800 + LEAP_S
    return (reference + (tod - reference + _DAY_S / 2) % _DAY_S - _DAY_S / 2) % WEEK


def _week_shift(frames: list[tuple[bytes, int]], reference: float) -> int:
    """Return by how many weeks ephemerides must be moved for the log to be of these days; 0 if no GPS ephemeris says which it is of."""
    target = round((time.time() - _GPS_UNIX_S + LEAP_S - reference) / WEEK)
    for frame, kind in frames:
        if kind == 1019:
            payload = frame[3:-3]
            return target - (bits(payload, 18, 10) + round((bits(payload, 56, 16) * 16 - reference) / WEEK))
    return 0


def _moved(frame: bytes, kind: int, shift: int) -> bytes:
    """Return the frame of an ephemeris whose week is another one."""
    pos, width = _WEEK_FIELDS[kind]
    payload = frame[3:-3]
    body = frame[:3] + set_bits(payload, pos, width, bits(payload, pos, width) + shift)
    return body + crc24q(body).to_bytes(3, "big")


def _cut(data: bytes, marks: list[tuple[float, int]]) -> tuple[Vector, list[bytes]]:
    """Return continuous times of epochs, and their bytes: each ends at its mark (time of week, end)."""
    times, chunks, base, cut = list[float](), list[bytes](), 0.0, 0
    for tow, end in marks:
        if times and tow + base < times[-1] - WEEK / 2:
            base += WEEK
        if times and tow + base <= times[-1]:
            continue
        times.append(tow + base)
        chunks.append(data[cut:end])
        cut = end
    return np.array(times), chunks
