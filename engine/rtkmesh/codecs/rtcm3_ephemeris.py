"""RTCM 3 ephemeris messages 1019, 1020, 1041, 1042, 1044, 1045 and 1046 (RTCM 10403.3, 3.5.9 and 3.5.12): tables, both ways.

The messages carry a truncated week and no time of transmission. The week is resolved near the stream's clock, toe is moved to
the neighbouring week when the week belongs to the transmission and toe lies beyond its end, and ``transmitted`` is the clock
if the ephemeris can have been sent then, else toe.
"""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, NO_ACCURACY_M, SISA_M, URA_M, Table, accuracy_index, accuracy_m
from rtkmesh.codecs.ephemerides import BEIDOU_FIT_S, GALILEO_FIT_S, GPS_FIT_S, NAVIC_FIT_S, QZSS_FIT_S, gps_fit_s
from rtkmesh.codecs.rtcm3_ephemeris_layouts import LAYOUTS
from rtkmesh.codecs.utc import leap_seconds_of, moscow_hour, utc_year
from rtkmesh.gnss.beidou import message_on_b1i
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, GST_WEEK_OFFSET, SECONDS_PER_DAY, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.signals import BEIDOU, GALILEO, GLONASS, GPS, NAVIC, NO_CHANNEL, QZSS, SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, nearest_week, resolve_week

# Without any other time, ten-bit weeks are taken to lie within 512 weeks of this one: 2019-04-07 to 2038-11-20.
_GLONASS_ACCURACY_M: Final = 5.0  # satellites before GLONASS-M send no F_T
ERA: Final = GpsTime(2560, 0.0)

_NO_SISA: Final = 255
_FIRST_PERIOD: Final = 5  # N4 of 2012 to 2015: earlier ones are junk
_SURE_S: Final = 2.0 * SECONDS_PER_DAY
_LAG_S: Final = 60.0  # the clock is that of the last epoch
_BESIDE_MIDNIGHT_S: Final = 3600.0
_SHIFT_WINDOW_S: Final = SECONDS_PER_DAY / 2.0  # toe is at most some hours from the transmission

Values = Mapping[str, float]
# Bits of the week, number of its week 0, and GPST minus the system's time.
_WEEKS: Final = {
    1019: (10, 0, 0.0), 1041: (10, 0, 0.0), 1042: (13, BDT_WEEK_OFFSET, -BDT_MINUS_GPST_S), 1044: (10, 0, 0.0),
    1045: (12, GST_WEEK_OFFSET, 0.0), 1046: (12, GST_WEEK_OFFSET, 0.0),
}  # fmt: skip


