"""Values to SBF blocks (mosaic-X5 reference guide 4.14, 4.1 and 4.2): what a Septentrio receiver sends."""

from math import atan2, degrees, floor, isnan
from struct import Struct
from typing import Final, NamedTuple

import numpy as np

from rtkmesh.codecs.checksums import crc16
from rtkmesh.codecs.navigation_words import words_of
from rtkmesh.codecs.sbf_ephemerides import ephemeris_fields, ionosphere_fields
from rtkmesh.codecs.sbf_navigation import BEIDOU_RAW, GALILEO_RAW_INAV, GLONASS_RAW_CA, GPS_RAW_CA, QZSS_RAW_CA
from rtkmesh.codecs.sbf_signals import E6B, GLONASS_FDMA, GPS_L1P, GPS_L2P, septentrio_signal, svid_of
from rtkmesh.codecs.sbf_solution import ATT_COV_EULER, ATT_EULER, AUX_POSITIONS, END_OF_ATT, PVT_GEODETIC, RECEIVER_SETUP
from rtkmesh.codecs.subframes_encode import d1_subframes, glonass_strings, inav_pages, lnav_subframes
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import (
    Ephemeris,
    GlonassEphemeris,
    KlobucharParameters,
    NavigationMessage,
    ReceiverFix,
    ReferenceStation,
)
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM, carrier_hz
from rtkmesh.gnss.time import GpsTime

_NO_TOW, _NO_WEEK = 0xFFFFFFFF, 0xFFFF
_FIRST: Final = Struct("<BBBBIiHbBHBB")
_FURTHER: Final = Struct("<BBBBbBHHH")
_EXTRA: Final = Struct("<BBhhHHHBbBB")
_PVT: Final = Struct("<BBdddfffffdfBBBBHHIBBHHHHB")
_SETUP: Final = Struct("<2x60s20s20s40s20s20s20s20s20sfff")
_DO_NOT_USE: Final = -2e10
_RAW_HEAD: Final = Struct("<BBBBBB")
_MAX_LOCK1_S, _MAX_LOCK2_S = 65534, 254
_NO_DOPPLER = -(1 << 31)
_NO_PHASE, _NO_CODE, _NO_DOPPLER_DIFFERENCE = (-128, 0), (-4, 0), (-16, 0)
_SUBFRAME_S, _PAGE_S, _STRING_S = 6.0, 2.0, 2.0
# Signals that raw blocks name as their source: L1CA of GPS and QZSS, E1, L1CA of GLONASS, B1I.
_SOURCE: Final = {GPS_RAW_CA: 0, QZSS_RAW_CA: 6, GALILEO_RAW_INAV: 17, GLONASS_RAW_CA: 8, BEIDOU_RAW: 28}


class _Signal(NamedTuple):
    """One row of an epoch with Septentrio's number of its signal."""

    row: int
    number: int
    hz: float


def block(kind: str, time: GpsTime | None, fields: bytes, revision: int = 0) -> bytes:
    """Return the block of the fields behind its time, padded to a multiple of four bytes; None: the receiver knows no time yet."""
    tow_ms, week = (_NO_TOW, _NO_WEEK) if time is None else (round(time.tow_s * 1e3), time.week)
    fields += bytes(-(len(fields) + 14) % 4)
    body = Struct("<HHIH").pack(int(kind) | revision << 13, len(fields) + 14, tow_ms, week) + fields
    return b"$@" + crc16(body).to_bytes(2, "little") + body


def encode_meas_epoch(epoch: Epoch, antenna: int = 0, *, clock_jumps: int = 0, others: Epoch | None = None) -> bytes:
    """Return the MeasEpoch of an epoch; signals that SBF has no number for are left out, and satellites whose first signal has no code.

    ``others`` is what the auxiliary antenna 1 measured at the same time.
    """
    blocks = _satellite_blocks(epoch, antenna) + ([] if others is None else _satellite_blocks(others, 1))
    flags = 0x40 if np.any(epoch.signal == E6B) else 0
    return block("4027", epoch.time, bytes((len(blocks), _FIRST.size, _FURTHER.size, flags, clock_jumps % 256, 0)) + b"".join(blocks), 1)


