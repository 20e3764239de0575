"""The commands to a base station: survey_start, survey_stop, survey_status, fix_position, use_preset, save_preset, presets."""

from collections.abc import Callable, Mapping
from math import hypot, nan
from typing import Any, Final

import msgspec

from rtkmesh.gnss.signals import SYSTEMS
from rtkmesh_schemas.base import BasePosition
from rtkmesh_schemas.command import Code, Reply, Request
from rtkmesh_services.errors import CommandError
from rtkmesh_services.ingest.base.found import Found
from rtkmesh_services.ingest.base.station import BaseStation
from rtkmesh_services.ingest.base.status import survey_status
from rtkmesh_services.ingest.receivers.base_messages import MESSAGE_SETS, message_orders
from rtkmesh_services.ingest.receivers.orders import Order
from rtkmesh_services.ingest.receivers.survey import Position
from rtkmesh_services.runtime.service import accepted, done

OPERATIONS: Final[Mapping[str, str]] = {
    "survey_start": "[minimum_s=60] [accuracy_m=1] [messages=msm4|msm7] [systems=GREC]: find the position of the base anew",
    "survey_stop": "end it: the receiver is a rover again",
    "survey_status": "how it goes (SurveyStatus)",
    "fix_position": "position_ecef_m=[X,Y,Z] [accuracy_m=0.02] [messages=msm4|msm7] [systems=GREC]: tell the receiver where it stands",
    "use_preset": "name=NAME [unchecked=true]: tell the receiver a saved position, if its own fixes agree",
    "save_preset": "name=NAME [replace=true] [antenna=NAME] [antenna_height_m=0]: save the present position",
    "presets": "the saved positions (BasePosition)",
}
_SHORTEST_S, _LONGEST_S = 1.0, 86400.0
_BEST_M, _WORST_M = 0.001, 100.0
_LOWEST_M, _HIGHEST_M = 6.3e6, 6.4e6


def base_command(station: BaseStation, request: Request, now_s: float) -> Reply:
    """Do a command; CommandError says why not."""
    made: dict[str, Callable[[BaseStation, Request, float], Reply]] = {
        "survey_start": _start,
        "survey_stop": _stop,
        "survey_status": _tell,
        "fix_position": _fix,
        "use_preset": _use,
        "save_preset": _save,
        "presets": _list,
    }
    return made[request.op](station, request, now_s)


def _start(station: BaseStation, request: Request, now_s: float) -> Reply:
    if station.dialect is None and station.table.mode != "average":
        raise CommandError(Code.WRONG_STATE, "the receiver is one that we cannot ask for a survey: say receiver = in [base_station]")
    minimum_s = _number(request.args, "minimum_s", station.minimum_s, _SHORTEST_S, _LONGEST_S)
    accuracy_m = _number(request.args, "accuracy_m", station.accuracy_m, _BEST_M, _WORST_M)
    station.messages = _messages(station, request.args)
    station.survey(minimum_s, accuracy_m, now_s)
    return accepted(f"survey of at least {minimum_s:g} s, to {accuracy_m:g} m", **_status(station, now_s))


def _stop(station: BaseStation, request: Request, now_s: float) -> Reply:
    del request
    station.stop()
    return accepted("the receiver is told to be a rover" if station.dialect else "stopped", **_status(station, now_s))


def _tell(station: BaseStation, request: Request, now_s: float) -> Reply:
    del request
    return done(station.state, **_status(station, now_s))


def _fix(station: BaseStation, request: Request, now_s: float) -> Reply:
    position = _position(request.args.get("position_ecef_m"))
    accuracy_m = _number(request.args, "accuracy_m", 0.02, _BEST_M, _WORST_M)
    if station.dialect is None:
        raise CommandError(Code.WRONG_STATE, "the receiver is one that we cannot tell a position: say receiver = in [base_station]")
    station.messages = _messages(station, request.args)
    station.use(station.as_saved("", Found(position, accuracy_m, "operator"), request.caller or "a command"), now_s, unchecked=True)
    return accepted("telling the receiver its position", **_status(station, now_s))


