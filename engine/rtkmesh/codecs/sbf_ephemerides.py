"""Decoded navigation blocks of SBF to ephemerides, and back (mosaic-X5 reference guide 4.14, 4.2.3 to 4.2.7).

Angles are sent in semicircles, times in the system's own scale; all numbers are exact, because each is as fine as the satellite sent it.
"""

from math import hypot
from struct import Struct
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, NO_ACCURACY_M, SISA_M, URA_M, Table, accuracy_index, accuracy_m
from rtkmesh.codecs.ephemerides import BEIDOU_FIT_S, GALILEO_FIT_S, GPS_FIT_S, QZSS_FIT_S, gps_fit_s, kepler_ephemeris
from rtkmesh.codecs.sbf_signals import SATELLITE_OF, svid_of
from rtkmesh.gnss.beidou import message_on_b1i
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, PI_GPS
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, nearest_week

Values = dict[str, float]

GPS_NAV, GALILEO_NAV, GLONASS_NAV, BEIDOU_NAV, QZSS_NAV = "5891", "4002", "4004", "4081", "4095"
GPS_ION, BEIDOU_ION = "5893", "4120"
_SYSTEM_OF: Final = {GPS_NAV: GPS, GALILEO_NAV: GALILEO, GLONASS_NAV: GLONASS, BEIDOU_NAV: BEIDOU, QZSS_NAV: QZSS}
_IONOSPHERE: Final = {GPS_ION: "G", BEIDOU_ION: "C"}
NUMBERS: Final = frozenset((*_SYSTEM_OF, *_IONOSPHERE))

HEAD: Final = 14  # bytes of a block before these fields
_DO_NOT_USE: Final = -2e10
_INAV_SOURCE, _FNAV_SOURCE = 2, 16


class _Block:
    """The fields of a block behind its time: names and formats; angles (``*``) are semicircles."""

    def __init__(self, fields: str) -> None:
        parts = [field.split(":") for field in fields.split()]
        self._names = [name for name, _ in parts]
        self._units = [PI_GPS if form.endswith("*") else 1.0 for _, form in parts]
        self._struct = Struct("<" + "".join(form.rstrip("*") for _, form in parts))

    def read(self, data: bytes) -> Values | None:
        """Return the values by name, None if the block is too short."""
        if len(data) < HEAD + self._struct.size:
            return None
        numbers = self._struct.unpack_from(data, HEAD)
        return {name: number * unit for name, number, unit in zip(self._names, numbers, self._units, strict=True)}

    def write(self, values: Values) -> bytes:
        """Return the fields; those without a value are zero."""
        forms = self._struct.format[1:]
        numbers = [values.get(name, 0.0) / unit for name, unit in zip(self._names, self._units, strict=True)]
        return self._struct.pack(*(number if form in "fd" else round(number) for number, form in zip(numbers, forms, strict=True)))


_ORBIT: Final = (
    "tgd_s:f {second}toc_s:I af2:f af1:f af0_s:f crs_m:f delta_n_radps:f* m0_rad:d* cuc_rad:f eccentricity:d cus_rad:f sqrt_a:d toe_s:I "
    "cic_rad:f omega0_rad:d* cis_rad:f i0_rad:d* crc_m:f omega_rad:d* omega_dot_radps:f* idot_radps:f* toc_week:H toe_week:H"
)
_GPS: Final = _Block(
    "svid:B r1:B week:H l2_code:B ura:B health:B l2_data:B iodc:H iode:B iode3:B fit:B r2:B " + _ORBIT.replace("{second}", "")
)
_BEIDOU: Final = _Block("svid:B r1:B week:H ura:B health:B iodc:B iode:B r2:H " + _ORBIT.replace("{second}", "tgd2_s:f "))
_GALILEO: Final = _Block(
    "svid:B source:B sqrt_a:d m0_rad:d* eccentricity:d i0_rad:d* omega_rad:d* omega0_rad:d* omega_dot_radps:f* idot_radps:f* "
    "delta_n_radps:f* cuc_rad:f cus_rad:f crc_m:f crs_m:f cic_rad:f cis_rad:f toe_s:I toc_s:I af2:f af1:f af0_s:d toe_week:H toc_week:H "
    "iode:H health:H health_prs:B sisa_e5a:B sisa_e5b:B sisa_e6a:B bgd_e5a_s:f bgd_e5b_s:f bgd_e6a_s:f cnav:B"
)
_GLONASS: Final = _Block(
    "svid:B channel:B position_x:d position_y:d position_z:d velocity_x:f velocity_y:f velocity_z:f acceleration_x:f acceleration_y:f "
    "acceleration_z:f gamma:f tau_s:f delta_tau_s:f toe_s:I toe_week:H p1:B p2:B age_days:B health:B tb_min:H m:B p:B ln:B p4:B "
    "nt:H ft_cm:H"
)
_ION: Final = _Block("svid:B r1:B alpha0:f alpha1:f alpha2:f alpha3:f beta0:f beta1:f beta2:f beta3:f")


