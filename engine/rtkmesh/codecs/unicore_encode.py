"""Values to logs of Unicore N4 receivers, binary and ASCII: OBSVM, OBSVH, their compressed forms, ephemerides, BESTNAV, UNIHEADING."""

from collections.abc import Mapping, Sequence
from math import atan2, degrees, hypot, isfinite, isnan
from struct import Struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.accuracy import GLONASS_FT_M, SISA_M, accuracy_index
from rtkmesh.codecs.checksums import crc32
from rtkmesh.codecs.framing_unicore import UNICORE_LOGS
from rtkmesh.codecs.unicore import BESTNAV, UNIHEADING
from rtkmesh.codecs.unicore_ephemeris import (
    BEIDOU_FIELDS,
    BEIDOU_NAMES,
    CHANNEL_OFFSET,
    GALILEO_FIELDS,
    GALILEO_NAMES,
    GLONASS_FIELDS,
    GLONASS_NAMES,
    GLONASS_SLOT_OFFSET,
    GPS_FIELDS,
    GPS_NAMES,
    QZSS_PRN_OFFSET,
)
from rtkmesh.codecs.unicore_logs import POSITION_TYPE, SOLUTION_STATUS, Value
from rtkmesh.codecs.unicore_observations import (
    CODE_LOCKED,
    DOPPLER_UNIT_HZ,
    LEAST_CN0_DBHZ,
    LOCK_UNIT_S,
    PARITY_KNOWN,
    PHASE_LOCKED,
    PHASE_UNIT_CYC,
    PSEUDORANGE_SIGMAS_M,
    RANGE_UNIT_M,
    SIGMA_STEP_CYC,
    UNICORE,
    Form,
)
from rtkmesh.codecs.unicore_signals import SATELLITES, SIGNAL_TYPES, SYSTEMS
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage, ReceiverFix
from rtkmesh.gnss.epoch import HALF_CYCLE, Epoch
from rtkmesh.gnss.receiver import CarrierSolution, ReceiverHeading
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, MAX_SATELLITE, MAX_SIGNAL, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_HEADER: Final = Struct("<3sBHHBBHIIBBH")
_NUMBERS: Final = {name: number for number, name in UNICORE_LOGS.items()}
_IDLE, _FINE, _LEAP_S, _DELAY_MS = 78, 0, 18, 5
_MOSCOW_S: Final = 10800
_TYPE_OF_FIX: Final = {1: "INS", 2: "SINGLE", 3: "SINGLE", 4: "PSRDIFF", 5: "NARROW_FLOAT", 6: "NARROW_INT"}
_TYPE_OF_SOLUTION: Final = {CarrierSolution.FLOAT: "NARROW_FLOAT", CarrierSolution.FIXED: "NARROW_INT"}