class EphemerisDecoder:
    """Decoder of one stream. Most messages repeat the last one of their satellite, which it remembers."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[bytes, Values, Ephemeris]] = {}  # by number and slot

    def decode(
        self, payload: bytes, number: int, clock: GpsTime | None, is_known: Callable[[Ephemeris], bool]
    ) -> tuple[Ephemeris | str, bool]:
        """Return the ephemeris of a message, or the reason of its rejection, and whether there is nothing new in it.

        Without a ``clock`` the weeks of 1019, 1041 and 1044 are resolved in ``ERA``; the others' are long enough. A message has
        nothing new if it repeats the last one of its satellite, whose ephemeris ``is_known`` says is the one that counts: then that is
        returned, with its own time of transmission.
        """
        layout = LAYOUTS[number]
        if 8 * len(payload) < layout.bits:
            return "too short", False
        key = number << 6 | (payload[1] & 15) << 2 | payload[2] >> 6
        last = self._last.get(key)
        if last is None or last[0] != payload:
            values = layout.read_bytes(payload)
        else:
            _, values, before = last
            if is_known(before) and _toe(number, values, clock) == before.toe:
                return before, True
        ephemeris = _DECODERS[number](values, clock)
        if not isinstance(ephemeris, str):
            self._last[key] = payload, values, ephemeris
        return ephemeris, False


def _toe(number: int, v: Values, clock: GpsTime | None) -> GpsTime | None:
    """Return the toe of an ephemeris message whose values are in their ranges, None if its date is not known."""
    if number == 1020:
        return _glonass_time(v["tb_s"], v, clock)
    bits, offset, shift_s = _WEEKS[number]
    week = offset + resolve_week(int(v["week"]), bits, GpsTime((clock or ERA).week - offset, 0.0))
    return _near_end_of_week(GpsTime.normalized(week, v["toe_s"] + shift_s), clock)


def _decode_gps(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    fit_s = gps_fit_s(int(v["iodc"])) if v["fit"] else GPS_FIT_S
    return _kepler(1019, GPS, v, clock, NavigationMessage.LNAV, fit_s, accuracy_m(URA_M, int(v["accuracy"])), (v["tgd_s"], 0.0))


def _decode_qzss(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    return _kepler(1044, QZSS, v, clock, NavigationMessage.LNAV, QZSS_FIT_S, accuracy_m(URA_M, int(v["accuracy"])), (v["tgd_s"], 0.0))


def _decode_navic(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    """The message has one issue, that of orbit and clock, and two bits of health: L5, S."""
    v = {**v, "iodc": v["iode"]}
    return _kepler(1041, NAVIC, v, clock, NavigationMessage.LNAV, NAVIC_FIT_S, accuracy_m(URA_M, int(v["accuracy"])), (v["tgd_s"], 0.0))


def _decode_beidou(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    message = message_on_b1i(BEIDOU * SATELLITES_PER_SYSTEM + int(v["slot"]))
    return _kepler(1042, BEIDOU, v, clock, message, BEIDOU_FIT_S, accuracy_m(URA_M, int(v["accuracy"])), (v["tgd1_s"], v["tgd2_s"]))


def _decode_fnav(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    health = int(v["health_e5a"]) << 4 | int(v["invalid_e5a"]) << 3
    return _galileo(1045, v, health, clock, NavigationMessage.FNAV, (v["bgd_e5a_s"], 0.0))


def _decode_inav(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    health = int(v["health_e5b"]) << 7 | int(v["invalid_e5b"]) << 6 | int(v["health_e1b"]) << 1 | int(v["invalid_e1b"])
    return _galileo(1046, v, health, clock, NavigationMessage.INAV, (v["bgd_e5a_s"], v["bgd_e5b_s"]))


def _galileo(
    number: int, v: Values, health: int, clock: GpsTime | None, message: NavigationMessage, delays_s: tuple[float, float]
) -> Ephemeris | str:  # fmt: skip
    """Health bits stand as in RINEX 3.05 table A8."""
    v = {**v, "iodc": v["iode"], "health": health}
    return _kepler(number, GALILEO, v, clock, message, GALILEO_FIT_S, accuracy_m(SISA_M, int(v["accuracy"])), delays_s)


def _kepler(
    number: int, system: int, v: Values, clock: GpsTime | None, message: NavigationMessage, fit_s: float, accuracy_m: float,
    group_delay_s: tuple[float, float],
) -> Ephemeris | str:  # fmt: skip
    """Return the ephemeris of decoded fields."""
    if not 1 <= v["slot"] < SATELLITES_PER_SYSTEM or v["toe_s"] >= SECONDS_PER_WEEK or v["toc_s"] >= SECONDS_PER_WEEK:
        return "satellite or time out of range"
    if not (4000.0 < v["sqrt_a"] < 8192.0 and v["eccentricity"] < 0.5):
        return "no orbit"
    toe = _toe(number, v, clock)
    assert toe is not None, "only GLONASS may have no date"
    return KeplerEphemeris(
        satellite=system * SATELLITES_PER_SYSTEM + int(v["slot"]), message=message, iode=int(v["iode"]), iodc=int(v["iodc"]), toe=toe,
        toc=nearest_week(v["toc_s"] + _WEEKS[number][2], toe), transmitted=_transmitted(toe, clock), health=int(v["health"]),
        accuracy_m=accuracy_m, fit_s=fit_s, sqrt_a=v["sqrt_a"], eccentricity=v["eccentricity"], m0_rad=v["m0_rad"],
        delta_n_radps=v["delta_n_radps"], omega0_rad=v["omega0_rad"], omega_rad=v["omega_rad"], omega_dot_radps=v["omega_dot_radps"],
        i0_rad=v["i0_rad"], idot_radps=v["idot_radps"], cuc_rad=v["cuc_rad"], cus_rad=v["cus_rad"], crc_m=v["crc_m"], crs_m=v["crs_m"],
        cic_rad=v["cic_rad"], cis_rad=v["cis_rad"], af0_s=v["af0_s"], af1=v["af1"], af2=v["af2"], group_delay_s=group_delay_s,
    )  # fmt: skip


def _near_end_of_week(toe: GpsTime, clock: GpsTime | None) -> GpsTime:
    """Return toe in the next or last week if that brings it within hours of a clock on the other side of the week's end."""
    if clock is None:
        return toe
    near = nearest_week(toe.tow_s, clock)
    if abs(near.week - toe.week) != 1 or abs(near - clock) >= _SHIFT_WINDOW_S:
        return toe
    return near if near.week != clock.week or near.week != (clock + _LAG_S).week else toe


def _transmitted(toe: GpsTime, clock: GpsTime | None) -> GpsTime:
    return clock if clock is not None and abs(clock - toe) < _SHIFT_WINDOW_S else toe