def encode_meas_extra(epoch: Epoch, antenna: int = 0) -> bytes:
    """Return the MeasExtra of an epoch, with the sigmas and the fine part of C/N0."""
    parts: list[bytes] = []
    for index, (_, signals) in enumerate(_by_satellite(epoch)):
        for s in signals:
            low, high = (s.number, 0) if s.number < 31 else (31, s.number - 32)
            variances = (_variance(float(epoch.pseudorange_sigma_m[s.row]), 1e-4), _variance(float(epoch.phase_sigma_cyc[s.row]), 1e-6))
            cn0 = float(epoch.cn0_dbhz[s.row])
            fine = 0 if isnan(cn0) else floor((cn0 * 4.0 - floor(cn0 * 4.0)) * 8.0)
            parts.append(_EXTRA.pack(index + 1, antenna << 5 | low, 0, 0, *variances, 0, 0, 0, 0, high << 3 | fine))
    return block("4000", epoch.time, bytes((len(parts), _EXTRA.size)) + Struct("<f").pack(0.0) + b"".join(parts), 3)


def _variance(sigma: float, unit: float) -> int:
    return 65535 if isnan(sigma) else min(round(sigma * sigma / unit), 65534)


def _by_satellite(epoch: Epoch) -> list[tuple[int, list[_Signal]]]:
    """Return the signals of each satellite that SBF can send; the first one has a code."""
    found: dict[int, list[_Signal]] = {}
    for row, (satellite, signal, channel) in enumerate(
        zip(epoch.satellite.tolist(), epoch.signal.tolist(), epoch.channel.tolist(), strict=True)
    ):
        number = septentrio_signal(satellite, signal)
        hz = carrier_hz(satellite, signal, channel)
        if number is not None and hz > 0.0 and (found.get(satellite) or not isnan(epoch.pseudorange_m[row])):
            found.setdefault(satellite, []).append(_Signal(row, number, hz))
    return list(found.items())


def _satellite_blocks(epoch: Epoch, antenna: int) -> list[bytes]:
    blocks: list[bytes] = []
    for index, (satellite, signals) in enumerate(_by_satellite(epoch)):
        first = signals[0]
        code = round(float(epoch.pseudorange_m[first.row]) * 1e3)
        doppler = float(epoch.doppler_hz[first.row])
        sent_doppler = _NO_DOPPLER if isnan(doppler) else round(doppler * 1e4)
        further = [_further(epoch, s, first.hz, code, sent_doppler, antenna) for s in signals[1:]]
        msb, lsb = _phase(epoch, first, code)
        lock_s = min(floor(np.nan_to_num(epoch.lock_s[first.row])), _MAX_LOCK1_S)
        info = _info(epoch, first)
        if GLONASS_FDMA[0] <= first.number <= GLONASS_FDMA[1]:
            info |= int(epoch.channel[first.row]) + 8 << 3
        head = _FIRST.pack(
            index + 1, antenna << 5 | min(first.number, 31), svid_of(satellite), code >> 32, code & 0xFFFFFFFF, sent_doppler, lsb, msb,
            _cn0(epoch, first), lock_s, info, len(further),
        )  # fmt: skip
        blocks.append(head + b"".join(further))
    return blocks


def _further(epoch: Epoch, signal: _Signal, first_hz: float, first_code: int, first_doppler: int, antenna: int) -> bytes:
    """Return a sub-block of type 2; ``first_code`` (mm) and ``first_doppler`` (0.1 mHz) are what its type 1 sends."""
    pseudorange_m, doppler = float(epoch.pseudorange_m[signal.row]), float(epoch.doppler_hz[signal.row])
    code = first_code if isnan(pseudorange_m) else round(pseudorange_m * 1e3)
    code_msb, code_lsb = _NO_CODE if isnan(pseudorange_m) else _difference(code - first_code, _NO_CODE)
    doppler_msb, doppler_lsb = _NO_DOPPLER_DIFFERENCE
    if not isnan(doppler) and first_doppler != _NO_DOPPLER:
        step = round((doppler - first_doppler * 1e-4 * signal.hz / first_hz) * 1e4)
        doppler_msb, doppler_lsb = _difference(step, _NO_DOPPLER_DIFFERENCE)
    msb, lsb = _phase(epoch, signal, code) if (code_msb, code_lsb) != _NO_CODE else _NO_PHASE
    return _FURTHER.pack(
        antenna << 5 | min(signal.number, 31), min(floor(np.nan_to_num(epoch.lock_s[signal.row])), _MAX_LOCK2_S), _cn0(epoch, signal),
        (doppler_msb & 31) << 3 | code_msb & 7, msb, _info(epoch, signal), code_lsb, lsb, doppler_lsb,
    )  # fmt: skip


