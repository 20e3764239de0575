"""Values to UBX frames: RXM-RAWX, RXM-SFRBX and NAV-PVT (u-blox F9 HPG 1.32 interface description, 3.17 and 3.15)."""

from math import degrees
from struct import Struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.checksums import fletcher16
from rtkmesh.codecs.subframes_encode import d1_subframes, glonass_strings, inav_pages, lnav_ionosphere, lnav_subframes
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KlobucharParameters, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, MAX_SIGNAL, QZSS, SATELLITES_PER_SYSTEM, SBAS, signal_number
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

# system -> (gnssId, svId of number 0); (system, RINEX code) -> sigId (interface description 1.5)
_GNSS: Final = {GPS: (0, 0), SBAS: (1, 100), GALILEO: (2, 0), BEIDOU: (3, 0), QZSS: (5, 0), GLONASS: (6, 0)}
_SIGNALS: Final = {
    GPS: {"1C": 0, "2L": 3, "2S": 4, "5I": 6, "5Q": 7},
    SBAS: {"1C": 0},
    GALILEO: {"1C": 0, "1B": 1, "5I": 3, "5Q": 4, "7I": 5, "7Q": 6, "6B": 8, "6C": 9, "6A": 10},
    BEIDOU: {"2I": 0, "7I": 2, "6I": 4, "1P": 5, "1D": 6, "5P": 7, "5D": 8},
    QZSS: {"1C": 0, "1Z": 1, "2S": 4, "2L": 5, "5I": 8, "5Q": 9, "1E": 12},
    GLONASS: {"1C": 0, "2C": 2},
}  # fmt: skip
_NO_SIGNAL: Final = 255
_SYSTEMS: Final = 7

_MEASUREMENT: Final = np.dtype([
    ("prMes", "<f8"), ("cpMes", "<f8"), ("doMes", "<f4"), ("gnssId", "u1"), ("svId", "u1"), ("sigId", "u1"), ("freqId", "u1"),
    ("locktime", "<u2"), ("cno", "u1"), ("prStdev", "u1"), ("cpStdev", "u1"), ("doStdev", "u1"), ("trkStat", "u1"), ("reserved", "u1"),
])  # fmt: skip
_RAWX_HEADER: Final = Struct("<dHbBBB2x")
_SFRBX_HEADER: Final = Struct("<BBBBBBBx")
_NAV_PVT: Final = Struct("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH")
_LEAP_SECONDS_KNOWN, _CLOCK_RESET = 1, 2  # recStat
_MAX_LOCK_MS: Final = 64500.0
_INAV_LAST_WORD: Final = 1  # the ninth word, of no documented meaning; receivers send it and RTKLIB wants it
_PHASE_SIGMA_UNIT_CYC: Final = 0.004
_CODE_SIGMA_UNIT_M: Final = 0.01


def _tables() -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return gnssId and svId of number 0 by system, and sigId by system and signal."""
    gnss, first = np.full(_SYSTEMS, _NO_SIGNAL, np.uint8), np.zeros(_SYSTEMS, np.uint8)
    sigs = np.full((_SYSTEMS, MAX_SIGNAL), _NO_SIGNAL, np.uint8)
    for system, (gnss_id, offset) in _GNSS.items():
        gnss[system], first[system] = gnss_id, offset
        for code, sig in _SIGNALS[system].items():
            sigs[system, signal_number(code)] = sig
    return gnss, first, sigs


_GNSS_OF, _FIRST_SV, _SIG_OF = _tables()


def frame(message_class: int, message_id: int, payload: bytes) -> bytes:
    """Return the frame of a payload (interface description 3.2)."""
    body = bytes((message_class, message_id)) + len(payload).to_bytes(2, "little") + payload
    return b"\xb5\x62" + body + fletcher16(body).to_bytes(2, "little")


def encode_rawx(epoch: Epoch, *, clock_reset: bool = False, half_cycle_subtracted: NDArray[np.bool_] | None = None) -> bytes:
    """Return the RXM-RAWX frame of an epoch; signals that UBX has no number for are left out (255 measurements at most)."""
    system = epoch.satellite // SATELLITES_PER_SYSTEM
    sig = _SIG_OF[system, epoch.signal]
    kept = np.flatnonzero(sig != _NO_SIGNAL)[:255]
    rows = np.zeros(len(kept), _MEASUREMENT)
    code, phase, lock_s = epoch.pseudorange_m[kept], epoch.phase_cyc[kept], epoch.lock_s[kept]
    rows["prMes"], rows["cpMes"], rows["doMes"] = np.nan_to_num(code), np.nan_to_num(phase), np.nan_to_num(epoch.doppler_hz[kept])
    rows["gnssId"], rows["sigId"] = _GNSS_OF[system[kept]], sig[kept]
    rows["svId"] = epoch.satellite[kept] % SATELLITES_PER_SYSTEM + _FIRST_SV[system[kept]]
    rows["freqId"] = np.where(system[kept] == GLONASS, epoch.channel[kept] + 7, 0)
    rows["locktime"] = np.minimum(np.nan_to_num(lock_s) * 1e3, _MAX_LOCK_MS)
    rows["cno"] = np.clip(np.rint(np.nan_to_num(epoch.cn0_dbhz[kept])), 0, 63)
    rows["prStdev"] = _code_index(epoch.pseudorange_sigma_m[kept])
    rows["cpStdev"] = np.where(np.isnan(phase), 15, _phase_index(epoch.phase_sigma_cyc[kept]))
    half = (epoch.flags[kept] & HALF_CYCLE) == 0
    tracked = np.isfinite(phase)
    rows["trkStat"] = np.isfinite(code) * 1 + tracked * 2 + (tracked & half) * 4
    if half_cycle_subtracted is not None:
        rows["trkStat"] += half_cycle_subtracted[kept] * np.uint8(8)
    status = _LEAP_SECONDS_KNOWN | (_CLOCK_RESET if clock_reset else 0)
    header = _RAWX_HEADER.pack(epoch.time.tow_s, epoch.time.week, gps_minus_utc_s(epoch.time), len(kept), status, 1)
    return frame(0x02, 0x15, header + rows.tobytes())


def _code_index(sigma_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return n of 0.01 * 2^n m, the smallest that is not below sigma."""
    return np.clip(np.ceil(np.log2(np.nan_to_num(sigma_m, nan=1.0) / _CODE_SIGMA_UNIT_M)), 0, 15)


