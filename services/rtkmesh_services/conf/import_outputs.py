"""The outputs and logs of a .conf file -> the tables [output.ID], [recorder.ID], [ros2.ID]."""

import re
from collections.abc import Callable
from typing import Any, Final

from rtkmesh_services.conf.import_inputs import INPUTS, credentials
from rtkmesh_services.conf.paths import file_path, network_path, serial_path
from rtkmesh_services.conf.report import Draft
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.conf.text_keys import TEXTS
from rtkmesh_services.errors import ConfError

_DEFAULTS: Final[dict[str, Any]] = {
    "header": "on", "header_options": False, "velocity": False, "time_system": "gpst", "time_form": "hms", "time_decimals": 3,
    "angles": "deg", "separator": " ", "height": "ellipsoidal", "single": False, "max_sigma_m": 0.0, "nmea_interval_s": 0.0,
    "nmea_satellites_interval_s": 0.0,
}  # fmt: skip
_SWITCHES: Final = ("header_options", "velocity", "single")
_MOST_DECIMALS: Final = 12
_TOPIC: Final = re.compile(r"/?[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*")
_STATUS_FILE: Final = "rtkrcv_%Y%m%d%h%M.stat"


def import_outputs(draft: Draft, ingests: list[str]) -> None:
    """Enter outputs and recorders and say what became of their keys."""
    formats = [_solution(draft, number) for number in "12"]
    _status(draft)
    _say_texts(draft, {name for name in formats if name})
    for number, name in INPUTS.items():
        _log(draft, number, draft.id_of(name) if draft.id_of(name) in ingests else "")
    swaps = any("::S=" in draft.conf.text(f"{stream}-path") for stream in ("outstr1", "outstr2"))
    why = "?margin of the files that are swapped" if swaps else "no solution file is swapped; recorders swap without a margin"
    draft.note("misc-fswapmargin", Fate.TAKEN if swaps else Fate.IGNORED, "output.*.target", why)


def _solution(draft: Draft, number: str) -> str:
    """Enter an output of solutions and return its format, empty where there is none."""
    kind, keys = draft.conf.choice(f"outstr{number}-type"), [f"outstr{number}-{name}" for name in ("type", "path", "format")]
    id_ = draft.id_of(f"solution{number}")
    if kind == "off":
        for name in keys:
            draft.note(name, Fate.TAKEN if name.endswith("type") else Fate.IGNORED, "", "the output is off")
        return ""
    form = draft.conf.choice(keys[2])
    draft.note(keys[0], Fate.TAKEN, f"output.{id_}.target")
    draft.note(keys[2], Fate.TAKEN, f"output.{id_}.format")
    draft.put(("output", id_, "target"), _target(draft, keys[1], id_, kind), *keys[:2])
    draft.put(("output", id_, "solver"), draft.solver_id)
    draft.put(("output", id_, "format"), form, keys[2])
    _write_texts(draft, id_, form)
    if kind == "ros":
        _ros(draft, keys[0], id_)
    return form


def _target(draft: Draft, key: str, id_: str, kind: str) -> str:
    """Return the URL of an output; a reference to the environment where the path is none."""
    try:
        url, note = _URLS[kind](draft, id_, draft.conf.text(key))
    except ConfError as error:
        url = draft.placeholder(f"{id_}_target", f"{_EXAMPLES[kind]} ({key}: {error})")
        draft.note(key, Fate.TRANSLATED, f"output.{id_}.target", f"{error}: say it in the environment, {url}", alters=True)
        return url
    draft.note(key, Fate.TRANSLATED, f"output.{id_}.target", note)
    return url


_EXAMPLES: Final = {
    "serial": "serial:///dev/ttyUSB0?baud=115200",
    "file": "file://solution.pos",
    "tcpsvr": "tcp-listen://0.0.0.0:PORT",
    "tcpcli": "tcp://HOST:PORT",
    "ntripsvr": "ntrip://:PASSWORD@HOST:2101/MOUNT",
    "ntripcas": "ntrip-caster://0.0.0.0:2101/MOUNT",
    "udpcli": "udp://HOST:PORT",
    "ros": "zenoh://TOPIC",
}