def _phase(epoch: Epoch, signal: _Signal, code_mm: int) -> tuple[int, int]:
    """Return high and low part of phase minus code (0.001 cycles), whose difference must be within 8388 cycles."""
    phase = float(epoch.phase_cyc[signal.row])
    if isnan(phase):
        return _NO_PHASE
    return _difference(round((phase - code_mm * 1e-3 * signal.hz / SPEED_OF_LIGHT_MPS) * 1e3), _NO_PHASE)


def _difference(number: int, none: tuple[int, int]) -> tuple[int, int]:
    """Return a number in high and low part; ``none`` (the least high part) where it does not fit."""
    msb, lsb = divmod(number, 65536)
    return (msb, lsb) if none[0] <= msb < -none[0] else none


def _info(epoch: Epoch, signal: _Signal) -> int:
    half = 4 if epoch.flags[signal.row] & HALF_CYCLE else 0
    return half | (signal.number - 32 << 3 if signal.number >= 32 else 0)


def _cn0(epoch: Epoch, signal: _Signal) -> int:
    cn0 = float(epoch.cn0_dbhz[signal.row])
    return 255 if isnan(cn0) else min(max(floor((cn0 - (0.0 if signal.number in (GPS_L1P, GPS_L2P) else 10.0)) * 4.0), 0), 254)


def encode_ephemeris(ephemeris: Ephemeris, time: GpsTime) -> bytes:
    """Return the decoded block (GPSNav, GALNav, GLONav, BDSNav or QZSNav) of an ephemeris, sent at a time."""
    kind, fields = ephemeris_fields(ephemeris)
    return block(kind, time, fields)


def encode_ionosphere(parameters: KlobucharParameters, time: GpsTime) -> bytes:
    """Return the GPSIon or BDSIon of ionosphere coefficients."""
    kind, fields = ionosphere_fields(parameters)
    return block(kind, time, fields)


def encode_navigation(ephemeris: Ephemeris, sent: GpsTime, ionosphere: KlobucharParameters | None = None) -> list[bytes]:
    """Return the raw blocks of an ephemeris, as of the navigation frame that started at ``sent``; ValueError for other messages.

    ``ionosphere`` is what BeiDou satellites send with it. For GLONASS ``sent`` is a multiple of 30 s in UTC.
    """
    satellite, system = ephemeris.satellite, ephemeris.satellite // SATELLITES_PER_SYSTEM
    if isinstance(ephemeris, GlonassEphemeris):
        strings = [words_of(string, 85, 32) for string in glonass_strings(ephemeris, sent).values()]
        return [
            _raw(GLONASS_RAW_CA, satellite, sent + _STRING_S * (k + 1), words, ephemeris.channel + 8) for k, words in enumerate(strings)
        ]
    if ephemeris.message is NavigationMessage.LNAV:
        kind = GPS_RAW_CA if system == 0 else QZSS_RAW_CA
        blocks = [words_of(subframe, 300, 30) for subframe in lnav_subframes(ephemeris, sent).values()]
        return [_raw(kind, satellite, sent + _SUBFRAME_S * (k + 1), words) for k, words in enumerate(blocks)]
    if ephemeris.message is NavigationMessage.INAV:
        pages = [_page(page) for page in inav_pages(ephemeris, sent)]
        return [_raw(GALILEO_RAW_INAV, satellite, sent + _PAGE_S * (k + 1), words) for k, words in enumerate(pages)]
    if ephemeris.message is NavigationMessage.D1:
        blocks = [words_of(subframe, 300, 32) for subframe in d1_subframes(ephemeris, sent, ionosphere).values()]
        return [_raw(BEIDOU_RAW, satellite, sent + _SUBFRAME_S * (k + 1), words) for k, words in enumerate(blocks)]
    raise ValueError(f"no raw SBF block for {ephemeris.message.name}")


