"""RTKLIB's enumerations: names with their numbers in each dialect. The same name may have another number in the other one."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

Dialect = Literal["demo5", "2.4"]
DIALECTS: Final[tuple[Dialect, ...]] = ("demo5", "2.4")
Numbers = Mapping[str, int]


@dataclass(frozen=True, slots=True)
class Choices:
    """Names in RTKLIB's order -> number. ``aliases``: names of other versions of the dialect -> the name here."""

    demo5: Numbers
    old: Numbers
    aliases: Mapping[str, str] = field(default_factory=dict[str, str])

    def of(self, dialect: Dialect) -> Numbers:
        """Return names and numbers of a dialect."""
        return self.demo5 if dialect == "demo5" else self.old

    @property
    def differing(self) -> frozenset[int]:
        """Numbers that mean something else in the other dialect."""
        demo5, old = ({number: name for name, number in names.items()} for names in (self.demo5, self.old))
        return frozenset(number for number in {*demo5, *old} if demo5.get(number) != old.get(number))


def _rows(words: str, first: int = 0) -> Numbers:
    return {name: first + number for number, name in enumerate(words.split()) if name != "-"}


def _same(words: str, first: int = 0) -> Choices:
    return Choices(_rows(words, first), _rows(words, first))


SWITCH: Final = _same("off on")
SWITCH_PRECISE: Final = _same("off on precise")
MODES: Final = Choices(
    _rows("single dgps kinematic static static-start movingbase fixed ppp-kine ppp-static ppp-fixed"),
    _rows("single dgps kinematic static movingbase fixed ppp-kine ppp-static ppp-fixed"),
)
FREQUENCIES: Final = Choices(
    _rows("l1 l1+l2 l1+l2+l5 l1+l2+l5+l6", 1),
    _rows("l1 l1+l2 l1+l2+l5 l1+l2+l5+l6 l1+l2+l5+l6+l7", 1),
    {"l1+2": "l1+l2", "l1+2+3": "l1+l2+l5", "l1+2+3+4": "l1+l2+l5+l6", "l1+2+3+4+5": "l1+l2+l5+l6+l7"},
)
DIRECTIONS: Final = Choices(_rows("forward backward combined combined-nophasereset"), _rows("forward backward combined"))
TIDES_OLD: Final = Choices({}, _rows("off on otl"))
IONOSPHERE: Final = Choices(
    _rows("off brdc sbas dual-freq est-stec ionex-tec qzs-brdc"),
    _rows("off brdc sbas dual-freq est-stec ionex-tec qzs-brdc qzs-lex vtec_sf vtec_ef gtec"),
)
TROPOSPHERE: Final = _same("off saas sbas est-ztd est-ztdgrad")
ORBITS: Final = _same("brdc precise brdc+sbas brdc+ssrapc brdc+ssrcom")
AMBIGUITIES: Final = _same("off continuous instantaneous fix-and-hold")
GLONASS_AMBIGUITIES: Final = Choices(_rows("off on autocal fix-and-hold"), _rows("off on autocal"))
SOLUTION_FORMATS: Final = _same("llh xyz enu nmea")
OUTPUT_FORMATS: Final = Choices(_rows("llh xyz enu nmea stat"), _rows("llh xyz enu nmea stat vel_enu"))
TIME_SYSTEMS: Final = _same("gpst utc jst")
TIME_FORMS: Final = _same("tow hms")
ANGLES: Final = _same("deg dms")
HEIGHTS: Final = _same("ellipsoidal geodetic")
GEOIDS: Final = _same("internal egm96 egm08_2.5 egm08_1 gsi2000")
STATIC_SOLUTIONS: Final = _same("all single")
STATUS_LEVELS: Final = _same("off state residual")
POSITIONS: Final = Choices(_rows("llh xyz single posfile rinexhead rtcm"), _rows("llh xyz single posfile rinexhead rtcm"), {"raw": "rtcm"})
CONSOLE_TIMES: Final = _same("gpst utc jst tow")
CONSOLE_FORMS: Final = _same("dms deg xyz enu pyl")
INPUT_TYPES: Final = Choices(
    _rows("off serial file tcpsvr tcpcli - ntripcli ftp http"), _rows("off serial file tcpsvr tcpcli - - ntripcli ftp http")
)
OUTPUT_TYPES: Final = Choices(
    _rows("off serial file tcpsvr tcpcli ntripsvr - - - ntripcas - udpcli"),
    _rows("off serial file tcpsvr tcpcli - ntripsvr - - - ros ntripc_c"),
)
INPUT_FORMATS: Final = Choices(
    _rows("rtcm2 rtcm3 oem4 - ubx swift hemis skytraq javad nvs binex rt17 sbf - unicore rinex sp3 clk"),
    {**_rows("rtcm2 rtcm3 oem4 oem3 ubx ss2 hemis skytraq gw10 javad nvs binex rt17 sbf cmr tersus"), "sp3": 18},
)
NMEA_REQUESTS: Final = _same("off latlon single")
NAVIGATION: Final = _same("all rover base corr")
