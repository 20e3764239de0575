"""Headers: program, notes, legend and column names, in RTKLIB's words."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rtkmesh_services.texts.options import TextOptions
from rtkmesh_services.texts.times import calendar, instant

_LEGEND: Final = "Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites"
_AXES: Final = {
    "llh": ("n", "e", "u", "ne", "eu", "un"),
    "xyz": ("x", "y", "z", "xy", "yz", "zx"),
    "enu": ("e", "n", "u", "en", "nu", "ue"),
}
_COORDINATES: Final = {
    "llh": (("latitude(deg)", 14), ("longitude(deg)", 14), ("height(m)", 10)),
    "dms": (("latitude(d'\")", 16), ("longitude(d'\")", 16), ("height(m)", 10)),
    "xyz": (("x-ecef(m)", 14), ("y-ecef(m)", 14), ("z-ecef(m)", 14)),
    "enu": (("e-baseline(m)", 14), ("n-baseline(m)", 14), ("u-baseline(m)", 14)),
    "vel_enu": (("V_East(m/s)", 14), ("V North(m/s)", 14), ("V Up(m/s)", 14)),
}
_VEL_ENU_SIGMAS: Final = ("VE", "VN", "VU", "VEN", "VNU", "VEU")


@dataclass(frozen=True, slots=True)
class TextAbout:
    """What a header tells: the program, and notes as (name, text) in RTKLIB's manner: ``inp file``, ``obs start``, ``ref pos``.

    ``options`` are those notes that only ``header_options`` asks for: ``pos mode``, ``freqs``, ``elev mask``, ...
    """

    program: str
    notes: Sequence[tuple[str, str]] = ()
    options: Sequence[tuple[str, str]] = ()


def header(about: TextAbout, options: TextOptions) -> str:
    """Return the lines before the first solution, with their ends; "" for formats that have none."""
    if options.format in ("nmea", "stat") or options.header == "none":
        return ""
    lines = [] if options.header == "off" else _about(about, options)
    end = options.newline
    return end.join([*lines, _column_line(options)]) + end


def time_note(week: int, tow_s: float) -> str:
    """Return a GPS time as the header's ``obs start`` and ``obs end`` have it."""
    return f"{calendar(instant(week, tow_s), 1)} GPST (week{week:04d} {tow_s:8.1f}s)"


def position_note(position_ecef_m: Sequence[float]) -> str:
    """Return a position as the header's ``ref pos`` has it."""
    x, y, z = position_ecef_m
    return f"{x:14.4f} {y:14.4f} {z:14.4f}"


def _about(about: TextAbout, options: TextOptions) -> list[str]:
    notes = [*about.notes, *(about.options if options.header_options else ())]
    lines = [f"% program   : {about.program}", *(f"% {name:<10}: {text}" for name, text in notes)]
    return [*lines, "%", f"% ({_frame(options)},{_LEGEND})"]


def _frame(options: TextOptions) -> str:
    if options.format == "xyz":
        return "x/y/z-ecef=WGS84"
    if options.format == "enu":
        return "e/n/u-baseline=WGS84"
    return f"lat/lon/height=WGS84/{options.height}"


def _column_line(options: TextOptions) -> str:
    width = (16 if options.time_form == "hms" else 8) + options.time_decimals + 1
    columns = _COORDINATES["dms" if options.format == "llh" and options.angles == "dms" else options.format]
    names = [f"{name:>{size}}" for name, size in (*columns, ("Q", 3), ("ns", 3))]
    names += [*_sigmas(options), "age(s)", f"{'ratio':>6}"]
    if options.velocity and options.format in ("llh", "xyz"):
        names += _velocity(_AXES[options.format])
    separator = options.field_separator
    return f"%  {options.time_system.upper():<{width}}{separator}{separator.join(names)}"


def _sigmas(options: TextOptions) -> list[str]:
    if options.format == "vel_enu":
        return [f"{f'std_{axis}(m/s)':>8}" for axis in _VEL_ENU_SIGMAS]
    return [f"{f'sd{axis}(m)':>8}" for axis in _AXES[options.format]]


def _velocity(axes: Sequence[str]) -> list[str]:
    sigmas = [f"{f'sdv{axis}':>{9 if k == 0 else 8}}" for k, axis in enumerate(axes)]
    return [*(f"{f'v{axis}(m/s)':>10}" for axis in axes[:3]), *sigmas]
