"""The word ``solution``: a line per solution, in the coordinates and the time that are asked for."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import asin, atan2, degrees, isfinite, radians, sqrt
from typing import Any, Final

from rtkmesh_schemas.command import Code
from rtkmesh_schemas.solution import SolutionMessage, Vector
from rtkmesh_services.errors import CommandError
from rtkmesh_services.runtime.words import clip, nearest
from rtkmesh_services.solver.screens.satellites import finite
from rtkmesh_services.texts.times import calendar, in_system, instant, week_and_seconds

COORDINATES: Final = ("dms", "deg", "xyz", "enu", "pyl")
TIMES: Final = ("gpst", "utc", "jst", "tow")
MOST: Final = 64  # solutions in one answer
_NAMES: Final = {"NONE": "------"}
_DEVIATIONS: Final = 1  # bits of console-solflag
_AGE: Final = 2


@dataclass(frozen=True, slots=True)
class SolutionForm:
    """RTKRCV's console-soltype, -timetype and -solflag; ``count`` of the newest solutions."""

    coordinates: str = "dms"
    time: str = "gpst"
    flags: int = _AGE
    count: int = 1


def solution_form(args: dict[str, Any]) -> SolutionForm:
    """Return the form that a command's arguments ask for; CommandError names what is wrong."""
    return SolutionForm(
        _choice(args, "coordinates", COORDINATES),
        _choice(args, "time", TIMES),
        whole(args, "flags", _AGE, 3),
        max(1, whole(args, "count", 1, MOST)),
    )


def _choice(args: dict[str, Any], name: str, among: Sequence[str]) -> str:
    """Return a word of ``among``, also given by its number as in RTKLIB's options."""
    given = str(args.get(name, "0")).lower()
    if given.isdecimal() and int(given) < len(among):
        return among[int(given)]
    if given not in among:
        hint = nearest(given, list(among))
        raise CommandError(Code.BAD_ARGUMENTS, f"{name} is one of {', '.join(among)}, not {clip(given)!r}{hint}")
    return given


def whole(args: dict[str, Any], name: str, default: int, most: int) -> int:
    """Return a whole number from 0 to ``most`` of a command's arguments (``-3`` as RTKRCV writes its options is 3)."""
    given = args.get(name, default)
    text = str(given).removeprefix("-")
    if isinstance(given, bool) or not text.isdecimal() or len(text) > 6 or int(text) > most:
        raise CommandError(Code.BAD_ARGUMENTS, f"{name} is a whole number, at most {most}, not {clip(str(given))!r}")
    return int(text)


def solutions_screen(solutions: Sequence[SolutionMessage], form: SolutionForm) -> str:
    """Return a line per solution, oldest first."""
    return "".join(f"{solution_line(solution, form)}\n" for solution in solutions)


def solution_line(solution: SolutionMessage, form: SolutionForm) -> str:
    """Return RTKRCV's line of one solution, without its end."""
    line = f"{_time(solution, form.time)} ({_NAMES.get(solution.status_name, solution.status_name):<6s})"
    if isfinite(sum(solution.position_ecef_m)):
        line += _FORMS[form.coordinates](solution, bool(form.flags & _DEVIATIONS))
    return f"{line} {_age(solution)}" if form.flags & _AGE else line


def _age(solution: SolutionMessage) -> str:
    return f"A:{finite(solution.age_s):4.1f} R:{min(solution.ratio, 999.9):5.1f} N:{solution.satellites_used:2d}"


def _time(solution: SolutionMessage, form: str) -> str:
    time = instant(solution.week, solution.tow_s)
    if form == "tow":
        return f"  {week_and_seconds(time, 2, ' ')}"
    return calendar(time, 1) if form == "gpst" else calendar(in_system(time, "jst" if form == "jst" else "utc"), 2)


def _deviations(covariance: Sequence[float], order: Sequence[tuple[str, int]], unit: str = "") -> str:
    """Return sigmas as RTKRCV shows them; ``order`` has the letters and the rows of the covariance."""
    roots = [(letter, sqrt(max(finite(covariance[4 * row]), 0.0))) for letter, row in order]
    return f" ({' '.join(f'{letter}:{root:6.3f}' for letter, root in roots)}{unit})"


