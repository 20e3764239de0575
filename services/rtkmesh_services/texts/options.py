"""How texts are written: RTKLIB's out-* options."""

from dataclasses import dataclass
from typing import Final, Literal

Format = Literal["llh", "xyz", "enu", "nmea", "stat", "vel_enu"]
TimeSystem = Literal["gpst", "utc", "jst"]
TimeForm = Literal["hms", "tow"]
Angles = Literal["deg", "dms"]
Height = Literal["ellipsoidal", "geodetic"]
Header = Literal["on", "off", "none"]
Dialect = Literal["demo5", "2.4"]
LineEnd = Literal["dialect", "lf", "crlf"]
NmeaRule = Literal["nmea", "rtklib"]
Talker = Literal["GP", "GN"]
StatusLevel = Literal["state", "residual"]

LF: Final = "\n"
CRLF: Final = "\r\n"


@dataclass(frozen=True, slots=True)
class TextOptions:
    r"""How solutions are written; the names in brackets are RTKLIB's.

    ``format``: llh, xyz, enu, vel_enu (rtkrcv_ros), nmea, stat [out-solformat, out-outstat]. Columns of the first four:
    ``time_system`` [out-timesys], ``time_form`` [out-timeform], ``time_decimals`` 0 to 12 [out-timendec], ``angles`` of llh
    [out-degform], ``separator`` between fields, ``\t`` is a tab [out-fieldsep], ``height`` of llh [out-height], ``velocity`` columns of
    llh and xyz [out-outvel]. ``geoid`` is the model, ``internal`` is the only one [out-geoid].

    ``header``: on, off (RTKLIB's: the line with the column names stays) or none [out-outhead]; ``header_options``: the options in it
    [out-outopt]. ``dialect``: demo5 (llh, xyz and enu end in CR LF, as 2.4.3 b34's) or 2.4 (LF, as 2.4.2's); ``line_end`` overrules it.

    ``nmea``: what NMEA 0183 says, or what RTKLIB writes; ``talker`` of RMC, GGA and GST; ``interval_s`` of these three
    [out-nmeaintv1] and ``satellites_interval_s`` of GSA and GSV [out-nmeaintv2] in seconds: 0 every epoch, below 0 never.
    ``status``: records of the states, or those of satellites too [out-outstat].
    """

    format: Format = "llh"
    time_system: TimeSystem = "gpst"
    time_form: TimeForm = "hms"
    time_decimals: int = 3
    angles: Angles = "deg"
    separator: str = " "
    height: Height = "ellipsoidal"
    geoid: str = "internal"
    velocity: bool = False
    header: Header = "on"
    header_options: bool = False
    dialect: Dialect = "demo5"
    line_end: LineEnd = "dialect"
    nmea: NmeaRule = "nmea"
    talker: Talker = "GP"
    interval_s: float = 0.0
    satellites_interval_s: float = 0.0
    status: StatusLevel = "state"

    @property
    def field_separator(self) -> str:
        """What stands between fields: a blank where none is given."""
        return {"": " ", "\\t": "\t"}.get(self.separator, self.separator)

    @property
    def newline(self) -> str:
        """The end of lines that are not NMEA."""
        if self.line_end != "dialect":
            return LF if self.line_end == "lf" else CRLF
        return CRLF if self.dialect == "demo5" and self.format in ("llh", "xyz", "enu") else LF
