"""The keys of RTKLIB that say how solutions are written, and where they go in an output of ours."""

from typing import Final

_TABLES: Final = ("llh", "xyz", "enu", "vel_enu")
# key -> (field of [output.ID], formats that it is of)
TEXTS: Final[dict[str, tuple[str, tuple[str, ...]]]] = {
    "out-outhead": ("header", _TABLES),
    "out-outopt": ("header_options", _TABLES),
    "out-outvel": ("velocity", ("llh", "xyz")),
    "out-timesys": ("time_system", _TABLES),
    "out-timeform": ("time_form", _TABLES),
    "out-timendec": ("time_decimals", _TABLES),
    "out-degform": ("angles", ("llh",)),
    "out-fieldsep": ("separator", _TABLES),
    "out-height": ("height", ("llh",)),
    "out-outsingle": ("single", (*_TABLES, "nmea")),
    "out-maxsolstd": ("max_sigma_m", (*_TABLES, "nmea")),
    "out-nmeaintv1": ("nmea_interval_s", ("nmea",)),
    "out-nmeaintv2": ("nmea_satellites_interval_s", ("nmea",)),
}
