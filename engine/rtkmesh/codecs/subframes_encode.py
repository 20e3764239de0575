"""Ephemerides to the navigation blocks that satellites send, as u-blox delivers them: the way back of ``navigation``.

Blocks are integers as in ``subframes``, parity included (u-blox turns inverted LNAV words back with their parity, and BeiDou words come
with their two codes one after the other). ``sent`` is the start of the (30 s) frame, in GPST.
"""

from datetime import UTC, datetime, timedelta
from typing import Final

from rtkmesh.codecs.accuracy import GLONASS_FT_M, SISA_M, URA_M, accuracy_index
from rtkmesh.codecs.bits import Coding, Field, Layout
from rtkmesh.codecs.checksums import crc24q
from rtkmesh.codecs.ephemerides import MOSCOW_MINUS_UTC_S
from rtkmesh.codecs.subframes import (
    BEIDOU_PREAMBLE,
    BEIDOU_TOE_UNIT_S,
    D1,
    GLONASS_STRING,
    INAV,
    INAV_PAGE,
    LNAV,
    LNAV_PREAMBLE,
    glonass_check_bits,
)
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S, BDT_WEEK_OFFSET, GST_WEEK_OFFSET, SECONDS_PER_DAY, SECONDS_PER_WEEK
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters
from rtkmesh.gnss.signals import SATELLITES_PER_SYSTEM
from rtkmesh.gnss.time import GpsTime, gps_minus_utc_s

_SUBFRAME_S: Final = 6.0
_INAV_PAGE_S: Final = 2.0

# Data bits (1 to 24) in each parity bit D25 to D30, and whether D29 or D30 of the word before enters it (IS-GPS-200N table 20-XIV).
_LNAV_PARITY: Final = (
    (29, (1, 2, 3, 5, 6, 10, 11, 12, 13, 14, 17, 18, 20, 23)),
    (30, (2, 3, 4, 6, 7, 11, 12, 13, 14, 15, 18, 19, 21, 24)),
    (29, (1, 3, 4, 5, 7, 8, 12, 13, 14, 15, 16, 19, 20, 22)),
    (30, (2, 4, 5, 6, 8, 9, 13, 14, 15, 16, 17, 20, 21, 23)),
    (30, (1, 3, 5, 6, 7, 9, 10, 14, 15, 16, 17, 18, 21, 22, 24)),
    (29, (3, 5, 6, 8, 9, 10, 11, 13, 15, 19, 22, 23, 24)),
)
_LNAV_MASKS: Final = tuple((before, sum(1 << (24 - bit) for bit in bits)) for before, bits in _LNAV_PARITY)


def lnav_parity(data: int, before: int) -> int:
    """Return D25 to D30 of 24 data bits (not inverted); ``before`` is the word before, of which D29 and D30 count."""
    last = {29: before >> 1 & 1, 30: before & 1}
    parity = 0
    for source, mask in _LNAV_MASKS:
        parity = parity << 1 | last[source] ^ (data & mask).bit_count() & 1
    return parity


def with_lnav_parity(block: int) -> int:
    """Return a subframe with all parity bits; bits 23 and 24 of words 2 and 10 make D29 and D30 zero (IS-GPS-200N 20.3.3.2)."""
    done, before = 0, 0
    for word in range(10):
        data = block >> (30 * (9 - word) + 6) & 0xFFFFFF
        if word in (1, 9):
            data = next(d for d in range(data & ~3, (data & ~3) + 4) if lnav_parity(d, before) & 3 == 0)
        inverted = before & 1
        before = data << 6 | lnav_parity(data, before)
        done = done << 30 | (before ^ 0x3F if inverted else before)
    return done


def lnav_subframes(e: KeplerEphemeris, sent: GpsTime) -> dict[int, int]:
    """Return LNAV subframes 1 to 3 (300 bits each); ValueError if a value does not fit its field."""
    values = _fields(e) | {
        "week": sent.week % 1024,
        "l2_code": 1,
        "ura": accuracy_index(URA_M, e.accuracy_m),
        "tgd_s": e.group_delay_s[0],
        "fit": float(e.fit_s > 7200.0),
        "toe_s": e.toe.tow_s,
        "toc_s": e.toc.tow_s,
    }
    return {number: _lnav(number, LNAV[number], values, sent) for number in (1, 2, 3)}


