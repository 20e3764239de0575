"""Faults of ``[output.ID]`` tables: what is sent, which keys have a meaning for it, whose serial port it is."""

import re
from collections.abc import Callable
from typing import Final

import msgspec

from rtkmesh_schemas.config import Deployment, OutputTable
from rtkmesh_schemas.config_output import POS_FORMATS
from rtkmesh_services.runtime.port_owners import baud_difference, rival_of_port
from rtkmesh_services.runtime.words import clip

Fault = Callable[[str, str], None]  # of a key ("": the table), what is wrong
_MOUNT: Final = re.compile(r"[A-Za-z0-9_.-]{1,100}")
_DEFAULTS: Final = {field.name: field.default for field in msgspec.structs.fields(OutputTable)}
_TEXTS: Final = (*POS_FORMATS, "nmea", "stat")
# key -> formats of a solver's text that it has a meaning for
_OF_FORMATS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("time_system", "time_form", "time_decimals", "separator", "header", "header_options"), POS_FORMATS),
    **dict.fromkeys(("angles", "height"), ("llh",)),
    "velocity": ("llh", "xyz"),
    **dict.fromkeys(("nmea_rule", "talker", "nmea_interval_s", "nmea_satellites_interval_s"), ("nmea",)),
    "status_level": ("stat",),
    **dict.fromkeys(("dialect", "line_end", "single"), _TEXTS),
    "max_sigma_m": (*POS_FORMATS, "nmea", "json"),
    "format": (*_TEXTS, "json"),
}
_OF_FRAMES: Final = ("protocol", "messages", "encode")
_OF_ENCODE: Final = ("station_id", "systems", "bytes_per_second", "station_interval_s", "ephemeris_interval_s")
# key -> targets that it has a meaning for
_OF_TARGETS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("users", "anonymous"), ("ntrip-caster",)),
    "maximum_clients": ("ntrip-caster", "tcp-listen"),
    "maximum_delay_s": ("serial", "tcp", "tcp-listen", "udp", "ntrip", "ntrips", "stdout"),
}


def check_output_table(table: OutputTable, fault: Fault) -> bool:
    """Gather what is wrong with a table by itself; False where it is not even clear what it sends."""
    given = [name for name in ("solver", "receiver", "mounts") if getattr(table, name)]
    wants_mounts = table.scheme == "ntrip-caster" and "/" not in table.target.partition("://")[2].strip("/")
    if len(given) != 1 or (given[0] == "mounts") != wants_mounts:
        has = f"has {' and '.join(repr(name) for name in given)}" if given else "says nothing"
        either = "mounts (or, with a mount point in the target, solver or receiver)" if wants_mounts else "solver or receiver"
        fault("", f"{has} where it needs {either}: what is to be sent")
        return False
    if table.encode and (table.solver or table.protocol != "rtcm3"):
        what = "a solver's lines" if table.solver else f'protocol = "{table.protocol}"'
        fault("encode", f"encode makes RTCM 3 of a receiver's stream, and this is {what}")
    for name in table.mounts:
        if not _MOUNT.fullmatch(name):
            fault(f"mounts.{name}", f"mounts: {clip(name)!r} is no mount point: letters, digits, '_', '-', '.'")
    _check_meanings(table, fault)
    return True


def check_ports(deployment: Deployment, id: str, fault: Fault) -> None:  # noqa: A002  the word of the design
    """Gather what is wrong with a serial port: it belongs to one output, or to an ingest that writes for others."""
    target = deployment.output[id].target
    if rival := rival_of_port(deployment.output, id):
        fault("target", f"target: [output.{rival}] has this port already")
    if said := baud_difference(deployment, target):
        fault("target", f"target: {said}")


def _check_meanings(table: OutputTable, fault: Fault) -> None:
    """Every key that was given must change something."""
    for name in (name for name, default in _DEFAULTS.items() if default is not msgspec.NODEFAULT and getattr(table, name) != default):
        if reason := _no_meaning(table, name):
            fault(name, f"{name} {reason}")


def _no_meaning(table: OutputTable, name: str) -> str:
    """Return why a key has no meaning in this table, or nothing."""
    if name in _OF_FORMATS and not table.solver:
        return "is about a solver's text, and this sends a receiver's frames"
    if name in _OF_FORMATS and table.format not in _OF_FORMATS[name]:
        return f"is of format {', '.join(_OF_FORMATS[name])}, and this is {table.format}"
    if name in _OF_FRAMES and table.solver and name != "encode":
        return "is about a receiver's frames, and this writes a solver's solutions"
    if name in (*_OF_ENCODE, *(() if table.solver else ("interval_s",))) and not table.encode:
        return "is about frames that are made: it needs encode"
    if table.scheme not in _OF_TARGETS.get(name, (table.scheme,)):
        return f"is of targets {', '.join(f'{scheme}://' for scheme in _OF_TARGETS[name])}"
    return ""