def _serial(draft: Draft, id_: str, text: str) -> tuple[str, str]:
    port = serial_path(text)
    return f"serial:///dev/{port.device}?baud={port.baud}", f"{port.strange} is not taken" if port.strange else ""


def _file(draft: Draft, id_: str, text: str) -> tuple[str, str]:
    file = file_path(text)
    if not file.path:
        return "stdout://", "no path: the standard output, as RTKLIB"
    options = [f"swap={file.swap_hours}", f"margin={draft.conf.number('misc-fswapmargin'):g}"] if file.swap_hours else []
    options += ["tags=yes"] if file.tags else []
    note = "a file that is there is never overwritten: the next one gets a number"
    return f"file://{file.path}{'?' if options else ''}{'&'.join(options)}", note


def _host(text: str, scheme: str, fallback: str, note: str = "") -> tuple[str, str]:
    path = network_path(text)
    if not path.port:
        raise ConfError("the path has no port")
    return f"{scheme}://{path.host or fallback}:{path.port}", note


def _feed(draft: Draft, id_: str, text: str) -> tuple[str, str]:
    path = network_path(text)
    if not path.host or not path.mount:
        raise ConfError("the path has no host or no mount point")
    where = f"{path.host}:{path.port or 80}/{path.mount}"
    return f"ntrip://{credentials(draft, f'{id_}_password', path.user, path.password)}{where}", ""


def _caster(draft: Draft, id_: str, text: str) -> tuple[str, str]:
    path = network_path(text)
    if not path.mount:
        raise ConfError("the path has no mount point")
    if path.user:
        draft.put(("output", id_, "users"), {path.user: draft.secret(f"{id_}_password", path.password)})
    else:
        draft.put(("output", id_, "anonymous"), True)
    return f"ntrip-caster://{path.host or _EVERYWHERE}:{path.port or 2101}/{path.mount}", ""


def _topic(draft: Draft, id_: str, text: str) -> tuple[str, str]:
    if not _TOPIC.fullmatch(text):
        raise ConfError("the path is no topic")
    return f"zenoh://{text.strip('/')}", "the text on that key; topics of ROS 2 come from the bridge [ros2]"


_EVERYWHERE: Final = "0.0.0.0"  # noqa: S104  what RTKLIB's servers listen on
_URLS: Final[dict[str, Callable[[Draft, str, str], tuple[str, str]]]] = {
    "serial": _serial,
    "file": _file,
    "tcpsvr": lambda draft, id_, text: _host(text, "tcp-listen", _EVERYWHERE, "reachable from everywhere, as RTKLIB's"),
    "tcpcli": lambda draft, id_, text: _host(text, "tcp", "127.0.0.1"),
    "udpcli": lambda draft, id_, text: _host(text, "udp", "127.0.0.1"),
    "ntripsvr": _feed,
    "ntripcas": _caster,
    "ntripc_c": _caster,
    "ros": _topic,
}


def _ros(draft: Draft, key: str, id_: str) -> None:
    draft.put(("ros2", draft.id_of("ros"), "solvers"), [draft.solver_id], key)
    draft.note(
        key, Fate.TRANSLATED, f"output.{id_}.target", "the text goes to a key of the topic's name, ROS 2 gets the bridge's own topics"
    )


def _write_texts(draft: Draft, id_: str, form: str) -> None:
    """Enter how an output is written, where it is not our default."""
    for key, (name, formats) in TEXTS.items():
        if form in formats and (value := _text_value(draft, key, name)) != _DEFAULTS[name]:
            draft.put(("output", id_, name), value, key)
    if form == "nmea":
        draft.put(("output", id_, "nmea_rule"), "rtklib", f"outstr{id_[-1]}-format")
    if draft.conf.dialect == "2.4" and draft.conf.version != "2.4.3":
        draft.put(("output", id_, "dialect"), "2.4")