def _satellites() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return system and PRN by satellite (PRN 0: none)."""
    systems, prns = np.zeros(MAX_SATELLITE, np.int64), np.zeros(MAX_SATELLITE, np.int64)
    for number, system, first, last, offset in reversed(SATELLITES):
        for prn in range(first, last + 1):
            satellite = system * SATELLITES_PER_SYSTEM + prn - offset
            systems[satellite], prns[satellite] = number, prn
    return systems, prns


_SYSTEM_OF, _PRN_OF = _satellites()


def _kinds(form: Form) -> NDArray[np.int64]:
    """Return the signal type by system and signal, -1 where there is none."""
    kinds = np.full((SYSTEMS, MAX_SIGNAL), -1, np.int64)
    for number in range(SYSTEMS):
        for kind in reversed(range(SIGNAL_TYPES)):
            kinds[number, form.signals[number, kind]] = kind
    kinds[:, 0] = -1
    return kinds


def binary_log(name: str, time: GpsTime, body: bytes) -> bytes:
    """Return a binary log; its header tells whole milliseconds."""
    header = _HEADER.pack(
        b"\xaa\x44\xb5", _IDLE, _NUMBERS[name], len(body), 0, _FINE, time.week, round(time.tow_s * 1e3), 0, 0, _LEAP_S, _DELAY_MS
    )
    return header + body + crc32(header + body).to_bytes(4, "little")


def ascii_log(name: str, time: GpsTime, body: str) -> bytes:
    """Return an ASCII log."""
    text = f"{name}A,{_IDLE},GPS,FINE,{time.week},{round(time.tow_s * 1e3)},0,0,{_LEAP_S},{_DELAY_MS};{body}"
    return f"#{text}*{crc32(text.encode()):08x}\r\n".encode()


def encode_observations(epoch: Epoch, name: str = "OBSVM") -> bytes:
    """Return OBSVM or OBSVH of an epoch; signals that Unicore has no number for are left out, as are phases with half cycles open."""
    rows = observation_rows(epoch)
    return binary_log(name, epoch.time, counted([row.tobytes() for row in rows]))


def encode_observations_ascii(epoch: Epoch, name: str = "OBSVM") -> bytes:
    """Return OBSVMA or OBSVHA of an epoch."""
    rows = observation_rows(epoch)
    words = [
        f"{r['frequency']},{r['prn']},{r['pseudorange_m']:.3f},{r['range_cyc']:.6f},{r['pseudorange_sigma']},{r['phase_sigma']},"
        f"{r['doppler_hz']:.3f},{r['cn0']},0,{r['lock_s']:.3f},{int(r['status']):08x}"
        for r in rows
    ]
    return ascii_log(name, epoch.time, ",".join([str(len(rows)), *words]))


def encode_compressed(epoch: Epoch, name: str = "OBSVMCMP") -> bytes:
    """Return OBSVMCMP or OBSVHCMP of an epoch."""
    return binary_log(name, epoch.time, counted(compressed_rows(epoch)))


def encode_compressed_ascii(epoch: Epoch, name: str = "OBSVMCMP") -> bytes:
    """Return OBSVMCMPA or OBSVHCMPA of an epoch: each measurement in hexadecimal."""
    rows = compressed_rows(epoch)
    return ascii_log(name, epoch.time, ",".join([str(len(rows)), *(row.hex() for row in rows)]))


def observation_rows(epoch: Epoch, form: Form = UNICORE) -> NDArray[np.void]:
    """Return the rows of full measurements of an epoch."""
    system = _SYSTEM_OF[epoch.satellite]
    kind = _kinds(form)[system, epoch.signal]
    kept = np.flatnonzero((_PRN_OF[epoch.satellite] > 0) & (kind >= 0))
    rows = np.zeros(len(kept), form.rows)
    code, phase, satellite = epoch.pseudorange_m[kept], epoch.phase_cyc[kept], epoch.satellite[kept]
    known = epoch.flags[kept] & HALF_CYCLE == 0
    tracked = np.isfinite(phase) & (known | form.tells_parity)
    glonass = satellite // SATELLITES_PER_SYSTEM == GLONASS
    rows["frequency"], rows["prn"] = np.where(glonass, epoch.channel[kept] + CHANNEL_OFFSET, 0), _PRN_OF[satellite]
    rows["pseudorange_m"], rows["range_cyc"] = np.nan_to_num(code), np.where(tracked, -np.nan_to_num(phase), 0.0)
    rows["doppler_hz"], rows["lock_s"] = np.nan_to_num(epoch.doppler_hz[kept]), np.nan_to_num(epoch.lock_s[kept])
    _put_in_units(rows, "pseudorange_sigma", epoch.pseudorange_sigma_m[kept], form.units.pseudorange_sigma_m)
    _put_in_units(rows, "phase_sigma", epoch.phase_sigma_cyc[kept], form.units.phase_sigma_cyc)
    _put_in_units(rows, "cn0", epoch.cn0_dbhz[kept], form.units.cn0_dbhz)
    rows["status"] = (
        system[kept] << 16
        | kind[kept] << 21
        | np.where(tracked, PHASE_LOCKED, 0)
        | np.where(np.isfinite(code), CODE_LOCKED, 0)
        | np.where(known & form.tells_parity, PARITY_KNOWN, 0)
    )
    return rows


def _put_in_units(rows: NDArray[np.void], name: str, values: NDArray[np.float64], unit: float) -> None:
    scaled = np.nan_to_num(values) / unit
    rows[name] = np.clip(np.rint(scaled), 0, 65535) if rows[name].dtype.kind == "u" else scaled


def compressed_rows(epoch: Epoch, form: Form = UNICORE) -> list[bytes]:
    """Return the rows of 24 bytes of an epoch."""
    return [_compressed(row, form) for row in observation_rows(epoch, form)]


def _compressed(row: np.void, form: Form) -> bytes:
    """Return the fields of a row, the first one in the lowest bits."""
    sigma_m, sigma_cyc = float(row["pseudorange_sigma"]) * form.units.pseudorange_sigma_m, row["phase_sigma"] * form.units.phase_sigma_cyc
    fields = (
        (int(row["status"]), 32), (round(float(row["doppler_hz"]) / DOPPLER_UNIT_HZ), 28),
        (round(float(row["pseudorange_m"]) / RANGE_UNIT_M), 36),
        (round(float(row["range_cyc"]) / PHASE_UNIT_CYC), 32), (min(int(np.searchsorted(PSEUDORANGE_SIGMAS_M, sigma_m - 1e-9)), 15), 4),
        (min(max(round(float(sigma_cyc) / SIGMA_STEP_CYC) - 1, 0), 15), 4), (int(row["prn"]), 8),
        (min(round(float(row["lock_s"]) / LOCK_UNIT_S), (1 << 21) - 1), 21),
        (min(max(round(float(row["cn0"]) * form.units.cn0_dbhz - LEAST_CN0_DBHZ), 0), 31), 5), (int(row["frequency"]), 6), (0, 16),
    )  # fmt: skip
    value, shift = 0, 0
    for number, bits in fields:
        value |= (number & ((1 << bits) - 1)) << shift
        shift += bits
    return value.to_bytes(shift // 8, "little")


def counted(rows: Sequence[bytes]) -> bytes:
    """Return rows behind their number."""
    return len(rows).to_bytes(4, "little") + b"".join(rows)


def ephemeris_fields(ephemeris: Ephemeris) -> tuple[str, tuple[Value, ...]]:
    """Return name and fields of an ephemeris' log; ValueError for messages that have none."""
    if isinstance(ephemeris, GlonassEphemeris):
        name, values = "GLOEPH", _glonass_values(ephemeris)
    elif ephemeris.satellite // SATELLITES_PER_SYSTEM == GALILEO:
        name, values = "GALEPH", galileo_values(ephemeris)
    else:
        system = ephemeris.satellite // SATELLITES_PER_SYSTEM
        name, values = {BEIDOU: "BDSEPH", QZSS: "QZSSEPH"}.get(system, "GPSEPH"), kepler_values(ephemeris)
    names = {"GLOEPH": GLONASS_NAMES, "GALEPH": GALILEO_NAMES, "BDSEPH": BEIDOU_NAMES}.get(name, GPS_NAMES)
    return name, tuple(values.get(field, getattr(ephemeris, field, 0)) for field in names)


