"""Fields of the RTCM 3 ephemeris messages 1019, 1020, 1041, 1042, 1044, 1045 and 1046 (RTCM 10403.3, 3.5.9 and 3.5.12)."""

from collections.abc import Iterable
from math import ldexp
from typing import Final

from rtkmesh.codecs.bits import Coding, Field, Layout
from rtkmesh.gnss.constants import PI_GPS

_S, _M = Coding.TWOS_COMPLEMENT, Coding.SIGN_MAGNITUDE

Row = tuple[str, int] | tuple[str, int, float] | tuple[str, int, float, Coding]


def _layout(name: str, rows: Iterable[Row]) -> Layout:
    """Return the layout of fields that follow one another, as (name, bits, scale, coding)."""
    fields: list[Field] = []
    at = 0
    for row in rows:
        part = ((at, row[1]),)
        if len(row) == 4:
            fields.append(Field(row[0], part, row[2], row[3]))
        else:
            fields.append(Field(row[0], part, row[2] if len(row) == 3 else 1.0))
        at += row[1]
    return Layout(name, at, tuple(fields))


def _two(exponent: int) -> float:
    return ldexp(1.0, exponent)


def _pi(exponent: int) -> float:
    return ldexp(PI_GPS, exponent)


_ANGLE: Final = (32, _pi(-31), _S)
_RATE14: Final = (14, _pi(-43), _S)
_RATE16: Final = (16, _pi(-43), _S)
_RATE24: Final = (24, _pi(-43), _S)
_HARMONIC: Final = (16, _two(-29), _S)
_RADIUS: Final = (16, _two(-5), _S)
_ECCENTRICITY: Final = (32, _two(-33))
_ROOT: Final = (32, _two(-19))

_GPS: Final = _layout("1019", (
    ("number", 12), ("slot", 6), ("week", 10), ("accuracy", 4), ("l2_code", 2), ("idot_radps", *_RATE14), ("iode", 8), ("toc_s", 16, 16.0),
    ("af2", 8, _two(-55), _S), ("af1", 16, _two(-43), _S), ("af0_s", 22, _two(-31), _S), ("iodc", 10), ("crs_m", *_RADIUS),
    ("delta_n_radps", *_RATE16), ("m0_rad", *_ANGLE), ("cuc_rad", *_HARMONIC), ("eccentricity", *_ECCENTRICITY), ("cus_rad", *_HARMONIC),
    ("sqrt_a", *_ROOT), ("toe_s", 16, 16.0), ("cic_rad", *_HARMONIC), ("omega0_rad", *_ANGLE), ("cis_rad", *_HARMONIC), ("i0_rad", *_ANGLE),
    ("crc_m", *_RADIUS), ("omega_rad", *_ANGLE), ("omega_dot_radps", *_RATE24), ("tgd_s", 8, _two(-31), _S), ("health", 6), ("l2p_flag", 1),
    ("fit", 1),
))  # fmt: skip

_QZSS: Final = _layout("1044", (
    ("number", 12), ("slot", 4), ("toc_s", 16, 16.0), ("af2", 8, _two(-55), _S), ("af1", 16, _two(-43), _S), ("af0_s", 22, _two(-31), _S),
    ("iode", 8), ("crs_m", *_RADIUS), ("delta_n_radps", *_RATE16), ("m0_rad", *_ANGLE), ("cuc_rad", *_HARMONIC),
    ("eccentricity", *_ECCENTRICITY), ("cus_rad", *_HARMONIC), ("sqrt_a", *_ROOT), ("toe_s", 16, 16.0), ("cic_rad", *_HARMONIC),
    ("omega0_rad", *_ANGLE), ("cis_rad", *_HARMONIC), ("i0_rad", *_ANGLE), ("crc_m", *_RADIUS), ("omega_rad", *_ANGLE),
    ("omega_dot_radps", *_RATE24), ("idot_radps", *_RATE14), ("l2_code", 2), ("week", 10), ("accuracy", 4), ("health", 6),
    ("tgd_s", 8, _two(-31), _S), ("iodc", 10), ("fit", 1),
))  # fmt: skip

_BEIDOU: Final = _layout("1042", (
    ("number", 12), ("slot", 6), ("week", 13), ("accuracy", 4), ("idot_radps", *_RATE14), ("iode", 5), ("toc_s", 17, 8.0),
    ("af2", 11, _two(-66), _S), ("af1", 22, _two(-50), _S), ("af0_s", 24, _two(-33), _S), ("iodc", 5), ("crs_m", 18, _two(-6), _S),
    ("delta_n_radps", *_RATE16), ("m0_rad", *_ANGLE), ("cuc_rad", 18, _two(-31), _S), ("eccentricity", *_ECCENTRICITY),
    ("cus_rad", 18, _two(-31), _S), ("sqrt_a", *_ROOT), ("toe_s", 17, 8.0), ("cic_rad", 18, _two(-31), _S), ("omega0_rad", *_ANGLE),
    ("cis_rad", 18, _two(-31), _S), ("i0_rad", *_ANGLE), ("crc_m", 18, _two(-6), _S), ("omega_rad", *_ANGLE), ("omega_dot_radps", *_RATE24),
    ("tgd1_s", 10, 1e-10, _S), ("tgd2_s", 10, 1e-10, _S), ("health", 1),
))  # fmt: skip