def _decode_glonass(v: Values, clock: GpsTime | None) -> Ephemeris | str:
    """Times of day are UTC + 3 h; the date is that of the clock, or N4 and NT where they are sent (GLONASS ICD 5.1, 4.4)."""
    radius2 = sum(v[f"position_{axis}_m"] ** 2 for axis in "xyz")
    if not 1 <= v["slot"] <= 27 or v["tb_s"] > SECONDS_PER_DAY or not 2.0e7**2 < radius2 < 3.2e7**2:
        return "satellite, time or position out of range"
    toe = _glonass_time(v["tb_s"], v, clock)
    if toe is None:
        return "date unknown"
    tk_s = v["tk_hours"] * 3600.0 + v["tk_minutes"] * 60.0 + v["tk_half_minutes"] * 30.0
    is_m = v["m"] > 0
    return GlonassEphemeris(
        satellite=GLONASS * SATELLITES_PER_SYSTEM + int(v["slot"]), channel=int(v["channel"]) - 7 if v["channel"] <= 20 else NO_CHANNEL,
        iode=int(v["tb_s"] / 900.0), toe=toe, transmitted=_near_time_of_day(tk_s - v["tb_s"] + toe.tow_s, toe),
        health=int(v["bn_msb"]),  # not ln: some receivers send junk in DF123
        accuracy_m=accuracy_m(GLONASS_FT_M, int(v["ft"])) if is_m else _GLONASS_ACCURACY_M, age_days=int(v["age_days"]),
        position_m=(v["position_x_m"], v["position_y_m"], v["position_z_m"]),
        velocity_mps=(v["velocity_x_mps"], v["velocity_y_mps"], v["velocity_z_mps"]),
        acceleration_mps2=(v["acceleration_x_mps2"], v["acceleration_y_mps2"], v["acceleration_z_mps2"]),
        tau_s=-v["tau_n_s"] + 0.0, gamma=v["gamma"], group_delay_s=v["delta_tau_n_s"] if is_m else 0.0,
    )  # fmt: skip


