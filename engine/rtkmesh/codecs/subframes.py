"""Broadcast navigation data: field tables of the subframes, pages and strings, and their assembly into ephemerides.

The tables number bits from 0 at the first transmitted bit of the block, parity bits included; angles come out in radians,
lengths in metres, times in seconds of the system's own scale. Encoders write from the same tables (``Layout.write``).
"""

from math import ldexp
from typing import Final

from rtkmesh.codecs.bits import Coding, Field, Layout
from rtkmesh.gnss.constants import PI_GPS

_U, _S, _M = Coding.UNSIGNED, Coding.TWOS_COMPLEMENT, Coding.SIGN_MAGNITUDE
Part = tuple[int, int]


def _two(exponent: int) -> float:
    return ldexp(1.0, exponent)


def _semicircles(exponent: int) -> float:
    return ldexp(PI_GPS, exponent)


# --- GPS and QZSS LNAV: 300 bits of ten 30-bit words, parity included (IS-GPS-200N 20.3.3, figures 20-1 and 20-2) ---


def _word(word: int, bit: int, length: int) -> Part:
    """Return the part that starts at ``bit`` (1 to 30) of ``word`` (1 to 10)."""
    return (word - 1) * 30 + bit - 1, length


_LNAV_HEADER: Final = (
    Field("preamble", (_word(1, 1, 8),)),  # 0x8B
    Field("tow_s", (_word(2, 1, 17),), 6.0),  # start of the next subframe
    Field("alert", (_word(2, 18, 1),)),
    Field("anti_spoof", (_word(2, 19, 1),)),
    Field("subframe", (_word(2, 20, 3),)),
)

LNAV_PREAMBLE: Final = 0x8B
LNAV: Final = {
    1: Layout("LNAV subframe 1", 300, (
        *_LNAV_HEADER,
        Field("week", (_word(3, 1, 10),)),
        Field("l2_code", (_word(3, 11, 2),)),
        Field("ura", (_word(3, 13, 4),)),
        Field("health", (_word(3, 17, 6),)),
        Field("iodc", (_word(3, 23, 2), _word(8, 1, 8))),
        Field("l2p_flag", (_word(4, 1, 1),)),
        Field("tgd_s", (_word(7, 17, 8),), _two(-31), _S),
        Field("toc_s", (_word(8, 9, 16),), 16.0),
        Field("af2", (_word(9, 1, 8),), _two(-55), _S),
        Field("af1", (_word(9, 9, 16),), _two(-43), _S),
        Field("af0_s", (_word(10, 1, 22),), _two(-31), _S),
    )),
    2: Layout("LNAV subframe 2", 300, (
        *_LNAV_HEADER,
        Field("iode", (_word(3, 1, 8),)),
        Field("crs_m", (_word(3, 9, 16),), _two(-5), _S),
        Field("delta_n_radps", (_word(4, 1, 16),), _semicircles(-43), _S),
        Field("m0_rad", (_word(4, 17, 8), _word(5, 1, 24)), _semicircles(-31), _S),
        Field("cuc_rad", (_word(6, 1, 16),), _two(-29), _S),
        Field("eccentricity", (_word(6, 17, 8), _word(7, 1, 24)), _two(-33)),
        Field("cus_rad", (_word(8, 1, 16),), _two(-29), _S),
        Field("sqrt_a", (_word(8, 17, 8), _word(9, 1, 24)), _two(-19)),
        Field("toe_s", (_word(10, 1, 16),), 16.0),
        Field("fit", (_word(10, 17, 1),)),
        Field("aodo_s", (_word(10, 18, 5),), 900.0),
    )),
    3: Layout("LNAV subframe 3", 300, (
        *_LNAV_HEADER,
        Field("cic_rad", (_word(3, 1, 16),), _two(-29), _S),
        Field("omega0_rad", (_word(3, 17, 8), _word(4, 1, 24)), _semicircles(-31), _S),
        Field("cis_rad", (_word(5, 1, 16),), _two(-29), _S),
        Field("i0_rad", (_word(5, 17, 8), _word(6, 1, 24)), _semicircles(-31), _S),
        Field("crc_m", (_word(7, 1, 16),), _two(-5), _S),
        Field("omega_rad", (_word(7, 17, 8), _word(8, 1, 24)), _semicircles(-31), _S),
        Field("omega_dot_radps", (_word(9, 1, 24),), _semicircles(-43), _S),
        Field("iode", (_word(10, 1, 8),)),
        Field("idot_radps", (_word(10, 9, 14),), _semicircles(-43), _S),
    )),
    4: Layout("LNAV subframe 4 page 18", 300, (
        *_LNAV_HEADER,
        Field("data_id", (_word(3, 1, 2),)),
        Field("page_id", (_word(3, 3, 6),)),  # 56 is page 18
        Field("alpha0", (_word(3, 9, 8),), _two(-30), _S),
        Field("alpha1", (_word(3, 17, 8),), _two(-27), _S),
        Field("alpha2", (_word(4, 1, 8),), _two(-24), _S),
        Field("alpha3", (_word(4, 9, 8),), _two(-24), _S),
        Field("beta0", (_word(4, 17, 8),), _two(11), _S),
        Field("beta1", (_word(5, 1, 8),), _two(14), _S),
        Field("beta2", (_word(5, 9, 8),), _two(16), _S),
        Field("beta3", (_word(5, 17, 8),), _two(16), _S),
    )),
}  # fmt: skip