def encode_ephemeris(ephemeris: Ephemeris, sent: GpsTime) -> bytes:
    """Return the binary log of an ephemeris as of the time at which the receiver sends it."""
    name, body = encoded_ephemeris(ephemeris)
    return binary_log(name, sent, body)


def encoded_ephemeris(ephemeris: Ephemeris) -> tuple[str, bytes]:
    """Return name and body of an ephemeris' binary log; ValueError for messages that have none."""
    name, values = ephemeris_fields(ephemeris)
    fields = {"GLOEPH": GLONASS_FIELDS, "GALEPH": GALILEO_FIELDS, "BDSEPH": BEIDOU_FIELDS}.get(name, GPS_FIELDS)
    return name, fields.pack(*values)


def encode_ephemeris_ascii(ephemeris: Ephemeris, sent: GpsTime) -> bytes:
    """Return the ASCII log of an ephemeris."""
    name, values = ephemeris_fields(ephemeris)
    return ascii_log(name, sent, ",".join(f"{value:.17g}" if isinstance(value, float) else str(value) for value in values))


def kepler_values(e: KeplerEphemeris) -> dict[str, Value]:
    """Return the values of GPSEPH, QZSSEPH and BDSEPH that have another form in an ephemeris."""
    system, number = divmod(e.satellite, SATELLITES_PER_SYSTEM)
    shift_s = BDT_MINUS_GPST_S if system == BEIDOU else 0.0
    toe, toc = e.toe + shift_s, e.toc + shift_s
    return {
        "prn": number + (QZSS_PRN_OFFSET if system == QZSS else 0), "sent_s": e.transmitted.tow_s, "iode2": e.iode, "week": toe.week,
        "sent_week": e.transmitted.week, "toe_s": toe.tow_s, "toc_s": toc.tow_s, "semi_major_m": e.sqrt_a**2,
        "tgd_s": e.group_delay_s[0], "tgd1_s": e.group_delay_s[0], "tgd2_s": e.group_delay_s[1], "variance_m2": e.accuracy_m**2,
        "mean_motion_radps": 0.0,
    }  # fmt: skip


def galileo_values(e: KeplerEphemeris) -> dict[str, Value]:
    """Return the values of GALEPH that have another form in an ephemeris."""
    inav = e.message is NavigationMessage.INAV
    name, other = ("inav", "fnav") if inav else ("fnav", "inav")
    clock: Mapping[str, Value] = {"toc_s": int(e.toc.tow_s), "af0_s": e.af0_s, "af1": e.af1, "af2": e.af2}
    return {
        "prn": e.satellite % SATELLITES_PER_SYSTEM, name: 1, other: 0, "health_e1b": e.health >> 1 & 3, "health_e5a": e.health >> 4 & 3,
        "health_e5b": e.health >> 7 & 3, "invalid_e1b": e.health & 1, "invalid_e5a": e.health >> 3 & 1, "invalid_e5b": e.health >> 6 & 1,
        "sisa": accuracy_index(SISA_M, e.accuracy_m), "toe_s": int(e.toe.tow_s), "bgd_e5a_s": e.group_delay_s[0],
        "bgd_e5b_s": e.group_delay_s[1], **{f"{name}_{part}": value for part, value in clock.items()},
        **{f"{other}_{part}": 0 if part == "toc_s" else 0.0 for part in clock},
    }  # fmt: skip