def _use(station: BaseStation, request: Request, now_s: float) -> Reply:
    name = _name(request.args)
    position = station.store.get(name)
    if position is None:
        raise CommandError(Code.NOT_FOUND, f"there is no position {name!r}")
    unchecked = request.args.get("unchecked", False) is True
    station.use(position, now_s, unchecked=unchecked)
    return accepted("telling the receiver" if unchecked else "comparing with the receiver's own fixes", **_status(station, now_s))


def _save(station: BaseStation, request: Request, now_s: float) -> Reply:
    del now_s
    name, found = _name(request.args, station.name), station.present()
    if found is None:
        raise CommandError(Code.WRONG_STATE, "no position is known yet")
    antenna = str(request.args.get("antenna", ""))[:40]
    given = request.args.get("antenna_height_m")
    height_m = None if given is None else _number(request.args, "antenna_height_m", 0.0, -10.0, 100.0)
    position = station.as_saved(name, found, request.caller or "a command", antenna=antenna, height_m=height_m)
    before = station.store.save(position, replace=request.args.get("replace", False) is True)
    station.trust(position)
    told: dict[str, Any] = {"position": msgspec.to_builtins(position), "replaced": before and msgspec.to_builtins(before)}
    return done(f"saved as {name!r}", **told)


def _list(station: BaseStation, request: Request, now_s: float) -> Reply:
    del request, now_s
    there: list[BasePosition] = [preset.current for preset in station.store.all().values() if preset.current is not None]
    return done(f"{len(there)} saved", presets=[msgspec.to_builtins(position) for position in there])


def _status(station: BaseStation, now_s: float) -> dict[str, Any]:
    status: dict[str, Any] = msgspec.to_builtins(survey_status(station, now_s))
    return status


def _messages(station: BaseStation, arguments: Mapping[str, Any]) -> list[Order]:
    """Return what the receiver is told about the corrections that it sends; nothing without ``messages``."""
    message_set, systems = arguments.get("messages", ""), arguments.get("systems", "")
    if message_set not in ("", *MESSAGE_SETS):
        raise CommandError(Code.BAD_ARGUMENTS, f"messages is one of {', '.join(MESSAGE_SETS)}")
    if not isinstance(systems, str) or not set(systems) <= set(SYSTEMS):
        raise CommandError(Code.BAD_ARGUMENTS, f"systems are letters of {SYSTEMS}")
    return message_orders(station.dialect.name, message_set, systems) if station.dialect is not None and message_set else []


def _position(given: Any) -> Position:
    """Return a position near the ground."""
    parts = given.split(",") if isinstance(given, str) else given
    try:
        x, y, z = (float(part) for part in parts)
    except (TypeError, ValueError):
        x = y = z = nan
    if not _LOWEST_M < hypot(x, y, z) < _HIGHEST_M:
        raise CommandError(Code.BAD_ARGUMENTS, "position_ecef_m is X, Y, Z in metres of a place on earth")
    return x, y, z


def _name(arguments: Mapping[str, Any], default: str = "") -> str:
    return check_name(arguments.get("name", default))


def check_name(name: Any) -> str:
    """Return a position's name; CommandError if it is none."""
    if not isinstance(name, str) or not name or len(name) > 64 or not all(c.isascii() and (c.isalnum() or c in "_.-") for c in name):
        raise CommandError(Code.BAD_ARGUMENTS, "name= a saved position: letters, digits, '_', '-', '.', at most 64")
    return name


def _number(arguments: Mapping[str, Any], name: str, default: float, least: float, most: float) -> float:
    given = arguments.get(name, default)
    try:
        value = float(given)
    except (TypeError, ValueError):
        value = float("nan")
    if isinstance(given, bool) or not least <= value <= most:
        raise CommandError(Code.BAD_ARGUMENTS, f"{name} is a number from {least:g} to {most:g}")
    return value