# --- Galileo I/NAV: the 128 data bits of a word, 112 from the even and 16 from the odd page part (OS SIS ICD 2.1 4.3.5) ---

_INAV_HEADER: Final = (Field("word", ((0, 6),)),)
_INAV_ISSUE: Final = (*_INAV_HEADER, Field("iodnav", ((6, 10),)))

INAV: Final = {
    0: Layout("I/NAV word 0", 128, (*_INAV_HEADER, Field("time", ((6, 2),)), Field("week", ((96, 12),)), Field("tow_s", ((108, 20),)))),
    1: Layout("I/NAV word 1", 128, (
        *_INAV_ISSUE,
        Field("toe_s", ((16, 14),), 60.0),
        Field("m0_rad", ((30, 32),), _semicircles(-31), _S),
        Field("eccentricity", ((62, 32),), _two(-33)),
        Field("sqrt_a", ((94, 32),), _two(-19)),
    )),
    2: Layout("I/NAV word 2", 128, (
        *_INAV_ISSUE,
        Field("omega0_rad", ((16, 32),), _semicircles(-31), _S),
        Field("i0_rad", ((48, 32),), _semicircles(-31), _S),
        Field("omega_rad", ((80, 32),), _semicircles(-31), _S),
        Field("idot_radps", ((112, 14),), _semicircles(-43), _S),
    )),
    3: Layout("I/NAV word 3", 128, (
        *_INAV_ISSUE,
        Field("omega_dot_radps", ((16, 24),), _semicircles(-43), _S),
        Field("delta_n_radps", ((40, 16),), _semicircles(-43), _S),
        Field("cuc_rad", ((56, 16),), _two(-29), _S),
        Field("cus_rad", ((72, 16),), _two(-29), _S),
        Field("crc_m", ((88, 16),), _two(-5), _S),
        Field("crs_m", ((104, 16),), _two(-5), _S),
        Field("sisa", ((120, 8),)),
    )),
    4: Layout("I/NAV word 4", 128, (
        *_INAV_ISSUE,
        Field("satellite", ((16, 6),)),
        Field("cic_rad", ((22, 16),), _two(-29), _S),
        Field("cis_rad", ((38, 16),), _two(-29), _S),
        Field("toc_s", ((54, 14),), 60.0),
        Field("af0_s", ((68, 31),), _two(-34), _S),
        Field("af1", ((99, 21),), _two(-46), _S),
        Field("af2", ((120, 6),), _two(-59), _S),
    )),
    5: Layout("I/NAV word 5", 128, (
        *_INAV_HEADER,
        Field("ai0", ((6, 11),), _two(-2)),
        Field("ai1", ((17, 11),), _two(-8), _S),
        Field("ai2", ((28, 14),), _two(-15), _S),
        Field("regions", ((42, 5),)),
        Field("bgd_e5a_s", ((47, 10),), _two(-32), _S),
        Field("bgd_e5b_s", ((57, 10),), _two(-32), _S),
        Field("health_e5b", ((67, 2),)),
        Field("health_e1b", ((69, 2),)),
        Field("invalid_e5b", ((71, 1),)),
        Field("invalid_e1b", ((72, 1),)),
        Field("week", ((73, 12),)),
        Field("tow_s", ((85, 20),)),  # start of the page that carries this word
    )),
}  # fmt: skip