def lnav_ionosphere(parameters: KlobucharParameters, sent: GpsTime) -> int:
    """Return LNAV subframe 4 page 18 (300 bits)."""
    return _lnav(4, LNAV[4], {"data_id": 1, "page_id": 56} | _klobuchar(parameters), sent)


def _lnav(number: int, layout: Layout, values: dict[str, float], sent: GpsTime) -> int:
    header = {"preamble": LNAV_PREAMBLE, "subframe": number, "tow_s": (sent.tow_s + _SUBFRAME_S * number) % SECONDS_PER_WEEK}
    return with_lnav_parity(layout.write(values | header))


def _klobuchar(parameters: KlobucharParameters) -> dict[str, float]:
    return {f"{name}{k}": v for name, four in (("alpha", parameters.alpha), ("beta", parameters.beta)) for k, v in enumerate(four)}


def _fields(e: KeplerEphemeris | GlonassEphemeris) -> dict[str, float]:
    """Return the numbers of an ephemeris whose names are also the fields' names."""
    return {name: getattr(e, name) for name in e.__slots__ if isinstance(getattr(e, name), int | float)}


# GST to UTC (Galileo OS SIS ICD 2.1, table 69); decoders need nothing of it, but RTKLIB wants it before it takes an ephemeris.
_INAV_6: Final = Layout("I/NAV word 6", 128, (
    Field("word", ((0, 6),)),
    Field("leap_s", ((62, 8),), 1.0, Coding.TWOS_COMPLEMENT),
    Field("t0_s", ((70, 8),), 3600.0),
    Field("week_0", ((78, 8),)),
    Field("week_leap", ((86, 8),)),
    Field("day_leap", ((94, 3),)),
    Field("leap_next_s", ((97, 8),), 1.0, Coding.TWOS_COMPLEMENT),
    Field("tow_s", ((105, 20),)),
))  # fmt: skip


def inav_pages(e: KeplerEphemeris, sent: GpsTime) -> list[int]:
    """Return the I/NAV pages (256 bits, as u-blox lays them out) of words 0 to 6; ValueError if a value does not fit its field."""
    values = _fields(e) | {
        "iodnav": e.iode,
        "toe_s": e.toe.tow_s,
        "toc_s": e.toc.tow_s,
        "sisa": accuracy_index(SISA_M, e.accuracy_m) if e.accuracy_m <= SISA_M[-1] else 255,
        "satellite": e.satellite % SATELLITES_PER_SYSTEM,
        "bgd_e5a_s": e.group_delay_s[0],
        "bgd_e5b_s": e.group_delay_s[1],
        "invalid_e1b": e.health & 1,
        "health_e1b": e.health >> 1 & 3,
        "invalid_e5b": e.health >> 6 & 1,
        "health_e5b": e.health >> 7 & 3,
        "time": 2,
        "leap_s": gps_minus_utc_s(sent),
        "leap_next_s": gps_minus_utc_s(sent),
        "week_0": (sent.week - GST_WEEK_OFFSET) % 256,
        "week_leap": (sent.week - GST_WEEK_OFFSET) % 256,
        "day_leap": 1,
    }
    pages: list[int] = []
    for word, layout in ({**INAV, 6: _INAV_6}).items():
        page_time = sent + _INAV_PAGE_S * word
        header = {"word": word, "week": (page_time.week - GST_WEEK_OFFSET) % 4096, "tow_s": page_time.tow_s}
        pages.append(inav_page(layout.write(values | header)))
    return pages


def inav_page(word: int) -> int:
    """Return the nominal page around a word of 128 data bits, with its CRC (Galileo OS SIS ICD 2.1, 4.3.2.3)."""
    # Data bits 1 to 112 from bit 2 of the page, the other 16 from bit 130; bit 128 marks the odd part.
    page = (word >> 16) << (256 - 114) | 1 << (256 - 129) | (word & 0xFFFF) << (256 - 146)
    covered = next(INAV_PAGE.number(page, field) for field in INAV_PAGE.fields if field.name == "covered")
    return page | crc24q(covered.to_bytes(25, "big")) << (256 - 234)


