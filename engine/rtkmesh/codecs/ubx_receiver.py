"""UBX messages in which a receiver tells what it computes itself and how it is (u-blox F9 HPG 1.32 interface description, 3.15 to 3.18).

NAV-RELPOSNED (version 0 of the M8P as well), NAV-SVIN, NAV-SAT, TIM-TM2, MON-HW, MON-RF, MON-COMMS, MON-VER, RXM-RTCM, ACK. Each function
takes a payload that is as long as its table says, and returns the value or the reason of a rejection.
"""

from collections.abc import Callable
from math import atan2, hypot, nan, radians
from struct import Struct
from typing import Final

from rtkmesh.codecs.ubx_signals import GNSS_IDS, SATELLITE_OF
from rtkmesh.codecs.utc import leap_seconds_of
from rtkmesh.gnss.constants import SECONDS_PER_WEEK
from rtkmesh.gnss.receiver import (
    AntennaState,
    CarrierSolution,
    CommandAnswer,
    CorrectionUse,
    EventMark,
    Jamming,
    PortsHealth,
    PortUse,
    ReceiverHeading,
    ReceiverReport,
    ReceiverVersion,
    RfBlock,
    RfHealth,
    SatelliteInView,
    SatellitesInView,
    SurveyIn,
    Vector,
)
from rtkmesh.gnss.time import GpsTime, nearest_week

Found = ReceiverReport | str
Reader = Callable[[bytes, GpsTime | None], Found]

_RELPOSNED_0: Final = Struct("<BxHIiiibbbxIIII")
_RELPOSNED_1: Final = Struct("<BxHIiiiii4xbbbbIIIII4xI")
_SVIN: Final = Struct("<B3xIIiiibbbxIIBB2x")
_SAT_HEADER, _SAT_ROW = Struct("<IBB2x"), Struct("<BBBbhhI")
_TM2: Final = Struct("<BBHHHIIIII")
_HW: Final = Struct("<16xHHBBB")
_RF_HEADER, _RF_ROW = Struct("<BB2x"), Struct("<BBBB4x4xHHB")
_COMMS_HEADER, _COMMS_ROW = Struct("<BBB5x"), Struct("<HHIBBHIBBH8x8xI")
_RTCM: Final = Struct("<BBHHH")
_VERSION_BYTES, _HARDWARE_BYTES, _EXTENSION_BYTES = 30, 10, 30

# Bits of the flags of NAV-RELPOSNED.
_FIX_OK, _RELATIVE_VALID, _REFERENCE_MISSED, _HEADING_VALID, _NORMALIZED = 1, 4, 0xC0, 0x100, 0x200
_TENTH_MM: Final = 1e-4
_CM: Final = 1e-2
_HEADING_UNIT_DEG: Final = 1e-5
# Bits of the flags of TIM-TM2, and the time bases.
_NEW_FALLING, _TIME_VALID, _NEW_RISING = 4, 0x40, 0x80
_GNSS_TIME, _UTC = 1, 2
_AGC_RANGE, _INDICATOR_RANGE, _JAM_FROM_END = 8191.0, 255.0, 15

_ANTENNA: Final = (AntennaState.INITIALISING, AntennaState.UNKNOWN, AntennaState.OK, AntennaState.SHORT, AntennaState.OPEN)
_JAMMING: Final = (Jamming.UNKNOWN, Jamming.OK, Jamming.WARNING, Jamming.CRITICAL)
_PORTS: Final = {0x0000: "i2c", 0x0100: "uart1", 0x0201: "uart2", 0x0300: "usb", 0x0400: "spi"}


def time_of_week(tow_ms: int, near: GpsTime | None) -> GpsTime | None:
    """Return the instant of a time of week nearest to ``near``, None where that is not known or it is none."""
    return None if near is None or tow_ms >= SECONDS_PER_WEEK * 1e3 else nearest_week(tow_ms / 1e3, near)