def _phase_index(sigma_cyc: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip(np.ceil(np.nan_to_num(sigma_cyc, nan=0.02) / _PHASE_SIGMA_UNIT_CYC), 1, 14)


def encode_sfrbx(satellite: int, words: list[int], channel: int = 0) -> bytes:
    """Return the RXM-SFRBX frame of one navigation block; ``channel`` counts for GLONASS only."""
    system, number = divmod(satellite, SATELLITES_PER_SYSTEM)
    gnss, offset = _GNSS[system]
    sig, freq = 1 if system == GALILEO else 0, channel + 7 if system == GLONASS else 0
    head = _SFRBX_HEADER.pack(gnss, number + offset, sig, freq, len(words), 0, 2)
    return frame(0x02, 0x13, head + b"".join(word.to_bytes(4, "little") for word in words))


def encode_ephemeris(ephemeris: Ephemeris, sent: GpsTime, ionosphere: KlobucharParameters | None = None) -> list[bytes]:
    """Return the RXM-SFRBX frames of all blocks of an ephemeris, as of the frame that started at ``sent``.

    ``ionosphere`` is what BeiDou satellites send with it. GPS and QZSS LNAV, Galileo I/NAV, BeiDou D1 and GLONASS; ValueError for other
    messages. For GLONASS ``sent`` is a multiple of 30 s in UTC.
    """
    satellite = ephemeris.satellite
    if isinstance(ephemeris, GlonassEphemeris):
        return [encode_sfrbx(satellite, words, ephemeris.channel) for words in _glonass_words(ephemeris, sent)]
    if ephemeris.message is NavigationMessage.LNAV:
        return [encode_sfrbx(satellite, _words(block, 10, 30)) for block in lnav_subframes(ephemeris, sent).values()]
    if ephemeris.message is NavigationMessage.INAV:
        return [encode_sfrbx(satellite, [*_words(page, 8, 32), _INAV_LAST_WORD]) for page in inav_pages(ephemeris, sent)]
    if ephemeris.message is NavigationMessage.D1:
        return [encode_sfrbx(satellite, _words(block, 10, 30)) for block in d1_subframes(ephemeris, sent, ionosphere).values()]
    raise ValueError(f"no RXM-SFRBX encoder for {ephemeris.message.name}")


def encode_ionosphere(satellite: int, parameters: KlobucharParameters, sent: GpsTime) -> bytes:
    """Return the RXM-SFRBX frame of LNAV subframe 4 page 18."""
    return encode_sfrbx(satellite, _words(lnav_ionosphere(parameters, sent), 10, 30))


def _words(block: int, count: int, bits: int) -> list[int]:
    return [block >> (bits * (count - 1 - k)) & ((1 << bits) - 1) for k in range(count)]


def _glonass_words(ephemeris: GlonassEphemeris, sent: GpsTime) -> list[list[int]]:
    """Return per string its 85 bits in three words and the numbers of superframe and frame (30 s, five in a superframe)."""
    running = int((sent.week * 604800.0 + sent.tow_s - gps_minus_utc_s(sent)) // 30.0)
    stamp = (running // 5 % 0x10000) << 16 | (running % 5 + 1)
    return [[*_words(string << 11, 3, 32), stamp] for string in glonass_strings(ephemeris, sent).values()]


def encode_nav_pvt(fix: ReceiverFix) -> bytes:
    """Return the NAV-PVT frame of a fix; ``fix.time`` must be known, heights above the sea are sent as those above the ellipsoid."""
    if fix.time is None:
        raise ValueError("NAV-PVT needs a time")
    utc = fix.time.to_utc()
    nano = utc.microsecond * 1000
    north, east, down = fix.velocity_ned_mps or (0.0, 0.0, 0.0)
    kind, flags = (3, 1) if fix.fix >= 3 else (fix.fix, int(fix.fix > 0))
    flags |= {4: 2, 5: 2 | 1 << 6, 6: 2 | 2 << 6}.get(fix.fix, 0)
    speed, course = float(np.hypot(north, east)), float(np.arctan2(east, north)) % (2.0 * np.pi)
    payload = _NAV_PVT.pack(
        _mm(fix.time.tow_s) % 604800000, utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second, 7, 20, nano, kind, flags, 0,
        fix.satellites, round(degrees(fix.lon_rad) * 1e7), round(degrees(fix.lat_rad) * 1e7), _mm(fix.height_m), _mm(fix.height_m),
        _mm(fix.horizontal_sigma_m), _mm(fix.vertical_sigma_m), _mm(north), _mm(east), _mm(down), _mm(speed), round(degrees(course) * 1e5),
        100, 18000000, 120, 0, 0, 0, 0, 0,
    )  # fmt: skip
    return frame(0x01, 0x07, payload)


def _mm(value: float) -> int:
    """Return thousandths."""
    return round(value * 1e3)
