"""The inputs of a .conf file -> the tables [ingest.ID]."""

from typing import Final

from rtkmesh.errors import OptionError
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh_services.conf.paths import file_path, network_path, serial_path
from rtkmesh_services.conf.report import Draft
from rtkmesh_services.conf.rows import Fate
from rtkmesh_services.conf.table import ALL_ROWS
from rtkmesh_services.errors import ConfError

INPUTS: Final = {"1": "rover", "2": "base", "3": "corrections"}
_FORMATS: Final = {"ubx": "ubx", "rtcm3": "rtcm3", "sbf": "sbf", "unicore": "unicore", "oem4": "novatel", "rinex": "auto"}
_PRODUCTS: Final = ("ftp", "http")
_COMMANDED: Final = ("serial", "tcpcli", "tcpsvr")
_RTKLIB_TIMEOUT_MS: Final = 10000.0
_EVERYWHERE: Final = "0.0.0.0"  # noqa: S104  what RTKLIB's servers listen on


def import_inputs(draft: Draft) -> list[str]:
    """Enter the ingests and say what became of their keys; return the ids of those that are there."""
    found = [draft.id_of(name) for number, name in INPUTS.items() if _input(draft, number, draft.id_of(name))]
    _server_keys(draft)
    return found


def _input(draft: Draft, number: str, id_: str) -> bool:
    kind, target = draft.conf.choice(f"inpstr{number}-type"), f"ingest.{id_}.source"
    if kind == "off" or kind in _PRODUCTS:
        _unused(draft, number, kind)
        return False
    draft.note(f"inpstr{number}-type", Fate.TAKEN, target)
    source = _source(draft, number, id_, kind)
    draft.put(("ingest", id_, "source"), source, f"inpstr{number}-path", f"inpstr{number}-type")
    _format(draft, number, id_, kind)
    _options(draft, number, id_)
    _commands(draft, number, id_, kind)
    if number == "3":
        draft.put(("ingest", id_, "navigation"), True, "inpstr3-type")
        draft.put(("solver", draft.solver_id, "navigation"), [id_], "inpstr3-type")
    return True


def _unused(draft: Draft, number: str, kind: str) -> None:
    reason = "the input is off" if kind == "off" else "ftp and http bring products (precise orbits, clocks) that are not read"
    names = (f"inpstr{number}-type", f"inpstr{number}-path", f"inpstr{number}-format", f"inpstr{number}-rcvopt", f"file-cmdfile{number}")
    for name in names:
        if draft.conf.dialect == "demo5" or not name.endswith("rcvopt"):
            draft.note(name, Fate.TAKEN if name.endswith("type") and kind == "off" else Fate.IGNORED, "", reason, alters=kind != "off")


def _source(draft: Draft, number: str, id_: str, kind: str) -> str:
    """Return the URL of an input; a reference to the environment where the path is none."""
    name, text = f"inpstr{number}-path", draft.conf.text(f"inpstr{number}-path")
    try:
        if not text:
            raise ConfError("the file says no path")
        url, note = _URLS[kind](draft, number, id_, text)
    except ConfError as error:
        url = draft.placeholder(f"{id_}_source", f"{_EXAMPLES[kind]} ({name}: {error})")
        note = f"{error}: say it in the environment, {url}"
        draft.note(name, Fate.TRANSLATED, f"ingest.{id_}.source", note, alters=True)
        return url
    draft.note(name, Fate.TRANSLATED, f"ingest.{id_}.source", note)
    return url


_EXAMPLES: Final = {
    "serial": "serial:///dev/ttyACM0?baud=115200",
    "file": "file://rover.ubx?speed=1",
    "tcpcli": "tcp://HOST:PORT",
    "tcpsvr": "tcp-listen://0.0.0.0:PORT",
    "ntripcli": "ntrip://USER:PASSWORD@HOST:2101/MOUNT",
}


def _serial(draft: Draft, number: str, id_: str, text: str) -> tuple[str, str]:
    port = serial_path(text)
    note = f"{port.strange} is not taken: ports are 8N1 without flow control" if port.strange else ""
    return f"serial:///dev/{port.device}?baud={port.baud}", note


def _file(draft: Draft, number: str, id_: str, text: str) -> tuple[str, str]:
    file = file_path(text)
    if not file.path:
        raise ConfError("the path is empty: RTKLIB's standard input, stdin://")
    options = ["times=yes"] if file.tags else []
    options += [f"start={file.start_s}"] if file.start_s else []
    options += [f"speed={file.speed or 1}"] if file.tags or file.speed else ["speed=max"]
    note = "as fast as it is read" if "speed=max" in options else ""
    if file.unknown:
        note = f"{' '.join(file.unknown)} is not needed"
    return f"file://{file.path}?{'&'.join(options)}", note


def _tcp(draft: Draft, number: str, id_: str, text: str) -> tuple[str, str]:
    path = network_path(text)
    if not path.port:
        raise ConfError("the path has no port")
    host, note = (path.host, "") if path.host else ("127.0.0.1", "no host: this one")
    return f"tcp://{host}:{path.port}{_timeout(draft)}", note


def _tcp_server(draft: Draft, number: str, id_: str, text: str) -> tuple[str, str]:
    path = network_path(text)
    if not path.port:
        raise ConfError("the path has no port")
    return f"tcp-listen://{path.host or _EVERYWHERE}:{path.port}{_timeout(draft)}", "reachable from everywhere, as RTKLIB's"