_GALILEO_ROWS: Final[tuple[Row, ...]] = (
    ("number", 12), ("slot", 6), ("week", 12), ("iode", 10), ("accuracy", 8), ("idot_radps", *_RATE14), ("toc_s", 14, 60.0),
    ("af2", 6, _two(-59), _S), ("af1", 21, _two(-46), _S), ("af0_s", 31, _two(-34), _S), ("crs_m", *_RADIUS), ("delta_n_radps", *_RATE16),
    ("m0_rad", *_ANGLE), ("cuc_rad", *_HARMONIC), ("eccentricity", *_ECCENTRICITY), ("cus_rad", *_HARMONIC), ("sqrt_a", *_ROOT),
    ("toe_s", 14, 60.0), ("cic_rad", *_HARMONIC), ("omega0_rad", *_ANGLE), ("cis_rad", *_HARMONIC), ("i0_rad", *_ANGLE),
    ("crc_m", *_RADIUS), ("omega_rad", *_ANGLE), ("omega_dot_radps", *_RATE24), ("bgd_e5a_s", 10, _two(-32), _S),
)  # fmt: skip
_FNAV: Final = _layout("1045", (*_GALILEO_ROWS, ("health_e5a", 2), ("invalid_e5a", 1), ("reserved", 7)))
_INAV: Final = _layout("1046", (
    *_GALILEO_ROWS, ("bgd_e5b_s", 10, _two(-32), _S), ("health_e5b", 2), ("invalid_e5b", 1), ("health_e1b", 2), ("invalid_e1b", 1),
    ("reserved", 2),
))  # fmt: skip

_NAVIC_HARMONIC: Final = (15, _two(-28), _S)
_NAVIC_RADIUS: Final = (15, _two(-4), _S)
_NAVIC_RATE: Final = (22, _pi(-41), _S)
_NAVIC: Final = _layout("1041", (
    ("number", 12), ("slot", 6), ("week", 10), ("af0_s", 22, _two(-31), _S), ("af1", 16, _two(-43), _S), ("af2", 8, _two(-55), _S),
    ("accuracy", 4), ("toc_s", 16, 16.0), ("tgd_s", 8, _two(-31), _S), ("delta_n_radps", *_NAVIC_RATE), ("iode", 8), ("reserved", 10),
    ("health", 2), ("cuc_rad", *_NAVIC_HARMONIC), ("cus_rad", *_NAVIC_HARMONIC), ("cic_rad", *_NAVIC_HARMONIC),
    ("cis_rad", *_NAVIC_HARMONIC), ("crc_m", *_NAVIC_RADIUS), ("crs_m", *_NAVIC_RADIUS), ("idot_radps", *_RATE14), ("m0_rad", *_ANGLE),
    ("toe_s", 16, 16.0), ("eccentricity", *_ECCENTRICITY), ("sqrt_a", *_ROOT), ("omega0_rad", *_ANGLE), ("omega_rad", *_ANGLE),
    ("omega_dot_radps", *_NAVIC_RATE), ("i0_rad", *_ANGLE), ("spare", 4),
))  # fmt: skip

_KM: Final = 1e3


def _axis(name: str) -> tuple[Row, ...]:
    return (
        (f"velocity_{name}_mps", 24, _KM * _two(-20), _M),
        (f"position_{name}_m", 27, _KM * _two(-11), _M),
        (f"acceleration_{name}_mps2", 5, _KM * _two(-30), _M),
    )


_GLONASS: Final = _layout("1020", (
    ("number", 12), ("slot", 6), ("channel", 5), ("almanac_health", 1), ("almanac_health_available", 1), ("p1", 2), ("tk_hours", 5),
    ("tk_minutes", 6), ("tk_half_minutes", 1), ("bn_msb", 1), ("p2", 1), ("tb_s", 7, 900.0), *_axis("x"), *_axis("y"), *_axis("z"),
    ("p3", 1), ("gamma", 11, _two(-40), _M), ("p", 2), ("ln_3", 1), ("tau_n_s", 22, _two(-30), _M), ("delta_tau_n_s", 5, _two(-30), _M),
    ("age_days", 5), ("p4", 1), ("ft", 4), ("nt_days", 11), ("m", 2), ("additional", 1), ("na_days", 11), ("tau_c_s", 32, _two(-31), _M),
    ("n4", 5), ("tau_gps_s", 22, _two(-30), _M), ("ln_5", 1), ("reserved", 7),
))  # fmt: skip

LAYOUTS: Final = {1019: _GPS, 1020: _GLONASS, 1041: _NAVIC, 1042: _BEIDOU, 1044: _QZSS, 1045: _FNAV, 1046: _INAV}
