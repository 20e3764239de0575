"""Ephemeris logs of NovAtel receivers (OEM7 commands and logs reference manual v15C, 3).

GPSEPHEM, QZSSEPHEMERIS, GLOEPHEMERIS and GALEPHEMERIS have the fields that Unicore took over. RAWEPHEM and QZSSRAWEPHEM are subframes 1 to
3 without their parity.
"""

from typing import Final

from rtkmesh.codecs.accuracy import URA_M
from rtkmesh.codecs.ephemerides import BEIDOU_FIT_S, kepler_ephemeris, lnav_ephemeris
from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.subframes import LNAV, LNAV_PREAMBLE
from rtkmesh.codecs.unicore_ephemeris import CLOCK, ORBIT, QZSS_PRN_OFFSET, READERS, Reader, Values, galileo, satellite_of
from rtkmesh.codecs.unicore_logs import Fields, Log
from rtkmesh.gnss.beidou import message_on_b1i
from rtkmesh.gnss.constants import BDT_MINUS_GPST_S
from rtkmesh.gnss.ephemeris import Ephemeris
from rtkmesh.gnss.signals import BEIDOU, GPS, QZSS
from rtkmesh.gnss.time import GpsTime

SUBFRAMES: Final = (1, 2, 3)
SUBFRAME_BYTES: Final = 30
_RAW_FIRST: Final = 12  # offset of the first subframe
RAW: Final = {"RAWEPHEM": (GPS, 32, 0), "QZSSRAWEPHEM": (QZSS, 10, QZSS_PRN_OFFSET)}  # system, last satellite, PRN - number

_LONG_ORBIT: Final = (
    "m0_rad", "delta_n_radps", "eccentricity", "sqrt_a", "i0_rad", "idot_radps", "omega0_rad", "omega_rad", "omega_dot_radps", "cuc_rad",
    "cus_rad", "crc_m", "crs_m", "cic_rad", "cis_rad",
)  # fmt: skip
BEIDOU_NAMES: Final = (
    "prn", "week", "ura_m", "health", "tgd1_s", "tgd2_s", "iodc", "toc_s", *CLOCK, "iode", "toe_s", "sqrt_a", "eccentricity", "omega_rad",
    "delta_n_radps", "m0_rad", "omega0_rad", "omega_dot_radps", "i0_rad", "idot_radps", "cuc_rad", "cus_rad", "crc_m", "crs_m", "cic_rad",
    "cis_rad",
)  # fmt: skip
INAV_NAMES: Final = (
    "prn", "health_e5b", "invalid_e5b", "reserved1", "reserved2", "health_e1b", "invalid_e1b", "reserved3", "reserved4", "iode", "sisa",
    "source", "toe_s", "inav_toc_s", *_LONG_ORBIT, *(f"inav_{name}" for name in CLOCK), "bgd_e5a_s", "bgd_e5b_s",
)  # fmt: skip
FNAV_NAMES: Final = (
    "prn", "health_e5a", "invalid_e5a", "reserved1", "reserved2", "iode", "sisa", "reserved3", "toe_s", "fnav_toc_s", *_LONG_ORBIT,
    *(f"fnav_{name}" for name in CLOCK), "bgd_e5a_s",
)  # fmt: skip
_ORBIT_LAYOUT: Final = "d" * (len(ORBIT) + 1)
BEIDOU_FIELDS: Final = Fields(f"IIdIddIIdddII{_ORBIT_LAYOUT}")
INAV_FIELDS: Final = Fields(f"IBBBBBBBBHBBII{_ORBIT_LAYOUT}ddddd")
FNAV_FIELDS: Final = Fields(f"IBBBBHBBII{_ORBIT_LAYOUT}dddd")
_NOT_SAID: Final = dict.fromkeys(
    ("inav", "fnav", "health_e1b", "health_e5a", "health_e5b", "invalid_e1b", "invalid_e5a", "invalid_e5b", "bgd_e5b_s"), 0
)


def _beidou(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    """Times of week are BDT."""
    values = {**v, "toe_s": v["toe_s"] - BDT_MINUS_GPST_S, "toc_s": v["toc_s"] - BDT_MINUS_GPST_S}
    number = satellite_of(BEIDOU, v["prn"], 63)
    if number == 0 or not 0.0 <= v["ura_m"] <= URA_M[-1]:
        return [None]
    return [kepler_ephemeris(
        number, message_on_b1i(number), values, sent, (int(v["iode"]), int(v["iodc"])), BEIDOU_FIT_S, accuracy_m=v["ura_m"],
        health=int(v["health"]) & 1, delays_s=(v["tgd1_s"], v["tgd2_s"]),
    )]  # fmt: skip


def _inav(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    return galileo({**_NOT_SAID, **v, "inav": 1}, sent)


def _fnav(v: Values, sent: GpsTime) -> list[Ephemeris | None]:
    return galileo({**_NOT_SAID, **v, "fnav": 1}, sent)


NOVATEL_READERS: Final[dict[str, Reader]] = {
    "GPSEPHEM": READERS["GPSEPH"],
    "QZSSEPHEMERIS": READERS["QZSSEPH"],
    "GLOEPHEMERIS": READERS["GLOEPH"],
    "GALEPHEMERIS": READERS["GALEPH"],
    "GALINAVEPHEMERIS": (INAV_NAMES, INAV_FIELDS, _inav),
    "GALFNAVEPHEMERIS": (FNAV_NAMES, FNAV_FIELDS, _fnav),
    "BDSEPHEMERIS": (BEIDOU_NAMES, BEIDOU_FIELDS, _beidou),
}


def read_raw_ephemeris(log: Log) -> list[Message] | str:
    """Return the ephemeris of the subframes of RAWEPHEM or QZSSRAWEPHEM, or why it is rejected."""
    prn, sent = _subframes(log.body)
    if any(len(subframe) != SUBFRAME_BYTES for subframe in sent):
        return "length"
    if log.time is None:
        return "time"
    system, last, offset = RAW[log.name]
    number, blocks = satellite_of(system, prn - offset, last), {i: _block(subframe) for i, subframe in zip(SUBFRAMES, sent, strict=True)}
    if number == 0:
        return "satellite"
    heads = {i: LNAV[i].read(block) for i, block in blocks.items()}
    if any(int(head["preamble"]) != LNAV_PREAMBLE or int(head["subframe"]) != i for i, head in heads.items()):
        return "subframe"
    found = lnav_ephemeris(number, blocks, log.time)
    return "orbit" if found is None else [found]


def _subframes(body: bytes | list[str]) -> tuple[int, list[bytes]]:
    """Return the PRN and the three subframes, empty ones where they are not whole."""
    if isinstance(body, bytes):
        starts = range(_RAW_FIRST, _RAW_FIRST + SUBFRAME_BYTES * len(SUBFRAMES), SUBFRAME_BYTES)
        return int.from_bytes(body[:4], "little"), [body[at : at + SUBFRAME_BYTES] for at in starts]
    try:
        return int(body[0]), [bytes.fromhex(body[2 + i]) for i in SUBFRAMES]
    except (ValueError, IndexError):
        return 0, [b""]


def _block(subframe: bytes) -> int:
    """Return ten words of 24 bits as a subframe of 300 bits whose parity is zero."""
    block = 0
    for at in range(0, SUBFRAME_BYTES, 3):
        block = block << 30 | int.from_bytes(subframe[at : at + 3], "big") << 6
    return block