def beidou_parity(info: int) -> int:
    """Return the four parity bits of 11 information bits: BCH(15, 11, 1) by X^4 + X + 1 (BDS-SIS-ICD-B1I-3.0, 5.1.3)."""
    rest = info << 4
    for bit in range(14, 3, -1):
        if rest >> bit & 1:
            rest ^= 0b10011 << (bit - 4)
    return rest


def with_beidou_parity(block: int) -> int:
    """Return a subframe of ten words with its parity: two codes of 11 bits per word, one of the last 11 bits in word 1."""
    head = block >> 274 & 0x3FFFFFF
    done = head << 4 | beidou_parity(head & 0x7FF)
    for word in range(1, 10):
        info = block >> (30 * (9 - word) + 8) & 0x3FFFFF
        done = done << 30 | info << 8 | beidou_parity(info >> 11) << 4 | beidou_parity(info & 0x7FF)
    return done


def d1_subframes(e: KeplerEphemeris, sent: GpsTime, ionosphere: KlobucharParameters | None = None) -> dict[int, int]:
    """Return BeiDou D1 subframes 1 to 3 (300 bits each); ValueError if a value does not fit its field."""
    start, toe, toc = (time + BDT_MINUS_GPST_S for time in (sent, e.toe, e.toc))
    toe_units = round(toe.tow_s / BEIDOU_TOE_UNIT_S)
    values = _fields(e) | {
        "week": (start.week - BDT_WEEK_OFFSET) % 8192,
        "aode": e.iode,
        "aodc": e.iodc,
        "urai": accuracy_index(URA_M, e.accuracy_m),
        "health": min(e.health, 1),
        "toc_s": toc.tow_s,
        "tgd1_s": e.group_delay_s[0],
        "tgd2_s": e.group_delay_s[1],
        "toe_high": toe_units >> 15,
        "toe_low": toe_units & 0x7FFF,
        "preamble": BEIDOU_PREAMBLE,
    }
    if ionosphere is not None:
        values |= _klobuchar(ionosphere)
    return {
        number: with_beidou_parity(D1[number].write(values | {"subframe": number, "sow_s": (start + _SUBFRAME_S * (number - 1)).tow_s}))
        for number in (1, 2, 3)
    }


def glonass_strings(e: GlonassEphemeris, sent: GpsTime) -> dict[int, int]:
    """Return GLONASS strings 1 to 5 (85 bits each); ``sent`` is a start of a frame, i.e. a multiple of 30 s in UTC."""
    frame, toe = (time.to_utc() + timedelta(seconds=MOSCOW_MINUS_UTC_S) for time in (sent, e.toe))
    period = (frame.year - 1996) // 4
    tb_s = round((toe - toe.replace(hour=0, minute=0, second=0, microsecond=0)).total_seconds()) % SECONDS_PER_DAY
    day = (frame - datetime(1996 + 4 * period, 1, 1, tzinfo=UTC)).days + 1
    values = _fields(e) | {
        "p1": 1,  # tb moves by 30 minutes
        "tk_hours": frame.hour,
        "tk_minutes": frame.minute,
        "tk_half_minutes": frame.second // 30,
        "health": (e.health & 1) << 2,
        "p2": round(tb_s / 900.0) % 2,
        "tb_s": tb_s,
        "p3": 1,
        "ln": e.health >> 1 & 1,
        "tau_n_s": -e.tau_s,
        "delta_tau_n_s": e.group_delay_s,
        "ft": accuracy_index(GLONASS_FT_M, e.accuracy_m),
        "nt_days": day,
        "na_days": day,
        "slot": e.satellite % SATELLITES_PER_SYSTEM,
        "type": 1,
        "n4": period + 1,
    }
    for k, axis in enumerate("xyz"):
        values |= {f"position_{axis}_m": e.position_m[k], f"velocity_{axis}_mps": e.velocity_mps[k]}
        values |= {f"acceleration_{axis}_mps2": e.acceleration_mps2[k]}
    return {number: _with_check_bits(GLONASS_STRING[number].write(values | {"string": number})) for number in (1, 2, 3, 4, 5)}


def _with_check_bits(string: int) -> int:
    return string | glonass_check_bits(string >> 8)