def _glonass_values(e: GlonassEphemeris) -> dict[str, Value]:
    vectors = {"position": e.position_m, "velocity": e.velocity_mps, "acceleration": e.acceleration_mps2}
    shift_s = _MOSCOW_S - gps_minus_utc_s(e.toe)
    return {
        "slot": e.satellite % SATELLITES_PER_SYSTEM + GLONASS_SLOT_OFFSET, "frequency": e.channel + CHANNEL_OFFSET, "kind": 1,
        "week": e.toe.week, "toe_ms": round(e.toe.tow_s * 1e3), "leap_s": shift_s, "issue": e.iode, "health": 4 * (e.health & 1),
        **{f"{kind}_{axis}": vector[k] for kind, vector in vectors.items() for k, axis in enumerate("xyz")},
        "tau_n_s": -e.tau_s, "delta_tau_n_s": e.group_delay_s, "tk_s": int(e.transmitted.tow_s + shift_s) % 86400,
        "ft": accuracy_index(GLONASS_FT_M, e.accuracy_m),
    }  # fmt: skip


def encode_position(fix: ReceiverFix, name: str = "BESTNAV") -> bytes:
    """Return BESTNAV or BESTNAVH of a fix, whose time must be known; heights are told above the ellipsoid (no undulation)."""
    north, east, down = fix.velocity_ned_mps or (0.0, 0.0, 0.0)
    moving = ("SOL_COMPUTED", "DOPPLER_VELOCITY") if fix.velocity_ned_mps else ("INSUFFICIENT_OBS", "NONE")
    speed = (0.0, 0.0, hypot(north, east), degrees(atan2(east, north)) % 360.0, -down, 0.02, 0.02)
    values = (*position_values(fix), SOLUTION_STATUS[moving[0]], POSITION_TYPE[moving[1]], *speed)
    return binary_log(name, time_of(fix, name), BESTNAV.pack(*values))


def time_of(report: ReceiverFix | ReceiverHeading, name: str) -> GpsTime:
    """Return the time of what a log says; ValueError where it is not known."""
    if report.time is None:
        raise ValueError(f"{name} needs a time")
    return report.time


def position_values(fix: ReceiverFix) -> tuple[Value, ...]:
    """Return the values of BESTPOS, with which BESTNAV begins."""
    kind, status = _TYPE_OF_FIX.get(fix.fix, "NONE"), "SOL_COMPUTED" if fix.fix else "INSUFFICIENT_OBS"
    sigma_m = fix.horizontal_sigma_m / 2.0**0.5
    place = (degrees(fix.lat_rad), degrees(fix.lon_rad), fix.height_m, 0.0, 61, sigma_m, sigma_m, fix.vertical_sigma_m)
    known = tuple(0.0 if isnan(value) else value for value in place)
    counts = (fix.satellites, fix.satellites, 0, 0, 0, 0, 0, 0)
    return (SOLUTION_STATUS[status], POSITION_TYPE[kind], *known, "0", 0.0, 0.0, *counts)


def encode_heading(heading: ReceiverHeading) -> bytes:
    """Return UNIHEADING of a heading, whose time must be known."""
    return binary_log("UNIHEADING", time_of(heading, "UNIHEADING"), UNIHEADING.pack(*heading_values(heading, heading.station)))


def heading_values(heading: ReceiverHeading, *stations: str) -> tuple[Value, ...]:
    """Return the values of UNIHEADING, HEADING and (with two stations) HEADING2."""
    kind = _TYPE_OF_SOLUTION.get(heading.solution or CarrierSolution.NONE, "NONE") if heading.valid else "NONE"
    status = "SOL_COMPUTED" if heading.valid else "INSUFFICIENT_OBS"
    angles = (heading.heading_rad, heading.pitch_rad, 0.0, heading.heading_sigma_rad, heading.pitch_sigma_rad)
    numbers = (heading.length_m, *(degrees(angle) for angle in angles))
    known = tuple(value if isfinite(value) else 0.0 for value in numbers)
    used = heading.satellites or 0
    return (SOLUTION_STATUS[status], POSITION_TYPE[kind], *known, *stations, used, used, used, used, 0, 0, 0, 0)