_NEU: Final = (("N", 1), ("E", 0), ("U", 2))
_ENU: Final = (("E", 0), ("N", 1), ("U", 2))
_XYZ: Final = (("X", 0), ("Y", 1), ("Z", 2))


def sexagesimal(angle_deg: float) -> tuple[int, int, float]:
    """Return degrees, minutes and seconds (rounded to 0.0001) of the size of an angle."""
    ten_thousandths = round(abs(angle_deg) * 3600.0 * 1e4)
    minutes, rest = divmod(ten_thousandths, 600000)
    return minutes // 60, minutes % 60, rest / 1e4


def _dms(s: SolutionMessage, wanted: bool) -> str:
    lat, lon = sexagesimal(s.lat_deg), sexagesimal(s.lon_deg)
    line = f" {'S' if s.lat_deg < 0.0 else 'N'}:{lat[0]:2d} {lat[1]:02d} {lat[2]:07.4f}"
    line += f" {'W' if s.lon_deg < 0.0 else 'E'}:{lon[0]:3d} {lon[1]:02d} {lon[2]:07.4f} H:{s.height_m:8.3f}"
    return line + (_deviations(s.position_cov_enu_m2, _NEU) if wanted else "")


def _deg(s: SolutionMessage, wanted: bool) -> str:
    line = f" {'S' if s.lat_deg < 0.0 else 'N'}:{abs(s.lat_deg):11.8f} {'W' if s.lon_deg < 0.0 else 'E'}:{abs(s.lon_deg):12.8f}"
    return f"{line} H:{s.height_m:8.3f}" + (_deviations(s.position_cov_enu_m2, _ENU, "m") if wanted else "")


def _xyz(s: SolutionMessage, wanted: bool) -> str:
    line = "".join(f" {letter}:{value:12.3f}" for letter, value in zip("XYZ", s.position_ecef_m, strict=True))
    return line + (_deviations(s.position_cov_ecef_m2, _XYZ) if wanted else "")


def _enu(s: SolutionMessage, wanted: bool) -> str:
    line = "".join(f" {letter}:{value:12.3f}" for letter, value in zip("ENU", _baseline(s), strict=True))
    return line + (_deviations(s.baseline_cov_enu_m2, _ENU) if wanted else "")


def _pyl(s: SolutionMessage, wanted: bool) -> str:
    pitch_deg, yaw_deg, length_m = pitch_yaw_length(s)
    return f" P:{pitch_deg:12.3f} Y:{yaw_deg:12.3f} L:{length_m:12.3f}" + (_deviations(s.baseline_cov_enu_m2, _ENU) if wanted else "")


_FORMS: Final = {"dms": _dms, "deg": _deg, "xyz": _xyz, "enu": _enu, "pyl": _pyl}


def _baseline(solution: SolutionMessage) -> Vector:
    """Return the baseline (ENU, m), zero where there is none, as RTKRCV prints it."""
    return solution.baseline_enu_m if isfinite(sum(solution.baseline_enu_m)) else (0.0, 0.0, 0.0)


def pitch_yaw_length(solution: SolutionMessage) -> Vector:
    """Return pitch and yaw (deg; yaw from north, clockwise, 0 to 360) and length (m) of the baseline; zeros where there is none."""
    east, north, up = _baseline(solution)
    length_m = sqrt(east**2 + north**2 + up**2)
    if length_m == 0.0:
        return 0.0, 0.0, 0.0
    return degrees(asin(up / length_m)), degrees(atan2(east, north)) % 360.0, length_m


def solution_data(solution: SolutionMessage) -> dict[str, Any]:
    """Return what a solution says, for ``Reply.data``."""
    pitch_deg, yaw_deg, length_m = pitch_yaw_length(solution)
    return {
        **{name: getattr(solution, name) for name in _TOLD},
        "sigma_enu_m": [sqrt(max(solution.position_cov_enu_m2[4 * row], 0.0)) for row in range(3)],
        "baseline_pitch_rad": radians(pitch_deg),
        "baseline_yaw_rad": radians(yaw_deg),
        "baseline_length_m": length_m,
    }


_TOLD: Final = (
    "week", "tow_s", "status", "status_name", "reason", "lat_deg", "lon_deg", "height_m", "position_ecef_m", "velocity_enu_mps",
    "baseline_enu_m", "age_s", "ratio", "satellites_used", "satellites_rover", "satellites_base", "integrity", "fix_probability",
)  # fmt: skip