def _text_value(draft: Draft, key: str, name: str) -> Any:
    if name == "separator":
        return draft.conf.text(key) or " "
    if name in ("max_sigma_m", "nmea_interval_s", "nmea_satellites_interval_s", "time_decimals"):
        value = draft.conf.number(key)
        return min(max(int(value), 0), _MOST_DECIMALS) if name == "time_decimals" else max(value, -1.0 if "nmea" in name else 0.0)
    word = draft.conf.choice(key)
    return word == "on" if name in _SWITCHES else word


def _say_texts(draft: Draft, formats: set[str]) -> None:
    for key, (name, of) in TEXTS.items():
        if formats & set(of):
            draft.note(key, Fate.TAKEN, f"output.*.{name}")
        else:
            draft.note(key, Fate.IGNORED, f"output.*.{name}", "no output of such a format" if formats else "there is no output")
    for key, usual in (("out-geoid", "internal"), ("out-solstatic", "all")):
        if (value := draft.conf.choice(key)) != usual:
            draft.note(key, Fate.IGNORED, "", f"{value} is not there", alters=key == "out-geoid")


def _status(draft: Draft) -> None:
    level = draft.conf.choice("out-outstat")
    if level == "off":
        draft.note("out-outstat", Fate.TAKEN, "", "off")
        draft.note("file-solstatfile", Fate.IGNORED, "", "out-outstat=off")
        return
    id_, file = draft.id_of("state_log"), draft.conf.text("file-solstatfile") or _STATUS_FILE
    draft.put(("output", id_, "target"), f"file://{file}", "file-solstatfile", "out-outstat")
    draft.put(("output", id_, "solver"), draft.solver_id)
    draft.put(("output", id_, "format"), "stat", "out-outstat")
    draft.put(("output", id_, "status_level"), level, "out-outstat")
    draft.note("out-outstat", Fate.TRANSLATED, f"output.{id_}", "an output of format stat")
    draft.note("file-solstatfile", Fate.TRANSLATED, f"output.{id_}.target", f"file://{file}")


def _log(draft: Draft, number: str, ingest: str) -> None:
    kind, keys = draft.conf.choice(f"logstr{number}-type"), (f"logstr{number}-type", f"logstr{number}-path")
    id_ = draft.id_of(f"log{number}")
    if kind == "off" or not ingest:
        why = "the log is off" if kind == "off" else "there is no input to log"
        for name in keys:
            draft.note(name, Fate.TAKEN if name == keys[0] and kind == "off" else Fate.IGNORED, "", why)
    elif kind == "file":
        _recorder(draft, keys, id_, ingest)
    else:
        draft.put(("output", id_, "target"), _target(draft, keys[1], id_, kind), *keys)
        draft.put(("output", id_, "receiver"), ingest)
        draft.put(("output", id_, "protocol"), "all")
        draft.note(keys[0], Fate.TRANSLATED, f"output.{id_}", "whole frames of all protocols; bytes between them are left out")


def _recorder(draft: Draft, keys: tuple[str, str], id_: str, ingest: str) -> None:
    file = file_path(draft.conf.text(keys[1]))
    folder = file.path.rpartition("/")[0] or "."
    draft.put(("recorder", id_, "folder"), folder, keys[1])
    draft.put(("recorder", id_, "receivers"), [ingest])
    if file.swap_hours:
        draft.put(("recorder", id_, "swap_hours"), float(file.swap_hours), keys[1])
    if file.tags:
        draft.put(("recorder", id_, "tags"), True, keys[1])
    draft.note(keys[0], Fate.TRANSLATED, f"recorder.{id_}")
    draft.note(keys[1], Fate.TRANSLATED, f"recorder.{id_}.folder", "the recorder names its files itself; logs are never overwritten")
