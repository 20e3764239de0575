"""RTCM 3 ephemeris messages: round trips, weeks and days near their ends, refusals."""

from dataclasses import fields, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.bits import Coding
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS, EphemerisDecoder, ephemeris_payload
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassEphemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime, resolve_week

NOW = GpsTime(2400, 302400.0)


def decode_ephemeris(payload: bytes, number: int, clock: GpsTime | None) -> Ephemeris | str:
    return EphemerisDecoder().decode(payload, number, clock, lambda _: False)[0]


def payload_of(number: int, values: dict[str, float]) -> bytes:
    layout = LAYOUTS[number]
    fill = -layout.bits % 8
    return (layout.write({"number": number, **values}) << fill).to_bytes((layout.bits + fill) // 8, "big")


@st.composite
def messages(draw: st.DrawFn) -> tuple[int, bytes]:
    """Payloads with random bits in every field that may have any, and a possible orbit and time in the others."""
    number = draw(st.sampled_from(sorted(LAYOUTS)))
    layout, values = LAYOUTS[number], dict[str, float]()
    for field in layout.fields:
        code = draw(st.integers(0, (1 << field.length) - 1))
        if field.coding is Coding.SIGN_MAGNITUDE and code == 1 << (field.length - 1):
            code = 0  # minus zero does not come back as such
        values[field.name] = field.coding.decode(code, field.length) * field.scale
    values |= {
        "sqrt_a": 5153.7,
        "eccentricity": draw(st.floats(0.0, 0.4)),
        "slot": draw(st.integers(1, 10)),
        "number": number,
        "reserved": 0,
        "ln_3": 0,
    }
    values |= {"week": {1042: NOW.week - 1356, 1045: NOW.week - 1024, 1046: NOW.week - 1024}.get(number, NOW.week) % 1024, "l2_code": 0}
    if number in (1042, 1045, 1046):
        values["week"] = NOW.week - (1356 if number == 1042 else 1024)
    values |= {
        "toe_s": 300000.0,
        "toc_s": 302400.0,
        "l2p_flag": 0,
        "tb_s": 900.0 * draw(st.integers(1, 95)),
        "channel": draw(st.integers(0, 20)),
    }
    values |= {
        "position_x_m": 1.2e7,
        "position_y_m": -1.5e7,
        "position_z_m": 1.6e7,
        "n4": 8,
        "nt_days": 738,
        "tk_hours": 3,
        "tk_minutes": 20,
        "m": 1,
    }
    values |= {"almanac_health": 1, "almanac_health_available": 1, "fit": 0}
    values |= dict.fromkeys(
        ("p1", "p2", "p3", "p", "p4", "additional", "na_days", "tau_c_s", "tau_gps_s", "ln_5", "tk_half_minutes", "spare"), 0
    )
    return number, payload_of(number, {name: value for name, value in values.items() if any(f.name == name for f in layout.fields)})


@settings(max_examples=60, deadline=None)
@given(message=messages())
def test_a_message_decodes_and_encodes_to_the_same_bytes(message: tuple[int, bytes]):
    """Decoding loses nothing that the ephemeris has a place for: encoding it again gives the same payload, bit by bit."""
    number, payload = message
    ephemeris = decode_ephemeris(payload, number, NOW)
    assert not isinstance(ephemeris, str)
    again = decode_ephemeris(ephemeris_payload(ephemeris), number, NOW)
    assert again == ephemeris
    sent, back = (
        LAYOUTS[number].read(int.from_bytes(p, "big") >> (-LAYOUTS[number].bits % 8)) for p in (payload, ephemeris_payload(ephemeris))
    )
    spare = {"accuracy", "ft"} if number in (1020, 1045, 1046) else set[str]()  # spare indices all mean 'not known'
    assert {name: value for name, value in sent.items() if name not in spare} == {n: v for n, v in back.items() if n not in spare}


def a_gps_ephemeris(toe: GpsTime, **changes: Any) -> KeplerEphemeris:
    ephemeris = KeplerEphemeris(
        satellite=satellite_number("G05"), message=NavigationMessage.LNAV, iode=33, iodc=33, toe=toe, toc=toe, transmitted=toe, health=0,
        accuracy_m=2.8, fit_s=7200.0, sqrt_a=5153.7, eccentricity=0.01, m0_rad=1.0, delta_n_radps=4e-9, omega0_rad=2.0, omega_rad=-1.0,
        omega_dot_radps=-8e-9, i0_rad=0.96, idot_radps=1e-10, cuc_rad=1e-6, cus_rad=2e-6, crc_m=100.0, crs_m=-50.0, cic_rad=1e-8,
        cis_rad=-1e-8, af0_s=1e-4, af1=1e-12, af2=0.0, group_delay_s=(-1e-8, 0.0),
    )  # fmt: skip
    return replace(ephemeris, **changes)


def decoded(ephemeris: Ephemeris, number: int, clock: GpsTime | None, **fields_: float) -> Ephemeris:
    layout, payload = LAYOUTS[number], ephemeris_payload(ephemeris)
    fill = -layout.bits % 8
    block = layout.write(fields_, int.from_bytes(payload, "big") >> fill)
    result = decode_ephemeris((block << fill).to_bytes(len(payload), "big"), number, clock)
    assert not isinstance(result, str), result
    return result


def test_toe_beyond_the_end_of_the_week_belongs_to_the_next_week():
    """At 23:50 on Saturday a satellite sends toe 0 with the old week number: it is of the new week; and with the new one as well."""
    clock, toe = GpsTime(2399, 604200.0), GpsTime(2400, 0.0)
    for week in (2399, 2400):
        assert decoded(a_gps_ephemeris(toe), 1019, clock, week=week % 1024).toe == toe
    assert decoded(a_gps_ephemeris(GpsTime(2399, 597600.0)), 1019, GpsTime(2400, 100.0), week=2400 % 1024).toe == GpsTime(2399, 597600.0)


def test_ten_bit_weeks_follow_the_clock_through_the_rollovers():
    """1023 -> 0 in 1999, 2019 and 2038: the clock decides the era; without one it is 2019 to 2038."""
    for week in (1023, 1024, 2047, 2048, 3071, 3072):
        toe = GpsTime(week, 302400.0)
        assert decoded(a_gps_ephemeris(toe), 1019, toe + 86400.0).toe == toe
    assert decoded(a_gps_ephemeris(GpsTime(2047, 0.0)), 1019, None).toe == GpsTime(3071, 0.0)
    assert decoded(a_gps_ephemeris(GpsTime(2100, 0.0)), 1019, None).toe == GpsTime(2100, 0.0)


def test_an_old_clock_does_not_move_an_ephemeris_by_a_week():
    """A log of ephemerides that runs on for weeks with no epochs keeps the weeks that are sent."""
    for days in range(14):
        toe = GpsTime(2400, 302400.0) + days * 86400.0
        assert decoded(a_gps_ephemeris(toe), 1019, GpsTime(2400, 302400.0)).toe == toe


def test_the_fit_flag_widens_the_interval_as_iodc_says():
    """IS-GPS-200N table 20-XII: 4 h, with the flag 6 h, with IODC 240 to 247 8 h; here as half-widths."""
    for iodc, fit, half_s in ((33, 0, 7200.0), (33, 1, 10800.0), (241, 1, 14400.0)):
        got = decoded(a_gps_ephemeris(NOW, iodc=iodc, iode=iodc), 1019, NOW, fit=fit)
        assert isinstance(got, KeplerEphemeris)
        assert got.fit_s == half_s


def a_glonass_ephemeris(toe: GpsTime) -> GlonassEphemeris:
    return GlonassEphemeris(
        satellite=satellite_number("R07"), channel=5, iode=0, toe=toe, transmitted=toe + -900.0, health=0, accuracy_m=5.0, age_days=0,
        position_m=(1.2e7, -1.5e7, 1.6e7), velocity_mps=(100.0, 2000.0, -3000.0), acceleration_mps2=(0.0, 1e-6, -2e-6),
        tau_s=1e-5, gamma=1e-12, group_delay_s=4e-9,
    )  # fmt: skip


# 2018-07-15 00:00:18 GPST is midnight of UTC; Moscow midnight is three hours earlier. N4 = 6, leap seconds 18.
UTC_MIDNIGHT = GpsTime(2010, 18.0)


@pytest.mark.parametrize("hours", [-4.0, -3.25, -3.0, -2.75, -0.25, 0.25, 12.0])
def test_glonass_days_are_right_around_midnight(hours: float):
    """toe keeps its day at UTC and at Moscow midnight, with a clock, with a clock 20 h off, and without one."""
    toe = UTC_MIDNIGHT + hours * 3600.0
    for clock in (toe + -600.0, toe + 20 * 3600.0, toe + -20 * 3600.0, None):
        got = decoded(a_glonass_ephemeris(toe), 1020, clock)
        assert (got.toe, got.transmitted - got.toe) == (toe, -900.0)


def test_glonass_date_without_period_or_with_junk_comes_from_the_clock():
    """N4 of 0 or of 20 years ago, or NT of 0: the clock tells; without a clock there is no date."""
    toe = UTC_MIDNIGHT + 7200.0
    for junk in ({"n4": 0}, {"n4": 2}, {"nt_days": 0}):
        assert decoded(a_glonass_ephemeris(toe), 1020, toe + 3600.0, **junk).toe == toe
    payload = payload_of(1020, {"slot": 7, "tb_s": 900.0, "position_x_m": 2.55e7})
    assert decode_ephemeris(payload, 1020, None) == "date unknown"


def test_glonass_leap_day_of_the_four_year_period():
    """Day 60 of the period is 29 February of its leap year."""
    toe = GpsTime.from_calendar(2024, 2, 29, 9, 15, 18.0)
    assert decoded(a_glonass_ephemeris(toe), 1020, None).toe == toe
    values = LAYOUTS[1020].read(int.from_bytes(ephemeris_payload(a_glonass_ephemeris(toe)), "big") >> (-LAYOUTS[1020].bits % 8))
    assert (values["n4"], values["nt_days"]) == (8, 60)


def test_impossible_ephemerides_are_refused_with_a_reason():
    """No satellite 0, no time beyond the week, no orbit inside the earth, no payload that is cut."""
    good = ephemeris_payload(a_gps_ephemeris(NOW))
    assert decode_ephemeris(good[:-1], 1019, NOW) == "too short"
    base: dict[str, float] = {"slot": 5, "sqrt_a": 5153.7, "toe_s": 0.0}
    for change in ({"slot": 0}, {"toe_s": 604800.0}, {"toc_s": 604800.0}, {"sqrt_a": 100.0}):
        assert isinstance(decode_ephemeris(payload_of(1019, base | change), 1019, NOW), str)
    assert not isinstance(decode_ephemeris(payload_of(1019, base), 1019, NOW), str)


def test_systems_without_a_message_are_refused():
    with pytest.raises(ValueError, match="no RTCM 3 ephemeris"):
        ephemeris_payload(a_gps_ephemeris(NOW, satellite=satellite_number("S03")))
    with pytest.raises(ValueError, match="CNAV"):
        ephemeris_payload(a_gps_ephemeris(NOW, message=NavigationMessage.CNAV))


def test_beidou_week_and_times_are_of_the_beidou_scale():
    """1042 carries BDT: 14 s and 1356 weeks behind GPST, also where the shift crosses the week."""
    toe = GpsTime(2400, 6.0 + 8.0)
    ephemeris = a_gps_ephemeris(toe, satellite=satellite_number("C23"), message=NavigationMessage.D1, iode=3, iodc=3, fit_s=10800.0)
    block = int.from_bytes(ephemeris_payload(ephemeris), "big") >> (-LAYOUTS[1042].bits % 8)
    values = LAYOUTS[1042].read(block)
    assert (values["week"], values["toe_s"]) == (resolve_week((2400 - 1356) % 8192, 13, GpsTime(1044, 0.0)), 0.0)
    got = decoded(ephemeris, 1042, NOW)
    assert got.toe == toe
    assert {field.name for field in fields(got)} == {field.name for field in fields(ephemeris)}


def some_messages() -> list[tuple[int, bytes]]:
    """Return messages of three satellites, of each two that follow one another, near the end of a week."""
    toe = GpsTime(2400, 0.0)
    found: list[tuple[int, bytes]] = []
    for late_s in (0.0, 7200.0):
        galileo = a_gps_ephemeris(toe + late_s, satellite=satellite_number("E11"), message=NavigationMessage.INAV, sqrt_a=5440.6)
        found.append((1019, ephemeris_payload(a_gps_ephemeris(toe + late_s))))
        found.append((1020, ephemeris_payload(a_glonass_ephemeris(toe + (18.0 + late_s)))))
        found.append((1046, ephemeris_payload(galileo)))
    return found


def identity(ephemeris: Ephemeris) -> Ephemeris:
    return replace(ephemeris, transmitted=NOW)


@given(stream=st.lists(st.tuples(st.integers(0, 5), st.sampled_from([-6.9e5, -8e4, -700.0, -1.0, 0.0, 30.0, 5e4, 2e5, 4e5])), max_size=40))
@settings(max_examples=80, deadline=None)
def test_what_is_left_out_as_repeated_would_have_been_dropped_anyway(stream: list[tuple[int, float]]):
    """A receiver of each satellite's changes gets the same, with the same times, whether the decoder looks for repetitions or not."""
    messages, plain, thrifty = some_messages(), EphemerisDecoder(), EphemerisDecoder()
    last: dict[int, Ephemeris] = {}
    for index, seconds in stream:
        number, payload = messages[index]
        clock = GpsTime(2400, 0.0) + seconds
        expected, never = plain.decode(payload, number, clock, lambda _: False)
        found, repeats = thrifty.decode(payload, number, clock, lambda e: identity(e) == last.get(e.satellite))
        assert isinstance(expected, KeplerEphemeris | GlonassEphemeris)
        assert isinstance(found, KeplerEphemeris | GlonassEphemeris)
        assert not never
        assert (found == expected) if not repeats else (identity(found) == identity(expected) == last[found.satellite])
        last[found.satellite] = identity(found)


def test_a_repeated_message_is_left_out_only_if_its_ephemeris_counts():
    """The same bytes a second later: nothing new if the receiver still has it, else the ephemeris with its own time of transmission."""
    payload, decoder, clock = ephemeris_payload(a_gps_ephemeris(NOW)), EphemerisDecoder(), NOW + -60.0
    first, _ = decoder.decode(payload, 1019, clock, lambda _: True)
    assert not isinstance(first, str)
    assert decoder.decode(payload, 1019, clock + 1.0, lambda e: e == first) == (first, True)
    assert decoder.decode(payload, 1019, clock + 1.0, lambda _: False) == (replace(first, transmitted=clock + 1.0), False)