# The pages around a word, as u-blox delivers them: even part, 8 bits of padding, odd part, 8 bits of padding (256 bits).
INAV_PAGE: Final = Layout("I/NAV page", 256, (
    Field("even_odd_0", ((0, 1),)),  # 0
    Field("alert_0", ((1, 1),)),
    Field("data", ((2, 112), (130, 16))),
    Field("even_odd_1", ((128, 1),)),  # 1
    Field("alert_1", ((129, 1),)),
    Field("covered", ((0, 114), (128, 82))),  # what the CRC-24Q is computed over
    Field("crc", ((210, 24),)),
))  # fmt: skip

# --- BeiDou D1: 300 bits of ten 30-bit words (BDS-SIS-ICD-B1I-3.0, 5.2.4, figures 5-5 to 5-8; bits numbered from 1 there) ---


def _bits(*parts: tuple[int, int]) -> tuple[Part, ...]:
    """Return the parts given by first and last bit as numbered (from 1) in the BeiDou ICD."""
    return tuple((first - 1, last - first + 1) for first, last in parts)


_BEIDOU_HEADER: Final = (
    Field("preamble", _bits((1, 11))),  # 0x712
    Field("subframe", _bits((16, 18))),
    Field("sow_s", _bits((19, 26), (31, 42))),  # start of this subframe, BDT
)

BEIDOU_PREAMBLE: Final = 0x712
_TENTH_NANOSECOND: Final = 1e-10

D1: Final = {
    1: Layout("D1 subframe 1", 300, (
        *_BEIDOU_HEADER,
        Field("health", _bits((43, 43))),
        Field("aodc", _bits((44, 48))),
        Field("urai", _bits((49, 52))),
        Field("week", _bits((61, 73))),
        Field("toc_s", _bits((74, 82), (91, 98)), 8.0),
        Field("tgd1_s", _bits((99, 108)), _TENTH_NANOSECOND, _S),
        Field("tgd2_s", _bits((109, 112), (121, 126)), _TENTH_NANOSECOND, _S),
        Field("alpha0", _bits((127, 134)), _two(-30), _S),
        Field("alpha1", _bits((135, 142)), _two(-27), _S),
        Field("alpha2", _bits((151, 158)), _two(-24), _S),
        Field("alpha3", _bits((159, 166)), _two(-24), _S),
        Field("beta0", _bits((167, 172), (181, 182)), _two(11), _S),
        Field("beta1", _bits((183, 190)), _two(14), _S),
        Field("beta2", _bits((191, 198)), _two(16), _S),
        Field("beta3", _bits((199, 202), (211, 214)), _two(16), _S),
        Field("af2", _bits((215, 225)), _two(-66), _S),
        Field("af0_s", _bits((226, 232), (241, 257)), _two(-33), _S),
        Field("af1", _bits((258, 262), (271, 287)), _two(-50), _S),
        Field("aode", _bits((288, 292))),
    )),
    2: Layout("D1 subframe 2", 300, (
        *_BEIDOU_HEADER,
        Field("delta_n_radps", _bits((43, 52), (61, 66)), _semicircles(-43), _S),
        Field("cuc_rad", _bits((67, 82), (91, 92)), _two(-31), _S),
        Field("m0_rad", _bits((93, 112), (121, 132)), _semicircles(-31), _S),
        Field("eccentricity", _bits((133, 142), (151, 172)), _two(-33)),
        Field("cus_rad", _bits((181, 198)), _two(-31), _S),
        Field("crc_m", _bits((199, 202), (211, 224)), _two(-6), _S),
        Field("crs_m", _bits((225, 232), (241, 250)), _two(-6), _S),
        Field("sqrt_a", _bits((251, 262), (271, 290)), _two(-19)),
        Field("toe_high", _bits((291, 292))),  # the two most significant of the 17 bits of toe
    )),
    3: Layout("D1 subframe 3", 300, (
        *_BEIDOU_HEADER,
        Field("toe_low", _bits((43, 52), (61, 65))),
        Field("i0_rad", _bits((66, 82), (91, 105)), _semicircles(-31), _S),
        Field("cic_rad", _bits((106, 112), (121, 131)), _two(-31), _S),
        Field("omega_dot_radps", _bits((132, 142), (151, 163)), _semicircles(-43), _S),
        Field("cis_rad", _bits((164, 172), (181, 189)), _two(-31), _S),
        Field("idot_radps", _bits((190, 202), (211, 211)), _semicircles(-43), _S),
        Field("omega0_rad", _bits((212, 232), (241, 251)), _semicircles(-31), _S),
        Field("omega_rad", _bits((252, 262), (271, 291)), _semicircles(-31), _S),
    )),
}  # fmt: skip
BEIDOU_TOE_UNIT_S: Final = 8.0

