"""Navigation blocks: the field tables, and what comes of blocks that arrive in any order, age and state."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.accuracy import GLONASS_FT_M, NO_ACCURACY_M, SISA_M, URA_M, accuracy_index, accuracy_m
from rtkmesh.codecs.bits import BitWriter, Coding, Field, Layout, load_words, word_bits
from rtkmesh.codecs.checksums import crc24q
from rtkmesh.codecs.ephemerides import glonass_ephemeris
from rtkmesh.codecs.navigation import NavigationData, NavigationDecoder
from rtkmesh.codecs.navigation_words import GLONASS_MESSAGE, MEANINGS, QUIET, REFUSALS, Refusal, block_of, words_of
from rtkmesh.codecs.subframes import (
    BEIDOU_PREAMBLE,
    D1,
    D2_EPHEMERIS,
    D2_PAGE,
    D2_PAGE_BITS,
    GLONASS_STRING,
    INAV,
    INAV_PAGE,
    LNAV,
    LNAV_PREAMBLE,
    glonass_check_bits,
)  # fmt: skip
from rtkmesh.codecs.ubx_encode import encode_sfrbx
from rtkmesh.codecs.ubx_subframes import take_subframes
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, GST_WEEK_OFFSET, PI_GPS
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import satellite_number
from rtkmesh.gnss.time import GpsTime

LAYOUTS = [*LNAV.values(), *INAV.values(), INAV_PAGE, *D1.values(), D2_PAGE, D2_EPHEMERIS, *GLONASS_STRING.values()]
NOW = GpsTime(2350, 302_400.0)

# Multiples of the coarsest resolution of all messages, so that every value must come back exactly.
ANGLE, RATE = PI_GPS * 2.0**-31, PI_GPS * 2.0**-43
ORBIT = {
    "sqrt_a": 5153.625, "eccentricity": 0.0123 // 2.0**-33 * 2.0**-33, "m0_rad": 700_000_001 * ANGLE, "delta_n_radps": 12_345 * RATE,
    "omega0_rad": -1_234_567_891 * ANGLE, "omega_rad": 400_000_003 * ANGLE, "omega_dot_radps": -23_456 * RATE,
    "i0_rad": 660_000_007 * ANGLE, "idot_radps": -777 * RATE, "cuc_rad": 801 * 2.0**-29, "cus_rad": -1333 * 2.0**-29, "crc_m": 210.5,
    "crs_m": -33.25, "cic_rad": 55 * 2.0**-29, "cis_rad": -107 * 2.0**-29, "af0_s": -666_666 * 2.0**-31, "af1": 17 * 2.0**-43, "af2": 0.0,
}  # fmt: skip


Taken = list[NavigationData] | Refusal


class Blocks(NavigationDecoder):
    """The decoder with whole blocks as its input: they go as messages to the kernels, what these do not find quiet is looked at."""

    def lnav(self, satellite: int, block: int) -> Taken:
        return self.take(satellite, words_of(block, 300, 30))

    d1 = d2 = lnav  # which of the three it is the satellite says

    def inav(self, satellite: int, page: int) -> Taken:
        return self.take(satellite, words_of(page, 256, 32))

    def glonass(self, satellite: int, channel: int, string: int, frame: int) -> Taken:
        return self.take(satellite, [*words_of(string, 85, 32), frame], channel)

    def take(self, satellite: int, words: list[int], channel: int = 0) -> Taken:
        *_, message, result = take_subframes(encode_sfrbx(satellite, words, channel), 0, self.satellites, *self.now)
        if result < QUIET:
            return REFUSALS[result]
        return [] if result == QUIET else self.look(satellite, message, result)


def lnav_blocks(satellite_week: int, tow_s: float, toe_s: float, iode: int = 77, health: int = 0, **changes: float) -> dict[int, int]:
    """Return subframes 1 to 3 whose first begins at ``tow_s`` (parity left at zero)."""
    values = ORBIT | changes | {
        "preamble": LNAV_PREAMBLE, "week": satellite_week % 1024, "toe_s": toe_s, "toc_s": toe_s, "iode": iode, "iodc": iode,
        "health": health, "ura": 1, "tgd_s": -5e-9,
    }  # fmt: skip
    return {i: LNAV[i].write(values | {"subframe": i, "tow_s": tow_s + 6.0 * i}) for i in (1, 2, 3)}


def d1_blocks(week: int, sow_s: int, toe_s: float, health: int = 0) -> dict[int, int]:
    values = ORBIT | {
        "preamble": BEIDOU_PREAMBLE, "week": week, "toc_s": toe_s, "health": health, "urai": 0, "aodc": 3, "aode": 4, "tgd1_s": 3e-9,
        "tgd2_s": -2e-9, "toe_high": int(toe_s / 8) >> 15, "toe_low": int(toe_s / 8) & 0x7FFF, "alpha0": 2e-8, "beta3": -196608.0,
    }  # fmt: skip
    return {i: D1[i].write(values | {"subframe": i, "sow_s": sow_s + 6 * (i - 1)}) for i in (1, 2, 3)}


def inav_words(week: int, tow_s: float, toe_s: float, satellite: int, issue: int = 50) -> dict[int, int]:
    values = ORBIT | {
        "sqrt_a": 5440.6, "iodnav": issue, "toe_s": toe_s, "toc_s": toe_s, "sisa": 107, "satellite": satellite % 64, "week": week,
        "tow_s": tow_s, "bgd_e5a_s": 2e-9, "bgd_e5b_s": -1e-9, "af0_s": 1e-4,
    }  # fmt: skip
    return {i: INAV[i].write(values | {"word": i}) for i in (1, 2, 3, 4, 5)}


def glonass_strings(utc: datetime, tb_s: float, slot: int, health: int = 0) -> dict[int, int]:
    """Return strings 1 to 5 of the frame at ``utc``, a time on a multiple of 30 s."""
    moscow = utc + timedelta(hours=3)
    start = datetime(moscow.year - moscow.year % 4, 1, 1, tzinfo=UTC)
    values: dict[str, float] = {
        "tk_hours": moscow.hour, "tk_minutes": moscow.minute, "tk_half_minutes": moscow.second // 30, "tb_s": tb_s, "health": health << 2,
        "position_x_m": 12_000e3, "position_y_m": -15_000e3, "position_z_m": 16_818e3, "velocity_x_mps": -1000.0, "velocity_y_mps": 2500.0,
        "velocity_z_mps": 2000.0, "acceleration_x_mps2": 2.8e-6, "acceleration_y_mps2": -9.3e-7, "acceleration_z_mps2": 0.0,
        "tau_n_s": 5e-5, "gamma": -1.8e-12, "delta_tau_n_s": 2e-9, "age_days": 0, "ft": 2, "nt_days": (moscow - start).days + 1,
        "slot": slot, "type": 1, "n4": (moscow.year - 1996) // 4 + 1,
    }  # fmt: skip
    blocks = {i: GLONASS_STRING[i].write(values | {"string": i}) for i in (1, 2, 3, 4, 5)}
    return {i: block | glonass_check_bits(block >> 8) for i, block in blocks.items()}


def fed(feed: Callable[[int, int], object], satellite: int, blocks: Iterable[int]) -> list[object]:
    found: list[object] = []
    for block in blocks:
        result = feed(satellite, block)
        assert isinstance(result, list), result
        found += result
    return found


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_fields_of_a_block_lie_inside_and_do_not_overlap(layout: Layout):
    """Each bit belongs to one field (the page's CRC cover counts apart)."""
    used = [first + k for f in layout.fields if f.name != "covered" for first, n in f.parts for k in range(n)]
    assert max(used) < layout.bits
    even_odd = {0, 1, 128, 129}  # of the page, named and covered
    assert len(used) == len(set(used)) or (layout is INAV_PAGE and set(used) >= even_odd)


@given(data=st.data(), layout=st.sampled_from([x for x in LAYOUTS if x is not INAV_PAGE]))
@settings(max_examples=60, deadline=None)
def test_what_is_written_is_read_back(data: st.DataObject, layout: Layout):
    """Every number that fits survives, and no field disturbs another."""
    numbers: dict[str, int] = {}
    for f in layout.fields:
        low = {Coding.UNSIGNED: 0, Coding.TWOS_COMPLEMENT: -(1 << f.length - 1), Coding.SIGN_MAGNITUDE: 1 - (1 << f.length - 1)}[f.coding]
        high = (1 << f.length - (f.coding is not Coding.UNSIGNED)) - 1
        numbers[f.name] = data.draw(st.integers(low, high))
    block = layout.write({f.name: numbers[f.name] * f.scale for f in layout.fields}, data.draw(st.integers(0, (1 << layout.bits) - 1)))
    assert {f.name: layout.number(block, f) for f in layout.fields} == numbers
    assert layout.read(block) == {f.name: numbers[f.name] * f.scale for f in layout.fields}


@given(block=st.integers(0, (1 << 300) - 1), bits=st.integers(1, 300), word_bits=st.sampled_from([30, 32]))
@settings(max_examples=60, deadline=None)
def test_a_block_is_its_words_joined(block: int, bits: int, word_bits: int):
    """Words go back to the block, whatever stands behind them."""
    block %= 1 << bits
    parts = words_of(block, bits, word_bits)
    assert len(parts) == -(-bits // word_bits)
    assert block_of([*parts, 12345], bits, word_bits) == block


@given(data=st.binary(min_size=1, max_size=40), place=st.integers(0, 319), length=st.integers(0, 32))
@settings(max_examples=80, deadline=None)
def test_bits_of_words_are_bits_of_the_bytes(data: bytes, place: int, length: int):
    """At any place, also where the last word is not full, against the bytes as one number."""
    position = place % (8 * len(data))
    length = min(length, 8 * len(data) - position)
    expected = int.from_bytes(data, "big") >> (8 * len(data) - position - length) & (1 << length) - 1
    assert word_bits(load_words(data), position, length) == expected


@given(number=st.integers(-5000, 5000), length=st.integers(2, 14), offset=st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_fields_read_what_the_writer_wrote(number: int, length: int, offset: int):
    """Layouts on bytes and the writer agree in all three codings, at any alignment."""
    for coding, put in (
        (Coding.UNSIGNED, BitWriter.unsigned),
        (Coding.TWOS_COMPLEMENT, BitWriter.signed),
        (Coding.SIGN_MAGNITUDE, BitWriter.sign_magnitude),
    ):
        writer = BitWriter()
        writer.unsigned((1 << offset) - 1, offset)
        try:
            put(writer, number, length)
        except ValueError:
            assert coding.decode(number % (1 << length), length) != number or (number < 0 and coding is Coding.SIGN_MAGNITUDE)
            continue
        writer.unsigned(1, 1)
        assert len(writer) == offset + length + 1
        layout = Layout("one field", offset + length + 1, (Field("number", ((offset, length),), 0.5, coding),))
        assert layout.read_bytes(b"x" + writer.to_bytes(), 1) == {"number": 0.5 * number}


@given(data=st.integers(0, (1 << 77) - 1), bit=st.integers(0, 84))
@settings(max_examples=60, deadline=None)
def test_glonass_check_bits_detect_any_single_error(data: int, bit: int):
    """The Hamming code of a string changes with each of its 85 bits, and the decoder refuses what it does not fit."""
    string = data << 8 | glonass_check_bits(data)
    damaged = string ^ 1 << bit
    assert glonass_check_bits(damaged >> 8) != damaged & 0xFF
    decoder = Blocks(NOW)
    of_use = [1 <= block >> 80 & 15 <= 5 for block in (string, damaged)]
    assert decoder.glonass(71, 0, string, 1) == []
    assert decoder.glonass(71, 0, damaged, 1) == (Refusal.CHECKSUM if of_use[1] else [])
    assert decoder.satellites[71]["held"] == (1 << (string >> 80 & 15) if of_use[0] else 0)


@pytest.mark.parametrize("table", [URA_M, SISA_M, GLONASS_FT_M])
def test_accuracy_indices_go_back_and_forth(table: tuple[float, ...]):
    """Each index gives itself back; beyond the table there is no statement."""
    assert [accuracy_index(table, accuracy_m(table, i)) for i in range(len(table))] == list(range(len(table)))
    assert accuracy_m(table, len(table)) == NO_ACCURACY_M
    assert accuracy_index(table, 1e9) == len(table)


def test_lnav_becomes_an_ephemeris_with_every_value():
    """Three subframes of one issue give one ephemeris, in full resolution and GPS time."""
    decoder = Blocks(NOW)
    (e,) = fed(decoder.lnav, satellite_number("G05"), lnav_blocks(2350, 302_400.0, 309_600.0).values())
    assert isinstance(e, KeplerEphemeris)
    assert (e.satellite, e.message, e.iode, e.iodc, e.health) == (5, NavigationMessage.LNAV, 77, 77, 0)
    assert (e.toe, e.toc, e.transmitted) == (GpsTime(2350, 309_600.0), GpsTime(2350, 309_600.0), GpsTime(2350, 302_406.0))
    assert (e.accuracy_m, e.fit_s) == (2.8, 7200.0)
    for name, value in ORBIT.items():
        assert getattr(e, name) == value, name
    assert e.group_delay_s == (pytest.approx(-5e-9, abs=3e-10), 0.0)


def test_an_ephemeris_is_published_once_until_it_changes():
    """Repetition is silent; a new issue or a change of health speaks."""
    decoder, satellite = Blocks(NOW), satellite_number("G05")
    first = lnav_blocks(2350, 302_400.0, 309_600.0)
    assert len(fed(decoder.lnav, satellite, [*first.values()] * 3)) == 1
    assert len(fed(decoder.lnav, satellite, lnav_blocks(2350, 302_430.0, 309_600.0).values())) == 0
    (sick,) = fed(decoder.lnav, satellite, [lnav_blocks(2350, 302_460.0, 309_600.0, health=63)[1]])
    assert isinstance(sick, KeplerEphemeris)
    assert sick.health == 63
    assert len(fed(decoder.lnav, satellite, lnav_blocks(2350, 302_490.0, 316_800.0, iode=78).values())) == 1


def test_subframes_of_different_issues_are_not_mixed():
    """At an upload the old ephemeris stands until the new one is whole."""
    decoder, satellite = Blocks(NOW), satellite_number("J02")
    old, new = lnav_blocks(2350, 302_400.0, 309_600.0, iode=1), lnav_blocks(2350, 302_430.0, 316_800.0, iode=2)
    assert len(fed(decoder.lnav, satellite, old.values())) == 1
    assert fed(decoder.lnav, satellite, [new[3], new[1]]) == []
    (e,) = fed(decoder.lnav, satellite, [new[2]])
    assert isinstance(e, KeplerEphemeris)
    assert e.iode == 2


@pytest.mark.parametrize("week", [1023, 1024, 2047, 2048, 2350, 2900, 3071, 3072])
def test_the_ten_bit_week_is_resolved_near_the_receivers_time(week: int):
    """Roll-overs of the ten-bit week and the week's end between transmission and toe."""
    decoder = Blocks(GpsTime(week, 604_799.0))
    (e,) = fed(decoder.lnav, 5, lnav_blocks(week, 604_770.0, 0.0).values())
    assert isinstance(e, KeplerEphemeris)
    assert (e.toe, e.transmitted) == (GpsTime(week + 1, 0.0), GpsTime(week, 604_776.0))


def test_complete_sets_wait_for_a_time_and_are_dated_anew_when_it_jumps():
    """Before the receiver's first epoch nothing is guessed; a corrected clock corrects the weeks."""
    decoder = Blocks()
    assert fed(decoder.lnav, 5, lnav_blocks(2350, 302_400.0, 309_600.0).values()) == []
    (wrong,) = decoder.set_time(GpsTime(2350 - 1024, 302_400.0))
    assert decoder.set_time(GpsTime(2350 - 1024, 302_401.0)) == []
    (right,) = decoder.set_time(NOW)
    assert isinstance(wrong, KeplerEphemeris)
    assert isinstance(right, KeplerEphemeris)
    assert (wrong.toe.week, right.toe.week) == (2350 - 1024, 2350)


def test_values_that_no_satellite_has_are_refused():
    """A set with an absurd orbit gives nothing, and the next good one does."""
    decoder = Blocks(NOW)
    assert fed(decoder.lnav, 5, lnav_blocks(2350, 302_400.0, 309_600.0, sqrt_a=100.0).values()) == []
    assert fed(decoder.lnav, 5, lnav_blocks(2350, 302_400.0, 604_800.0 + 4000.0).values()) == []
    assert len(fed(decoder.lnav, 5, lnav_blocks(2350, 302_400.0, 309_600.0).values())) == 1
    assert decoder.lnav(5, 0) is Refusal.PREAMBLE
    assert decoder.d1(satellite_number("C21"), 0) is Refusal.PREAMBLE
    assert decoder.d2(satellite_number("C03"), 0) is Refusal.PREAMBLE
    assert decoder.inav(satellite_number("E11"), 0) is Refusal.PREAMBLE
    assert decoder.glonass(65, 0, 1 << 80, 0) is Refusal.CHECKSUM


def test_lnav_ionosphere_page_gives_klobuchar_parameters_once():
    """Subframe 4 page 18, and no other page."""
    values = {
        "preamble": LNAV_PREAMBLE,
        "subframe": 4,
        "data_id": 1,
        "page_id": 56,
        "alpha0": 2.0**-27,
        "alpha2": -(2.0**-22),
        "beta1": 2.0**17,
    }
    page = LNAV[4].write(values)
    decoder = Blocks(NOW)
    assert fed(decoder.lnav, 5, [page, page]) == [KlobucharParameters("G", (2.0**-27, 0.0, -(2.0**-22), 0.0), (0.0, 2.0**17, 0.0, 0.0))]
    assert fed(decoder.lnav, 6, [page, LNAV[4].write(values | {"page_id": 57, "alpha0": 0.0})]) == []


def inav_page(word: int) -> int:
    block = INAV_PAGE.write({"data": word, "even_odd_1": 1})
    covered = INAV_PAGE.unsigned(block, "covered").to_bytes(25, "big")
    return INAV_PAGE.write({"crc": crc24q(covered)}, block)


def test_inav_words_become_an_ephemeris():
    """Words 1 to 5 in any order, week and satellite checked, health as in RINEX."""
    decoder, satellite = Blocks(), satellite_number("E11")
    words = inav_words(2350 - GST_WEEK_OFFSET, 302_450.0, 304_200.0, satellite)
    words[5] = INAV[5].write({"health_e5b": 1, "invalid_e1b": 1}, words[5])
    (e,) = fed(decoder.inav, satellite, [inav_page(words[i]) for i in (3, 5, 1, 4, 2)])
    assert isinstance(e, KeplerEphemeris)
    assert (e.message, e.iode, e.toe, e.transmitted) == (NavigationMessage.INAV, 50, GpsTime(2350, 304_200.0), GpsTime(2350, 302_450.0))
    assert (e.health, e.accuracy_m, e.fit_s) == (1 | 1 << 7, pytest.approx(3.12), 14400.0)
    assert e.group_delay_s == (pytest.approx(2e-9, abs=2e-10), pytest.approx(-1e-9, abs=2e-10))
    assert decoder.time == GpsTime(2350, 302_450.0)


@given(data=st.integers(0, (1 << 112) - 1), rest=st.integers(0, (1 << 16) - 1), word=st.integers(0, 5), bit=st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_any_wrong_bit_of_a_page_is_refused(data: int, rest: int, word: int, bit: int):
    """Of the 220 bits of a page that mean something; the padding may be anything. Damage that makes it a word of no use gives nothing."""
    page = inav_page(word << 122 | (data << 16 | rest) % (1 << 122))
    assert isinstance(Blocks(NOW).inav(133, page), list)
    damaged = page ^ 1 << 255 - bit
    meant = bit < 114 or 128 <= bit < 234
    of_use = INAV_PAGE.unsigned(damaged, "data") >> 122 <= 5
    assert isinstance(Blocks(NOW).inav(133, damaged), Refusal) == (meant and (of_use or bit in (0, 1, 128, 129)))


def test_inav_pages_that_are_damaged_or_not_theirs_are_refused():
    """A wrong bit, an alert page, another satellite's clock word."""
    decoder, satellite = Blocks(), satellite_number("E11")
    words = inav_words(1326, 302_450.0, 304_200.0, satellite)
    assert decoder.inav(satellite, inav_page(words[1]) ^ 1 << 200) is Refusal.CHECKSUM
    assert decoder.inav(satellite, INAV_PAGE.write({"alert_1": 1}, inav_page(words[1]))) is Refusal.ALERT_PAGE
    assert fed(decoder.inav, satellite + 1, [inav_page(word) for word in words.values()]) == []


@pytest.mark.parametrize(("sow_s", "toe_s", "toe"), [(302_400, 304_200.0, GpsTime(2350, 304_214.0)), (604_770, 0.0, GpsTime(2351, 14.0))])
def test_d1_becomes_an_ephemeris_in_gps_time(sow_s: int, toe_s: float, toe: GpsTime):
    """BDT is 14 s behind; toe is put together from two subframes; the week may end in between."""
    decoder = Blocks()
    found = fed(decoder.d1, satellite_number("C21"), d1_blocks(2350 - BDT_WEEK_OFFSET, sow_s, toe_s).values())
    ionosphere, e = found
    assert isinstance(e, KeplerEphemeris)
    assert isinstance(ionosphere, KlobucharParameters)
    assert (e.message, e.iode, e.iodc, e.toe, e.toc) == (NavigationMessage.D1, 4, 3, toe, toe)
    assert e.transmitted == GpsTime.normalized(2350, sow_s - BDT_MINUS_GPST_S)
    assert e.group_delay_s == (pytest.approx(3e-9), pytest.approx(-2e-9))
    assert (ionosphere.system, ionosphere.beta[3]) == ("C", -196608.0)


def test_d1_subframes_of_different_frames_are_not_mixed():
    """D1 has no issue in subframes 2 and 3: only consecutive subframes count."""
    decoder, satellite = Blocks(NOW), satellite_number("C21")
    first, second = d1_blocks(994, 302_400, 304_200.0), d1_blocks(994, 302_430, 304_200.0)
    found = fed(decoder.d1, satellite, [first[1], first[2], second[3], second[1]])
    assert [type(x) for x in found] == [KlobucharParameters]
    assert len(fed(decoder.d1, satellite, [second[2]])) == 1


def d2_pages(sow_s: int) -> list[int]:
    values = ORBIT | {
        "sqrt_a": 6493.375, "week": 994, "toc_s": 304_200.0, "toe_s": 304_200.0, "aode": 1, "aodc": 2, "urai": 2, "tgd1_s": 1e-9,
        "tgd2_s": 0.0,
    }  # fmt: skip
    joined = D2_EPHEMERIS.write(values | {"sow_s": sow_s})
    pages: list[int] = []
    for i in range(10):
        page = joined >> D2_PAGE_BITS * (9 - i) & (1 << D2_PAGE_BITS) - 1
        header = {"preamble": BEIDOU_PREAMBLE, "subframe": 1, "page": i + 1, "sow_s": sow_s + 3 * i}
        pages.append(D2_PAGE.write(header, page) << 150)
    return pages


def test_d2_pages_become_an_ephemeris_only_if_they_follow_each_other():
    """Ten pages of subframe 1, 3 s apart; a gap is filled by the next repetition."""
    decoder, satellite = Blocks(NOW), satellite_number("C03")
    first, second = d2_pages(302_400), d2_pages(302_430)
    assert fed(decoder.d2, satellite, [*first[:4], *first[5:], *second[:9]]) == []
    e = fed(decoder.d2, satellite, second[9:])[-1]
    assert isinstance(e, KeplerEphemeris)
    assert (e.message, e.iode, e.iodc, e.toe, e.accuracy_m) == (NavigationMessage.D2, 1, 2, GpsTime(2350, 304_214.0), 4.0)
    for name, value in ORBIT.items():
        assert getattr(e, name) == (6493.375 if name == "sqrt_a" else value), name


@pytest.mark.parametrize(
    ("utc", "tb_s", "toe_utc"),
    [
        (datetime(2024, 6, 24, 8, 20, tzinfo=UTC), 41_400.0, datetime(2024, 6, 24, 8, 30, tzinfo=UTC)),
        (datetime(2024, 6, 24, 20, 59, 30, tzinfo=UTC), 900.0, datetime(2024, 6, 24, 21, 15, tzinfo=UTC)),  # Moscow's midnight
        (datetime(2023, 12, 31, 21, 0, tzinfo=UTC), 85_500.0, datetime(2023, 12, 31, 20, 45, tzinfo=UTC)),  # a new four-year period
        (datetime(2016, 12, 31, 23, 59, 30, tzinfo=UTC), 11_700.0, datetime(2017, 1, 1, 0, 15, tzinfo=UTC)),  # over a leap second
    ],
)
@pytest.mark.parametrize("reference", ["receiver", "string 5"])
def test_glonass_strings_become_a_dated_ephemeris(utc: datetime, tb_s: float, toe_utc: datetime, reference: str):
    """The day comes from the receiver's time or from the strings themselves, leap seconds from our table."""
    decoder, satellite = Blocks(GpsTime.from_utc(utc) + 5.0 if reference == "receiver" else None), satellite_number("R07")
    found = fed(lambda s, block: decoder.glonass(s, 5, block, 0x10001), satellite, glonass_strings(utc, tb_s, 7).values())
    (e,) = found
    assert isinstance(e, GlonassEphemeris)
    assert (e.toe, e.transmitted) == (GpsTime.from_utc(toe_utc), GpsTime.from_utc(utc))
    assert (e.satellite, e.channel, e.iode, e.health, e.accuracy_m) == (satellite, 5, int(tb_s / 900), 0, 2.5)
    assert e.position_m == pytest.approx((12_000e3, -15_000e3, 16_818e3), abs=0.3)
    assert e.velocity_mps == pytest.approx((-1000.0, 2500.0, 2000.0), abs=6e-4)
    assert e.acceleration_mps2 == pytest.approx((2.8e-6, -9.3e-7, 0.0), abs=5e-7)
    assert (e.tau_s, e.gamma, e.group_delay_s) == (
        pytest.approx(-5e-5, abs=5e-10),
        pytest.approx(-1.8e-12, abs=5e-13),
        pytest.approx(2e-9, abs=5e-10),
    )


def test_glonass_strings_of_different_sets_are_not_mixed():
    """Strings of two frames join only if the time says that no upload lies between them."""
    before = datetime(2024, 6, 24, 8, 40, tzinfo=UTC)
    old, new = glonass_strings(before, 41_400.0, 7), glonass_strings(before + timedelta(minutes=10), 43_200.0, 7)
    decoder = Blocks(GpsTime.from_utc(before))
    satellite = satellite_number("R07")
    assert fed(lambda s, block: decoder.glonass(s, 5, block, 0x10001), satellite, [old[1], old[2], old[3]]) == []
    decoder.set_time(GpsTime.from_utc(before + timedelta(seconds=30)))
    assert len(fed(lambda s, block: decoder.glonass(s, 5, block, 0x10002), satellite, [old[4]])) == 1  # same interval of tb
    decoder.set_time(GpsTime.from_utc(before + timedelta(minutes=10)))
    assert fed(lambda s, block: decoder.glonass(s, 5, block, 0x50001), satellite, [new[2]]) == []
    assert len(fed(lambda s, block: decoder.glonass(s, 5, block, 0x50001), satellite, [new[1], new[3], new[4]])) == 1


def test_glonass_frames_without_a_number_are_gathered_from_string_1_on():
    """Some strings come before the receiver knows their frame."""
    utc = datetime(2024, 6, 24, 8, 20, tzinfo=UTC)
    decoder, satellite, strings = Blocks(GpsTime.from_utc(utc)), satellite_number("R07"), glonass_strings(utc, 41_400.0, 7)
    assert fed(lambda s, block: decoder.glonass(s, 5, block, 0), satellite, [strings[2], strings[3], strings[4], strings[1]]) == []
    assert len(fed(lambda s, block: decoder.glonass(s, 5, block, 0), satellite, [strings[2], strings[3], strings[4]])) == 1


def test_health_of_glonass_is_the_users_bit():
    """Of Bn only the most significant bit counts."""
    utc = datetime(2024, 6, 24, 8, 20, tzinfo=UTC)
    for health in (0, 1):
        decoder = Blocks(GpsTime.from_utc(utc))
        strings = glonass_strings(utc, 41_400.0, 7, health)
        (e,) = fed(lambda s, block, decoder=decoder: decoder.glonass(s, 5, block, 9), satellite_number("R07"), strings.values())
        assert isinstance(e, GlonassEphemeris)
        assert e.health == health


@given(blocks=st.lists(st.tuples(st.sampled_from(["lnav", "inav", "d1", "d2", "glonass"]), st.integers(0, (1 << 300) - 1)), max_size=30))
@settings(max_examples=50, deadline=None)
def test_random_blocks_never_raise(blocks: list[tuple[str, int]]):
    """Whatever a satellite or a damaged line sends."""
    decoder = Blocks(NOW)
    preamble = {"lnav": LNAV_PREAMBLE << 292, "d1": BEIDOU_PREAMBLE << 289, "d2": BEIDOU_PREAMBLE << 289}
    satellites = {"lnav": "G05", "d1": "C21", "d2": "C03", "inav": "E11"}
    for message, bits in blocks:
        if message == "glonass":
            decoder.glonass(65, 0, bits % (1 << 77) << 8 | glonass_check_bits(bits % (1 << 77)), bits % 3)
        else:
            block = inav_page(bits % (1 << 128)) if message == "inav" else bits
            head = 8 if message == "lnav" else 11
            if message in preamble:
                block = block % (1 << 300 - head) | preamble[message]
            getattr(decoder, message)(satellite_number(satellites[message]), block)
    decoder.set_time(replace(NOW, week=1000))


@pytest.mark.parametrize("index", [1, 2, 3, 4])
def test_bits_of_strings_that_mean_nothing_leave_the_ephemeris_as_it_is(index: int):
    """Each bit that the kernels do not compare, turned alone, gives the same ephemeris but for its time of transmission."""
    utc = datetime(2024, 6, 24, 8, 20, tzinfo=UTC)
    strings, now = glonass_strings(utc, 41_400.0, 7), GpsTime.from_utc(utc)
    expected = glonass_ephemeris(satellite_number("R07"), 5, strings, now)
    compared = block_of(MEANINGS[GLONASS_MESSAGE, index].tolist(), 85, 32)
    turned = [strings | {index: strings[index] ^ 1 << bit} for bit in range(85) if not compared >> bit & 1]
    found = [glonass_ephemeris(satellite_number("R07"), 5, some, now) for some in turned]
    assert expected is not None
    assert len(found) >= 10
    assert all(e is not None and replace(e, transmitted=expected.transmitted) == expected for e in found)


def test_a_glonass_string_that_means_the_same_is_quiet_until_channel_or_day_may_change():
    """The flag P3 changes in every frame; another channel, or hours later another day, are looked at."""
    utc = datetime(2024, 6, 24, 8, 20, tzinfo=UTC)
    decoder, satellite, strings = Blocks(GpsTime.from_utc(utc)), satellite_number("R07"), glonass_strings(utc, 41_400.0, 7)
    turned = strings[3] >> 8 ^ 1 << 71  # bit 80
    turned = turned << 8 | glonass_check_bits(turned)

    def take(string: int, channel: int = 5) -> int:
        message = encode_sfrbx(satellite, [*words_of(string, 85, 32), 0x10001], channel)
        return take_subframes(message, 0, decoder.satellites, *decoder.now)[-1]

    assert len(fed(lambda s, block: decoder.glonass(s, 5, block, 0x10001), satellite, strings.values())) == 1
    assert [take(turned), take(strings[3]), take(turned)] == [QUIET] * 3
    assert take(strings[3], channel=6) == 3
    (moved,) = decoder.look(satellite, GLONASS_MESSAGE, 3)
    assert isinstance(moved, GlonassEphemeris)
    assert moved.channel == 6
    assert take(turned, channel=6) == QUIET
    for _ in range(12):
        assert decoder.set_time(GpsTime(decoder.now[1], decoder.now[2] + 3500.0)) == []
    assert take(strings[3], channel=6) == 3


def some_blocks() -> list[tuple[str, str, int, int]]:
    """Return blocks of satellites of all messages, of two sets each, as (message, satellite, block, frame of a GLONASS string)."""
    utc, blocks = datetime(2024, 6, 24, 8, 20, tzinfo=UTC), list[tuple[str, str, int, int]]()
    for k in range(2):
        toe_s, late = 309_600.0 + 7200.0 * k, 30 * k
        blocks += [("lnav", "G05", b, 0) for b in lnav_blocks(2350, 302_400.0 + late, toe_s, iode=77 + k).values()]
        blocks += [("lnav", "J02", b, 0) for b in lnav_blocks(2350, 302_400.0 + late, toe_s, iode=7, health=k).values()]
        words_of_set = inav_words(2350 - GST_WEEK_OFFSET, 302_450.0 + late, 304_200.0 + 600 * k, satellite_number("E11"), 50 + k)
        blocks += [("inav", "E11", inav_page(word), 0) for word in words_of_set.values()]
        blocks += [("d1", "C21", b, 0) for b in d1_blocks(2350 - BDT_WEEK_OFFSET, 302_400 + late, 304_200.0, health=k).values()]
        blocks += [("d2", "C03", b, 0) for b in d2_pages(302_400 + late)]
        strings = glonass_strings(utc + timedelta(seconds=late), 41_400.0, 7, health=k)
        strings[3] = (strings[3] >> 8 ^ k << 71) << 8  # P3
        strings[3] |= glonass_check_bits(strings[3] >> 8)
        blocks += [("glonass", "R07", b, 0x10001 + k) for b in strings.values()]
    return blocks


@given(order=st.lists(st.tuples(st.integers(0, len(some_blocks()) - 1), st.booleans()), max_size=120))
@settings(max_examples=80, deadline=None)
def test_nothing_would_come_of_what_the_kernels_find_quiet(order: list[tuple[int, bool]]):
    """After every block, in any order and repetition, trying all sets anew gives nothing more, and changes nothing that comes later."""
    now = GpsTime.from_utc(datetime(2024, 6, 24, 8, 20, tzinfo=UTC))
    blocks, lazy, eager = some_blocks(), Blocks(now), Blocks(now)
    for message, name, block, frame in [block for at, follow in order for block in blocks[at : at + (10 if follow else 1)]]:
        satellite = satellite_number(name)
        found = [
            decoder.glonass(satellite, 5, block, frame) if message == "glonass" else getattr(decoder, message)(satellite, block)
            for decoder in (lazy, eager)
        ]
        assert found[0] == found[1]
        eager.satellites["settled"] = 0
        assert [eager._publish(*known) for known in eager._messages.items()] == [[]] * len(eager._messages)


def test_inclination_is_in_radians():
    """One field by hand: i0 of 55 degrees is 0.305556 semicircles."""
    block = LNAV[3].write({"i0_rad": radians(55.0)})
    assert LNAV[3].unsigned(block, "i0_rad") == round(55.0 / 180.0 * 2**31 * np.pi / 3.1415926535898)