def _glonass_time(time_of_day_s: float, v: Values, clock: GpsTime | None) -> GpsTime | None:
    """Return the instant of a Moscow time of day: on the sent date unless the clock is more than two days from it.

    N4 is often zero, and sometimes junk; then the clock tells the four-year period.
    """
    sent = _sent_date(time_of_day_s, v, int(v["n4"]))
    if clock is None:
        return sent if sent is not None and v["n4"] >= _FIRST_PERIOD else None
    if sent is None or abs(sent - clock) > _SURE_S:
        sent = _sent_date(time_of_day_s, v, (utc_year(clock) - 1996) // 4 + 1)
    if sent is not None and abs(sent - clock) < _SURE_S:
        return _near_midnight(sent, clock)
    return _near_time_of_day(time_of_day_s - 10800.0 + leap_seconds_of(clock), clock)


def _sent_date(time_of_day_s: float, v: Values, n4: int) -> GpsTime | None:
    """Return the instant of a Moscow time of day on day NT of the four-year period ``n4`` (from 1 in 1996)."""
    if not (n4 and v["m"] and 1 <= v["nt_days"] <= 1461):
        return None
    return _of_moscow(n4, v["nt_days"], time_of_day_s)


@lru_cache(maxsize=64)
def _of_moscow(n4: int, nt_days: float, time_of_day_s: float) -> GpsTime:
    date = datetime(1996 + 4 * (n4 - 1), 1, 1, tzinfo=UTC) + timedelta(days=nt_days - 1.0)
    return GpsTime.from_utc(date + timedelta(seconds=time_of_day_s - 10800.0))


def _near_midnight(sent: GpsTime, clock: GpsTime) -> GpsTime:
    """Return the sent instant, moved by a day if that brings it, beside a midnight of Moscow, within an hour of the clock."""
    near = _near_time_of_day(sent.tow_s, clock)
    return near if abs(near - clock) < _BESIDE_MIDNIGHT_S and moscow_hour(near) in (0, 23) else sent


def _near_time_of_day(tow_s: float, near: GpsTime) -> GpsTime:
    """Return the instant nearest to ``near`` that is a whole number of days from ``tow_s``."""
    time = nearest_week(tow_s, near)
    return time + SECONDS_PER_DAY * round((near - time) / SECONDS_PER_DAY)


_DECODERS: Final[dict[int, Callable[[Values, GpsTime | None], Ephemeris | str]]] = {
    1019: _decode_gps,
    1020: _decode_glonass,
    1041: _decode_navic,
    1042: _decode_beidou,
    1044: _decode_qzss,
    1045: _decode_fnav,
    1046: _decode_inav,
}


def ephemeris_payload(ephemeris: Ephemeris) -> bytes:
    """Return the payload of an ephemeris' message; ValueError if a value does not fit its field or the system has no message."""
    number, values = _glonass_values(ephemeris) if isinstance(ephemeris, GlonassEphemeris) else _kepler_values(ephemeris)
    layout = LAYOUTS[number]
    fill = -layout.bits % 8
    return (layout.write({"number": float(number), **values}) << fill).to_bytes((layout.bits + fill) // 8, "big")


def _index(table: Table, sigma_m: float) -> int:
    return len(table) if sigma_m == NO_ACCURACY_M else accuracy_index(table, sigma_m)


def _kepler_values(e: KeplerEphemeris) -> tuple[int, dict[str, float]]:
    number = _number_of(e)
    shift_s = -BDT_MINUS_GPST_S if number == 1042 else 0.0
    values: dict[str, float] = {field.name: getattr(e, field.name) for field in LAYOUTS[number].fields if hasattr(e, field.name)}
    toe, toc = e.toe + -shift_s, e.toc + -shift_s
    values |= {"slot": e.satellite % SATELLITES_PER_SYSTEM, "toe_s": toe.tow_s, "toc_s": toc.tow_s}
    match number:
        case 1042:
            values |= {"week": (toe.week - BDT_WEEK_OFFSET) % 8192, "health": min(e.health, 1)}
            values |= {"tgd1_s": e.group_delay_s[0], "tgd2_s": e.group_delay_s[1], "accuracy": _index(URA_M, e.accuracy_m)}
        case 1045 | 1046:
            values |= {"week": (toe.week - GST_WEEK_OFFSET) % 4096, "bgd_e5a_s": e.group_delay_s[0], "bgd_e5b_s": e.group_delay_s[1]}
            index = _index(SISA_M, e.accuracy_m)
            values |= {"accuracy": index if index < len(SISA_M) else _NO_SISA}
            values |= {"health_e5a": e.health >> 4 & 3, "invalid_e5a": e.health >> 3 & 1, "health_e5b": e.health >> 7 & 3}
            values |= {"invalid_e5b": e.health >> 6 & 1, "health_e1b": e.health >> 1 & 3, "invalid_e1b": e.health & 1}
        case _:
            values |= {"week": toe.week % 1024, "tgd_s": e.group_delay_s[0], "accuracy": _index(URA_M, e.accuracy_m)}
            values |= {"fit": int(e.fit_s > GPS_FIT_S)}
    return number, values


def _number_of(e: KeplerEphemeris) -> int:
    system = e.satellite // SATELLITES_PER_SYSTEM
    if e.message is NavigationMessage.CNAV:
        raise ValueError("no RTCM 3 ephemeris message for CNAV")
    if system == GALILEO:
        return 1045 if e.message is NavigationMessage.FNAV else 1046
    try:
        return {GPS: 1019, QZSS: 1044, BEIDOU: 1042, NAVIC: 1041}[system]
    except KeyError:
        raise ValueError(f"no RTCM 3 ephemeris message for system {system}") from None


def _glonass_values(e: GlonassEphemeris) -> tuple[int, dict[str, float]]:
    moscow = e.toe.to_utc() + timedelta(hours=3)
    sent = e.transmitted.to_utc() + timedelta(hours=3)
    midnight = moscow.replace(hour=0, minute=0, second=0, microsecond=0)
    period = (moscow.year - 1996) // 4
    values: dict[str, float] = {
        "slot": e.satellite % SATELLITES_PER_SYSTEM, "channel": e.channel + 7, "almanac_health": 1, "almanac_health_available": 1,
        "tk_hours": sent.hour, "tk_minutes": sent.minute, "tk_half_minutes": sent.second // 30,
        "bn_msb": e.health & 1, "ln_3": e.health >> 1 & 1, "tb_s": (moscow - midnight).total_seconds(), "gamma": e.gamma,
        "tau_n_s": -e.tau_s, "delta_tau_n_s": e.group_delay_s, "age_days": e.age_days, "ft": _index(GLONASS_FT_M, e.accuracy_m),
        "m": 1, "n4": period + 1, "nt_days": (midnight - datetime(1996 + 4 * period, 1, 1, tzinfo=UTC)).days + 1,
    }  # fmt: skip
    for k, axis in enumerate("xyz"):
        values |= {f"position_{axis}_m": e.position_m[k], f"velocity_{axis}_mps": e.velocity_mps[k]}
        values |= {f"acceleration_{axis}_mps2": e.acceleration_mps2[k]}
    return 1020, values