def _page(page: int) -> list[int]:
    """Return the words of an I/NAV page of 256 bits (see ``INAV_PAGE``): 114 bits of its even part and 120 of its odd part."""
    even, odd = page >> (256 - 114), page >> 8 & (1 << 120) - 1
    return words_of(even << 120 | odd, 234, 32)


def _raw(kind: str, satellite: int, time: GpsTime, words: list[int], channel: int = 0) -> bytes:
    head = _RAW_HEAD.pack(svid_of(satellite), 1, 0, _SOURCE[kind], channel, 1)
    return block(kind, time, head + b"".join(word.to_bytes(4, "little") for word in words))


def encode_pvt(fix: ReceiverFix, *, fixed_location: bool = False) -> bytes:
    """Return the PVTGeodetic (revision 2) of a fix; ``fixed_location``: of a base station that was told where it is."""
    kind = 3 if fixed_location else {0: 0, 2: 1, 3: 1, 4: 2, 5: 5, 6: 4}.get(fix.fix, 0)
    north, east, down = fix.velocity_ned_mps or (_DO_NOT_USE, _DO_NOT_USE, -_DO_NOT_USE)
    course = degrees(atan2(east, north)) % 360.0 if fix.velocity_ned_mps else _DO_NOT_USE
    accuracies = (min(round(sigma * 200.0), 65534) if sigma == sigma else 65535 for sigma in (fix.horizontal_sigma_m, fix.vertical_sigma_m))
    fields = _PVT.pack(
        kind | (0x80 if fix.fix == 2 else 0), 0 if kind else 1, *_sent(fix.lat_rad, fix.lon_rad, fix.height_m), _DO_NOT_USE,
        north, east, -down, course, _DO_NOT_USE, _DO_NOT_USE, 0, 0, fix.satellites, 0, 0, 65535, 0, 0, 0, 0, 0, *accuracies, 1 << 6,
    )  # fmt: skip
    return block(PVT_GEODETIC, fix.time, fields, 2)


def _sent(*values: float) -> tuple[float, ...]:
    return tuple(_DO_NOT_USE if isnan(value) else value for value in values)


def encode_setup(station: ReferenceStation, time: GpsTime) -> bytes:
    """Return the ReceiverSetup of a station's names and antenna height; its receiver is name and firmware with a space between."""
    name, _, firmware = station.receiver.rpartition(" ")
    texts = (b"", b"", b"", b"", b"", name.encode(), firmware.encode(), station.antenna_serial.encode(), station.antenna.encode())
    return block(RECEIVER_SETUP, time, _SETUP.pack(*texts, station.antenna_height_m, 0.0, 0.0))


def encode_attitude(heading: ReceiverHeading) -> bytes:
    """Return AttEuler, AttCovEuler, AuxAntPositions (where the baseline is known) and EndOfAtt of a heading."""
    solved = heading.solution in (CarrierSolution.FLOAT, CarrierSolution.FIXED)
    mode = {CarrierSolution.FLOAT: 1, CarrierSolution.FIXED: 2}.get(heading.solution or CarrierSolution.NONE, 0)
    mode += 2 if solved and not isnan(heading.roll_rad) else 0
    angles = _sent(*(degrees(angle) for angle in (heading.heading_rad, heading.pitch_rad, heading.roll_rad)))
    sigmas = (heading.heading_sigma_rad, heading.pitch_sigma_rad, heading.roll_sigma_rad)
    variances = _sent(*(degrees(sigma) ** 2 for sigma in sigmas))
    satellites, unknown = 255 if heading.satellites is None else heading.satellites, [_DO_NOT_USE] * 3
    parts = [
        block(ATT_EULER, heading.time, Struct("<BBHHffffff").pack(satellites, 0 if solved else 1, mode, 0, *angles, *unknown)),
        block(ATT_COV_EULER, heading.time, Struct("<BBffffff").pack(0, 0, *variances, *unknown)),
    ]
    if heading.baseline_ned_m is not None:
        north, east, down = heading.baseline_ned_m
        offsets = Struct("<BBBBdddddd").pack(satellites, 0, 0, 1, east, north, -down, *unknown)
        parts.append(block(AUX_POSITIONS, heading.time, bytes((1, len(offsets))) + offsets))
    return b"".join((*parts, block(END_OF_ATT, heading.time, b"")))