def _ntrip(draft: Draft, number: str, id_: str, text: str) -> tuple[str, str]:
    path = network_path(text)
    if not path.host or not path.mount:
        raise ConfError(f"the path has no {'mount point' if path.host else 'host'}")
    user = credentials(draft, f"{id_}_password", path.user, path.password)
    options = [*_gga(draft), _timeout(draft).removeprefix("?")] if number == "2" else ["gga=off", _timeout(draft).removeprefix("?")]
    query = "&".join(filter(None, options))
    note = "the password goes into the environment" if path.password else ""
    return f"ntrip://{user}{path.host}:{path.port or 2101}/{path.mount}?{query}", note


_URLS: Final = {"serial": _serial, "file": _file, "tcpcli": _tcp, "tcpsvr": _tcp_server, "ntripcli": _ntrip}


def credentials(draft: Draft, variable: str, user: str, password: str) -> str:
    """Return ``user:${VARIABLE}@``, or nothing."""
    if not user and not password:
        return ""
    return f"{user}:{draft.secret(variable, password)}@" if password else f"{user}@"


def _timeout(draft: Draft) -> str:
    timeout_ms = draft.conf.number("misc-timeout")
    return f"?timeout={max(timeout_ms, 1000.0) / 1000.0:g}" if timeout_ms not in (0.0, _RTKLIB_TIMEOUT_MS) else ""


def _gga(draft: Draft) -> list[str]:
    """Return the options of a caster's URL that tell it where the rover is."""
    conf = draft.conf
    request = conf.choice("inpstr2-nmeareq")
    if request == "off":
        return ["gga=off"]
    period_s = max(conf.number("misc-nmeacycle"), 1000.0) / 1000.0
    place = [f"{conf.number(f'inpstr2-nmea{name}'):.10g}" for name in ("lat", "lon", "hgt")]
    position = [f"position={','.join(place)}"] if request == "latlon" else []
    return ["gga=on", f"gga_period={period_s:g}", *position]


def _format(draft: Draft, number: str, id_: str, kind: str) -> None:
    name, value = f"inpstr{number}-format", draft.conf.choice(f"inpstr{number}-format")
    ours = _FORMATS.get(value)
    if ours is None:
        draft.note(
            name, Fate.IGNORED, f"ingest.{id_}.observations", f"there is no decoder of {value}: nothing of it would be read", alters=True
        )
    elif ours == "auto" and kind != "file":
        draft.note(name, Fate.IGNORED, f"ingest.{id_}.observations", "RINEX is read from files, not from streams", alters=True)
    else:
        draft.put(("ingest", id_, "observations"), ours, name)
        draft.note(name, Fate.TAKEN, f"ingest.{id_}.observations", "" if ours == value else f"{value} is {ours} here")


def _options(draft: Draft, number: str, id_: str) -> None:
    name = f"inpstr{number}-rcvopt"
    text = draft.conf.text(name) if name in draft.conf.lines else ""
    if not text:
        return
    try:
        notes = parse_receiver_options(text).notes
    except OptionError as error:
        draft.note(name, Fate.IGNORED, f"ingest.{id_}.options", str(error), alters=True)
        draft.conf.say(name, f"{name}: {error}", wrong=True)
        return
    draft.put(("ingest", id_, "options"), text, name)
    draft.note(name, Fate.TAKEN, f"ingest.{id_}.options", "; ".join(notes))


def _commands(draft: Draft, number: str, id_: str, kind: str) -> None:
    name, file = f"file-cmdfile{number}", draft.conf.text(f"file-cmdfile{number}")
    if not file:
        return
    if kind not in _COMMANDED:
        draft.note(name, Fate.IGNORED, "", f"nobody hears commands behind {kind}", alters=True)
        return
    draft.put(("ingest", id_, "commands", "file"), file, name)
    draft.note(name, Fate.TAKEN, f"ingest.{id_}.commands.file", "relative to the folder of the deployment file")


def _server_keys(draft: Draft) -> None:
    """Say what became of the keys that several streams share."""
    conf = draft.conf
    caster = conf.choice("inpstr2-type") == "ntripcli"
    wish = conf.choice("inpstr2-nmeareq")
    source, lost = f"ingest.{draft.id_of('base')}.source", wish != "off" and not caster
    why = "casters alone are told where the rover is" if lost else "?gga of the URL" if caster else "off"
    draft.note("inpstr2-nmeareq", Fate.IGNORED if lost else Fate.TAKEN, source, why, alters=lost)
    for name in ("inpstr2-nmealat", "inpstr2-nmealon", "inpstr2-nmeahgt"):
        used = caster and wish == "latlon"
        draft.note(name, Fate.TAKEN if used else Fate.IGNORED, source, "?position of the URL" if used else "not asked for by nmeareq")
    told = caster and wish != "off"
    draft.note(
        "misc-nmeacycle", Fate.TRANSLATED if told else Fate.IGNORED, source, "?gga_period of the URL" if told else "no position is sent"
    )
    timeout_ms = conf.number("misc-timeout")
    if timeout_ms == 0.0:
        draft.note("misc-timeout", Fate.IGNORED, "", "a silent connection is always given up, after 10 s (casters: 30 s)", alters=True)
    else:
        same = timeout_ms == _RTKLIB_TIMEOUT_MS
        draft.note(
            "misc-timeout", Fate.TAKEN if same else Fate.TRANSLATED, "ingest.*.source", "10 s (casters: 30 s)" if same else "?timeout, in s"
        )
    for name in ("misc-proxyaddr", "misc-startcmd", "misc-stopcmd"):
        if conf.text(name):
            draft.note(name, Fate.IGNORED, "", ALL_ROWS[name].why, alters=True)