def read_navigation(data: bytes, kind: str, time: GpsTime) -> Ephemeris | KlobucharParameters | str:
    """Return what a block of NUMBERS that came at ``time`` says, or why it is refused."""
    return _read_ionosphere(data, kind) if kind in _IONOSPHERE else _read_ephemeris(data, kind, time)


def _read_ephemeris(data: bytes, kind: str, time: GpsTime) -> Ephemeris | str:
    values = {GALILEO_NAV: _GALILEO, GLONASS_NAV: _GLONASS, BEIDOU_NAV: _BEIDOU}.get(kind, _GPS).read(data)
    if values is None:
        return "length"
    satellite = int(SATELLITE_OF[int(values["svid"])])
    if satellite == 0 or satellite // SATELLITES_PER_SYSTEM != _SYSTEM_OF[kind]:
        return "satellite"
    if any(value != value or value <= _DO_NOT_USE for name, value in values.items() if not name.startswith("bgd")):
        return "value"
    if kind == GLONASS_NAV:
        found: Ephemeris | None = _glonass(satellite, values, time)
    elif kind == GALILEO_NAV:
        found = _galileo(satellite, values, time)
    else:
        found = _beidou(satellite, values, time) if kind == BEIDOU_NAV else _gps(satellite, values, time)
    return "value" if found is None else found


def _gps(satellite: int, v: Values, time: GpsTime) -> KeplerEphemeris | None:
    iode, iodc = int(v["iode"]), int(v["iodc"])
    if iode != int(v["iode3"]) or iode != iodc & 0xFF:
        return None
    half_s = gps_fit_s(iodc) if v["fit"] else GPS_FIT_S
    fit_s = QZSS_FIT_S if satellite // SATELLITES_PER_SYSTEM == QZSS else half_s
    return kepler_ephemeris(
        satellite, NavigationMessage.LNAV, v, time, (iode, iodc), fit_s,
        accuracy_m=accuracy_m(URA_M, int(v["ura"])), health=int(v["health"]), delays_s=(v["tgd_s"], 0.0),
    )  # fmt: skip


def _beidou(satellite: int, v: Values, time: GpsTime) -> KeplerEphemeris | None:
    in_gpst = {name: v[name] - BDT_MINUS_GPST_S for name in ("toe_s", "toc_s")}
    return kepler_ephemeris(
        satellite, message_on_b1i(satellite), v | in_gpst, time, (int(v["iode"]), int(v["iodc"])), BEIDOU_FIT_S,
        accuracy_m=accuracy_m(URA_M, int(v["ura"])), health=int(v["health"]), delays_s=(v["tgd_s"], v["tgd2_s"]),
    )  # fmt: skip


def _galileo(satellite: int, v: Values, time: GpsTime) -> KeplerEphemeris | None:
    """Health bits stand as in RINEX 3.05 table A8; those of signals that the block says nothing of are zero (healthy)."""
    if v["source"] not in (_INAV_SOURCE, _FNAV_SOURCE):
        return None
    is_inav, sent = v["source"] == _INAV_SOURCE, int(v["health"])
    e1b, e5b, e5a = (sent >> shift + 1 & 7 if sent >> shift & 1 else 0 for shift in (0, 4, 8))
    delays_s = tuple(v[name] if v[name] > _DO_NOT_USE else 0.0 for name in ("bgd_e5a_s", "bgd_e5b_s"))
    return kepler_ephemeris(
        satellite, NavigationMessage.INAV if is_inav else NavigationMessage.FNAV, v, time, (int(v["iode"]), int(v["iode"])), GALILEO_FIT_S,
        accuracy_m=accuracy_m(SISA_M, int(v["sisa_e5b" if is_inav else "sisa_e5a"])), health=e1b | e5b << 6 if is_inav else e5a << 3,
        delays_s=(delays_s[0], delays_s[1] if is_inav else 0.0),
    )  # fmt: skip


def _glonass(satellite: int, v: Values, time: GpsTime) -> GlonassEphemeris | None:
    position, velocity, acceleration = (
        (v[f"{name}_x"] * 1e3, v[f"{name}_y"] * 1e3, v[f"{name}_z"] * 1e3) for name in ("position", "velocity", "acceleration")
    )
    if not 25.1e6 < hypot(*position) < 25.9e6:
        return None
    return GlonassEphemeris(
        satellite=satellite, channel=int(v["channel"]) - 8, iode=int(v["tb_min"] / 15.0), toe=nearest_week(v["toe_s"], time),
        transmitted=time, health=int(v["health"]) >> 2 | int(v["ln"]) << 1, accuracy_m=v["ft_cm"] * 0.01 or NO_ACCURACY_M,
        age_days=int(v["age_days"]), position_m=position, velocity_mps=velocity, acceleration_mps2=acceleration, tau_s=-v["tau_s"] + 0.0,
        gamma=v["gamma"], group_delay_s=v["delta_tau_s"],
    )  # fmt: skip