def _relative_position(payload: bytes, near: GpsTime | None) -> Found:
    if payload[0] == 0:
        _, station, tow_ms, *numbers, flags = _RELPOSNED_0.unpack_from(payload)
        centimetres, parts, sigmas = numbers[:3], numbers[3:6], numbers[6:9]
        length_sigma_m = heading_deg = heading_sigma_deg = nan
    elif len(payload) >= _RELPOSNED_1.size:
        _, station, tow_ms, *numbers, flags = _RELPOSNED_1.unpack_from(payload)
        centimetres, parts, sigmas = numbers[:3], numbers[5:8], numbers[9:12]
        length_sigma_m, heading_deg, heading_sigma_deg = (
            numbers[12] * _TENTH_MM,
            numbers[4] * _HEADING_UNIT_DEG,
            numbers[13] * _HEADING_UNIT_DEG,
        )
    else:
        return "length"
    valid = bool(flags & _FIX_OK and flags & _RELATIVE_VALID)
    known = valid and not flags & _NORMALIZED
    north_m, east_m, down_m = (cm * _CM + part * _TENTH_MM for cm, part in zip(centimetres, parts, strict=True))
    sigma_m: Vector = (sigmas[0] * _TENTH_MM, sigmas[1] * _TENTH_MM, sigmas[2] * _TENTH_MM)
    length_m = hypot(north_m, east_m, down_m) if known else nan
    pointing = valid and bool(flags & _HEADING_VALID)
    tilted = pointing and length_m > 0.0
    return ReceiverHeading(
        time_of_week(tow_ms, near), "NAV-RELPOSNED", CarrierSolution(min(flags >> 3 & 3, 2)),
        heading_rad=radians(heading_deg % 360.0) if pointing else nan, heading_sigma_rad=radians(heading_sigma_deg) if pointing else nan,
        pitch_rad=atan2(-down_m, hypot(north_m, east_m)) if tilted else nan, pitch_sigma_rad=sigma_m[2] / length_m if tilted else nan,
        length_m=length_m, length_sigma_m=length_sigma_m if known else nan, baseline_ned_m=(north_m, east_m, down_m) if known else None,
        baseline_sigma_ned_m=sigma_m if known else None, extrapolated=bool(flags & _REFERENCE_MISSED), station=str(station),
    )  # fmt: skip


def _survey_in(payload: bytes, near: GpsTime | None) -> Found:
    _, tow_ms, duration_s, x, y, z, x_part, y_part, z_part, accuracy, observations, valid, active = _SVIN.unpack_from(payload)
    mean = (x * _CM + x_part * _TENTH_MM, y * _CM + y_part * _TENTH_MM, z * _CM + z_part * _TENTH_MM)
    begun = observations > 0
    return SurveyIn(
        time_of_week(tow_ms, near), bool(active), bool(valid), duration_s, observations, mean if begun else None,
        accuracy * _TENTH_MM if begun else nan,
    )  # fmt: skip


def _satellites(payload: bytes, near: GpsTime | None) -> Found:
    tow_ms, _, count = _SAT_HEADER.unpack_from(payload)
    if len(payload) < _SAT_HEADER.size + count * _SAT_ROW.size:
        return "length"
    rows = (_satellite(*_SAT_ROW.unpack_from(payload, _SAT_HEADER.size + k * _SAT_ROW.size)) for k in range(count))
    return SatellitesInView(time_of_week(tow_ms, near), tuple(row for row in rows if row is not None))


def _satellite(gnss: int, sv: int, cn0: int, elevation_deg: int, azimuth_deg: int, residual: int, flags: int) -> SatelliteInView | None:
    satellite = int(SATELLITE_OF[gnss, sv]) if gnss < GNSS_IDS else 0
    if satellite == 0:
        return None
    seen = -90 <= elevation_deg <= 90
    return SatelliteInView(
        satellite, float(cn0) if cn0 else nan, radians(elevation_deg) if seen else nan, radians(azimuth_deg % 360) if seen else nan,
        residual * 0.1, flags & 7, bool(flags >> 3 & 1), {1: True, 2: False}.get(flags >> 4 & 3), bool(flags >> 6 & 1),
    )  # fmt: skip


def _event_mark(payload: bytes, near: GpsTime | None) -> Found:
    del near
    channel, flags, count, *numbers, accuracy_ns = _TM2.unpack_from(payload)
    rising_week, falling_week, rising_ms, rising_ns, falling_ms, falling_ns = numbers
    rising = _edge(flags, _NEW_RISING, rising_week, rising_ms, rising_ns)
    falling = _edge(flags, _NEW_FALLING, falling_week, falling_ms, falling_ns)
    return EventMark(channel, rising, falling, count, accuracy_ns * 1e-9)


def _edge(flags: int, new: int, week: int, tow_ms: int, part_ns: int) -> GpsTime | None:
    """Return the instant of an edge: None if it is no new one, not valid, or in the receiver's own time, which is nobody else's."""
    base = flags >> 3 & 3
    if not (flags & new and flags & _TIME_VALID and base in (_GNSS_TIME, _UTC)) or tow_ms >= SECONDS_PER_WEEK * 1e3 or part_ns >= 1_000_000:
        return None
    time = GpsTime(week, tow_ms / 1e3) + part_ns * 1e-9
    return time if base == _GNSS_TIME else time + leap_seconds_of(time)


def _block(number: int, antenna: int, power: int, jamming: int, indicator: int, gain: int, noise: int) -> RfBlock:
    return RfBlock(
        number, _ANTENNA[antenna] if antenna < len(_ANTENNA) else AntennaState.UNKNOWN, {0: False, 1: True}.get(power),
        _JAMMING[jamming & 3], indicator / _INDICATOR_RANGE, gain / _AGC_RANGE, noise,
    )  # fmt: skip