# --- BeiDou D2, subframe 1: the first 150 bits of ten pages (BDS-SIS-ICD-B1I-3.0, 5.3.3, figure 5-14). Some numbers continue on
# the next page: D2_EPHEMERIS reads all ten pages joined (1500 bits, page p at bit 150 (p - 1)). ---

D2_PAGE_BITS: Final = 150
D2_PAGE: Final = Layout("D2 page", D2_PAGE_BITS, (*_BEIDOU_HEADER, Field("page", _bits((43, 46)))))


def _pages(*parts: tuple[int, int, int]) -> tuple[Part, ...]:
    """Return the parts given by (page, first bit, last bit) as numbered in the BeiDou ICD."""
    return tuple(((page - 1) * D2_PAGE_BITS + first - 1, last - first + 1) for page, first, last in parts)


D2_EPHEMERIS: Final = Layout("D2 subframe 1", 10 * D2_PAGE_BITS, (
    Field("sow_s", _pages((1, 19, 26), (1, 31, 42))),
    Field("health", _pages((1, 47, 47))),
    Field("aodc", _pages((1, 48, 52))),
    Field("urai", _pages((1, 61, 64))),
    Field("week", _pages((1, 65, 77))),
    Field("toc_s", _pages((1, 78, 82), (1, 91, 102)), 8.0),
    Field("tgd1_s", _pages((1, 103, 112)), _TENTH_NANOSECOND, _S),
    Field("tgd2_s", _pages((1, 121, 130)), _TENTH_NANOSECOND, _S),
    Field("alpha0", _pages((2, 47, 52), (2, 61, 62)), _two(-30), _S),
    Field("alpha1", _pages((2, 63, 70)), _two(-27), _S),
    Field("alpha2", _pages((2, 71, 78)), _two(-24), _S),
    Field("alpha3", _pages((2, 79, 82), (2, 91, 94)), _two(-24), _S),
    Field("beta0", _pages((2, 95, 102)), _two(11), _S),
    Field("beta1", _pages((2, 103, 110)), _two(14), _S),
    Field("beta2", _pages((2, 111, 112), (2, 121, 126)), _two(16), _S),
    Field("beta3", _pages((2, 127, 134)), _two(16), _S),
    Field("af0_s", _pages((3, 101, 112), (3, 121, 132)), _two(-33), _S),
    Field("af1", _pages((3, 133, 136), (4, 47, 52), (4, 61, 72)), _two(-50), _S),
    Field("af2", _pages((4, 73, 82), (4, 91, 91)), _two(-66), _S),
    Field("aode", _pages((4, 92, 96))),
    Field("delta_n_radps", _pages((4, 97, 112)), _semicircles(-43), _S),
    Field("cuc_rad", _pages((4, 121, 134), (5, 47, 50)), _two(-31), _S),
    Field("m0_rad", _pages((5, 51, 52), (5, 61, 82), (5, 91, 98)), _semicircles(-31), _S),
    Field("cus_rad", _pages((5, 99, 112), (5, 121, 124)), _two(-31), _S),
    Field("eccentricity", _pages((5, 125, 134), (6, 47, 52), (6, 61, 76)), _two(-33)),
    Field("sqrt_a", _pages((6, 77, 82), (6, 91, 112), (6, 121, 124)), _two(-19)),
    Field("cic_rad", _pages((6, 125, 134), (7, 47, 52), (7, 61, 62)), _two(-31), _S),
    Field("cis_rad", _pages((7, 63, 80)), _two(-31), _S),
    Field("toe_s", _pages((7, 81, 82), (7, 91, 105)), BEIDOU_TOE_UNIT_S),
    Field("i0_rad", _pages((7, 106, 112), (7, 121, 134), (8, 47, 52), (8, 61, 65)), _semicircles(-31), _S),
    Field("crc_m", _pages((8, 66, 82), (8, 91, 91)), _two(-6), _S),
    Field("crs_m", _pages((8, 92, 109)), _two(-6), _S),
    Field("omega_dot_radps", _pages((8, 110, 112), (8, 121, 136), (9, 47, 51)), _semicircles(-43), _S),
    Field("omega0_rad", _pages((9, 52, 52), (9, 61, 82), (9, 91, 99)), _semicircles(-31), _S),
    Field("omega_rad", _pages((9, 100, 112), (9, 121, 134), (10, 47, 51)), _semicircles(-31), _S),
    Field("idot_radps", _pages((10, 52, 52), (10, 61, 73)), _semicircles(-43), _S),
))  # fmt: skip