def _read_ionosphere(data: bytes, kind: str) -> KlobucharParameters | str:
    v = _ION.read(data)
    if v is None:
        return "length"
    alpha, beta = ((v[f"{name}0"], v[f"{name}1"], v[f"{name}2"], v[f"{name}3"]) for name in ("alpha", "beta"))
    if not all(abs(value) < 1e9 for value in (*alpha, *beta)):
        return "value"
    return KlobucharParameters(_IONOSPHERE[kind], alpha, beta)


def ephemeris_fields(e: Ephemeris) -> tuple[str, bytes]:
    """Return the block that an ephemeris is sent in, and its fields; ValueError for a system without one."""
    values: Values = {name: getattr(e, name) for name in e.__slots__ if isinstance(getattr(e, name), int | float)}
    values["svid"] = svid_of(e.satellite)
    if isinstance(e, GlonassEphemeris):
        return GLONASS_NAV, _GLONASS.write(values | _glonass_fields(e))
    system = e.satellite // SATELLITES_PER_SYSTEM
    values |= {"toe_s": e.toe.tow_s, "toc_s": e.toc.tow_s, "toe_week": e.toe.week % 1024, "toc_week": e.toc.week % 1024}
    if system == BEIDOU:
        return BEIDOU_NAV, _BEIDOU.write(values | _beidou_fields(e))
    if system == GALILEO:
        return GALILEO_NAV, _GALILEO.write(values | _galileo_fields(e))
    if system not in (GPS, QZSS):
        raise ValueError(f"no SBF block for an ephemeris of system {system}")
    values |= {"tgd_s": e.group_delay_s[0], "ura": _index(URA_M, e.accuracy_m), "iode3": e.iode, "fit": float(e.fit_s > GPS_FIT_S)}
    return GPS_NAV if system == GPS else QZSS_NAV, _GPS.write(values)


def _index(table: Table, sigma_m: float) -> int:
    return len(table) if sigma_m == NO_ACCURACY_M else accuracy_index(table, sigma_m)


def _beidou_fields(e: KeplerEphemeris) -> Values:
    toe, toc = e.toe + BDT_MINUS_GPST_S, e.toc + BDT_MINUS_GPST_S
    return {
        "toe_s": toe.tow_s, "toc_s": toc.tow_s, "toe_week": toe.week - BDT_WEEK_OFFSET, "toc_week": toc.week - BDT_WEEK_OFFSET,
        "tgd_s": e.group_delay_s[0], "tgd2_s": e.group_delay_s[1], "ura": _index(URA_M, e.accuracy_m), "health": min(e.health, 1),
    }  # fmt: skip


def _galileo_fields(e: KeplerEphemeris) -> Values:
    is_inav = e.message is NavigationMessage.INAV
    index = _index(SISA_M, e.accuracy_m)
    sisa = index if index < len(SISA_M) else 255
    e1b, e5b, e5a = e.health & 7, e.health >> 6 & 7, e.health >> 3 & 7
    health = (1 | e1b << 1) | (1 | e5b << 1) << 4 if is_inav else (1 | e5a << 1) << 8
    return {
        "source": _INAV_SOURCE if is_inav else _FNAV_SOURCE, "health": health, "sisa_e5a": 255 if is_inav else sisa,
        "sisa_e5b": sisa if is_inav else 255, "sisa_e6a": 255, "bgd_e5a_s": e.group_delay_s[0],
        "bgd_e5b_s": e.group_delay_s[1] if is_inav else _DO_NOT_USE, "bgd_e6a_s": _DO_NOT_USE,
    }  # fmt: skip


def _glonass_fields(e: GlonassEphemeris) -> Values:
    values: Values = {
        "channel": e.channel + 8, "tau_s": -e.tau_s, "delta_tau_s": e.group_delay_s, "toe_s": e.toe.tow_s, "toe_week": e.toe.week % 1024,
        "health": (e.health & 1) << 2, "ln": e.health >> 1 & 1, "tb_min": e.iode * 15, "m": 1,
        "ft_cm": round(e.accuracy_m * 100.0) if e.accuracy_m <= GLONASS_FT_M[-1] and e.accuracy_m != NO_ACCURACY_M else 0,
    }  # fmt: skip
    for name, three in (("position", e.position_m), ("velocity", e.velocity_mps), ("acceleration", e.acceleration_mps2)):
        values |= {f"{name}_{axis}": value / 1e3 for axis, value in zip("xyz", three, strict=True)}
    return values


def ionosphere_fields(parameters: KlobucharParameters) -> tuple[str, bytes]:
    """Return the block that ionosphere coefficients are sent in, and its fields; ValueError for a system without one."""
    kind = next((kind for kind, system in _IONOSPHERE.items() if system == parameters.system), None)
    if kind is None:
        raise ValueError(f"no SBF block for the ionosphere of system {parameters.system!r}")
    values: Values = {"svid": 1 if kind == GPS_ION else 141}
    values |= {f"{name}{k}": v for name, four in (("alpha", parameters.alpha), ("beta", parameters.beta)) for k, v in enumerate(four)}
    return kind, _ION.write(values)