def _hardware(payload: bytes, near: GpsTime | None) -> Found:
    del near
    noise, gain, antenna, power, flags = _HW.unpack_from(payload)
    indicator = payload[len(payload) - _JAM_FROM_END]  # after 17 pins, on older receivers 25
    return RfHealth("MON-HW", (_block(0, antenna, power, flags >> 2, indicator, gain, noise),))


def _radio(payload: bytes, near: GpsTime | None) -> Found:
    del near
    _, count = _RF_HEADER.unpack_from(payload)
    stride = (len(payload) - _RF_HEADER.size) // max(count, 1)  # 24 bytes; 20 of early firmware, without the last reserved ones
    if count and stride < _RF_ROW.size:
        return "length"
    rows = [_RF_ROW.unpack_from(payload, _RF_HEADER.size + k * stride) for k in range(count)]
    blocks = (_block(block, antenna, power, flags, indicator, gain, noise) for block, flags, antenna, power, noise, gain, indicator in rows)
    return RfHealth("MON-RF", tuple(blocks))


def _ports(payload: bytes, near: GpsTime | None) -> Found:
    del near
    _, count, errors = _COMMS_HEADER.unpack_from(payload)
    if len(payload) < _COMMS_HEADER.size + count * _COMMS_ROW.size:
        return "length"
    rows = [_COMMS_ROW.unpack_from(payload, _COMMS_HEADER.size + k * _COMMS_ROW.size) for k in range(count)]
    return PortsHealth(bool(errors & 1), bool(errors & 2), tuple(_port(*row) for row in rows))


def _port(
    port: int, tx_pending: int, tx_bytes: int, tx_use: int, _tx_peak: int,
    rx_pending: int, rx_bytes: int, rx_use: int, _rx_peak: int, overruns: int, skipped: int,
) -> PortUse:  # fmt: skip
    name = _PORTS.get(port, f"{port:04x}")
    return PortUse(name, tx_pending, tx_bytes, tx_use / 100.0, rx_pending, rx_bytes, rx_use / 100.0, overruns, skipped)


def _version(payload: bytes, near: GpsTime | None) -> Found:
    del near
    first = _VERSION_BYTES + _HARDWARE_BYTES
    extensions = tuple(_text(payload[at : at + _EXTENSION_BYTES]) for at in range(first, len(payload), _EXTENSION_BYTES))
    model = next((text.removeprefix("MOD=") for text in extensions if text.startswith("MOD=")), "")
    return ReceiverVersion(model, _text(payload[:_VERSION_BYTES]), _text(payload[_VERSION_BYTES:first]), extensions)


def _text(field: bytes) -> str:
    return "".join(character for character in field.split(b"\0")[0].decode("ascii", "replace") if character.isprintable())


def _corrections(payload: bytes, near: GpsTime | None) -> Found:
    del near
    version, flags, subtype, station, message = _RTCM.unpack_from(payload)
    used = {1: False, 2: True}.get(flags >> 1 & 3) if version >= 2 else None
    return CorrectionUse(message, subtype, station, bool(flags & 1), used)


def _acknowledged(payload: bytes, near: GpsTime | None) -> Found:
    del near
    return CommandAnswer(f"ubx {payload[0]:02x}-{payload[1]:02x}", accepted=True, text="ACK-ACK")


def _refused(payload: bytes, near: GpsTime | None) -> Found:
    del near
    return CommandAnswer(f"ubx {payload[0]:02x}-{payload[1]:02x}", accepted=False, text="ACK-NAK")


# Kind to the least length of its payload and its reader.
READERS: Final[dict[str, tuple[int, Reader]]] = {
    "01-3c": (_RELPOSNED_0.size, _relative_position),
    "01-3b": (_SVIN.size, _survey_in),
    "01-35": (_SAT_HEADER.size, _satellites),
    "0d-03": (_TM2.size, _event_mark),
    "0a-09": (60, _hardware),
    "0a-38": (_RF_HEADER.size, _radio),
    "0a-36": (_COMMS_HEADER.size, _ports),
    "0a-04": (_VERSION_BYTES + _HARDWARE_BYTES, _version),
    "02-32": (_RTCM.size, _corrections),
    "05-01": (2, _acknowledged),
    "05-00": (2, _refused),
}


def read_report(kind: str, payload: bytes, near: GpsTime | None) -> Found:
    """Return what a message of ``READERS`` says, or why it is rejected; ``near`` settles the week of its time of week."""
    least, reader = READERS[kind]
    return "length" if len(payload) < least else reader(payload, near)
