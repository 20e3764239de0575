"""Marks: what RTKRCV's word ``mark`` writes into an output."""

from collections.abc import Mapping
from math import isfinite
from typing import Any, Final

from rtkmesh.gnss.sentences import sentence
from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.times import calendar, instant

_DECIMALS: Final = 3
_RESERVED: Final = str.maketrans({"*": " ", "$": " "})  # NMEA 0183: they begin and end what a sentence says


def mark(data: Mapping[str, Any], options: TextOptions) -> str:
    """Return the line of a mark with its end.

    ``data`` is that of the solver's event ``mark``: name, comment, week, tow_s, status, position_ecef_m, lat_deg, lon_deg, height_m.
    What is missing or not known is 0 or empty, as RTKRCV prints it before the first solution.
    """
    name, comment = _word(data, "name"), _word(data, "comment")
    status = int(data.get("status") or 0)
    if options.format == "stat":
        x, y, z = (_number(value) for value in data.get("position_ecef_m") or (0.0, 0.0, 0.0))
        time = f"{int(_number(data.get('week')))},{_number(data.get('tow_s')):.3f}"
        return f"$MARK,{time},{status},{x:.4f},{y:.4f},{z:.4f},{name},{comment}{options.newline}"
    rest = f"{name},{_place(data)},{status},{comment}"
    if options.format == "nmea":
        return sentence("GPTXT,01,01,02,MARK:" + rest.translate(_RESERVED))
    return f"% MARK: {rest}{options.newline}"


def _place(data: Mapping[str, Any]) -> str:
    time = calendar(instant(int(_number(data.get("week"))), _number(data.get("tow_s"))), _DECIMALS)
    lat_deg, lon_deg, height_m = (_number(data.get(name)) for name in ("lat_deg", "lon_deg", "height_m"))
    return f"{time},{lat_deg:.9f},{lon_deg:.9f},{height_m:.4f}"


def _word(data: Mapping[str, Any], name: str) -> str:
    """Return a text of the user as one line of printable ASCII."""
    text = str(data.get(name) or "")
    return "".join(letter if " " <= letter <= "~" else "?" for letter in text)


def _number(value: Any) -> float:
    """Return a number that can be printed."""
    return float(value) if isinstance(value, int | float) and isfinite(value) else 0.0