# --- GLONASS strings: 85 bits, numbered from 85 (first) down to 1 in the ICD (GLONASS ICD 5.1, 4.4, table 4.6 and figure 4.3) ---


def _string(high: int, low: int) -> tuple[Part]:
    """Return the part of the ICD's bits ``high`` down to ``low``."""
    return ((85 - high, high - low + 1),)


_STRING_HEADER: Final = (Field("string", _string(84, 81)),)
_KM: Final = 1e3
GLONASS_TB_UNIT_S: Final = 900.0


def _state(axis: str) -> tuple[Field, ...]:
    return (
        Field(f"velocity_{axis}_mps", _string(64, 41), _KM * _two(-20), _M),
        Field(f"acceleration_{axis}_mps2", _string(40, 36), _KM * _two(-30), _M),
        Field(f"position_{axis}_m", _string(35, 9), _KM * _two(-11), _M),
    )


GLONASS_STRING: Final = {
    1: Layout("GLONASS string 1", 85, (
        *_STRING_HEADER,
        Field("p1", _string(78, 77)),
        Field("tk_hours", _string(76, 72)),  # start of the frame, Moscow time
        Field("tk_minutes", _string(71, 66)),
        Field("tk_half_minutes", _string(65, 65)),
        *_state("x"),
    )),
    2: Layout("GLONASS string 2", 85, (
        *_STRING_HEADER,
        Field("health", _string(80, 78)),  # Bn: only the most significant bit is the user's
        Field("p2", _string(77, 77)),
        Field("tb_s", _string(76, 70), GLONASS_TB_UNIT_S),  # Moscow time of day
        *_state("y"),
    )),
    3: Layout("GLONASS string 3", 85, (
        *_STRING_HEADER,
        Field("p3", _string(80, 80)),
        Field("gamma", _string(79, 69), _two(-40), _M),
        Field("p", _string(67, 66)),
        Field("ln", _string(65, 65)),
        *_state("z"),
    )),
    4: Layout("GLONASS string 4", 85, (
        *_STRING_HEADER,
        Field("tau_n_s", _string(80, 59), _two(-30), _M),
        Field("delta_tau_n_s", _string(58, 54), _two(-30), _M),
        Field("age_days", _string(53, 49)),
        Field("p4", _string(34, 34)),
        Field("ft", _string(33, 30)),
        Field("nt_days", _string(26, 16)),  # day of the four-year period, from 1
        Field("slot", _string(15, 11)),
        Field("type", _string(10, 9)),  # 1: GLONASS-M
    )),
    5: Layout("GLONASS string 5", 85, (
        *_STRING_HEADER,
        Field("na_days", _string(80, 70)),
        Field("tau_c_s", _string(69, 38), _two(-31), _M),
        Field("n4", _string(36, 32)),  # four-year period, from 1 in 1996
        Field("tau_gps_s", _string(31, 10), _two(-30), _M),
        Field("ln", _string(9, 9)),
    )),
}  # fmt: skip


def _check_masks() -> tuple[int, ...]:
    """Return which of the 77 data bits (least significant: ICD bit 9) each of the seven Hamming check bits covers.

    The data bits take the positions 3, 5, 6, 7, 9, ... that are no powers of two; check bit k covers the positions with bit k set.
    """
    positions = [position for position in range(3, 85) if position & (position - 1)]
    return tuple(sum(1 << bit for bit, position in enumerate(positions) if position >> k & 1) for k in range(7))


GLONASS_CHECK_MASKS: Final = _check_masks()


def glonass_check_bits(data: int) -> int:
    """Return the check bits 8 to 1 of a string's 77 data bits 85 to 9 (GLONASS ICD 5.1, 4.7, table 4.13)."""
    hamming = sum(((data & mask).bit_count() & 1) << k for k, mask in enumerate(GLONASS_CHECK_MASKS))
    return hamming | ((data.bit_count() + hamming.bit_count()) & 1) << 7
