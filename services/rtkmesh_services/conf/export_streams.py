"""Our URLs as RTKLIB's stream types and paths."""

from typing import Final
from urllib.parse import parse_qsl

from rtkmesh_services.conf.choices import Dialect

Stream = tuple[str, str, str]  # type, path, what cannot be said
_FORMATS: Final = {"ubx": "ubx", "rtcm3": "rtcm3", "sbf": "sbf", "novatel": "oem4", "unicore": "unicore"}
_ENDINGS: Final = {"ubx": "ubx", "rtcm3": "rtcm3", "rtcm": "rtcm3", "sbf": "sbf", "obs": "rinex", "rnx": "rinex"}
_EVERYWHERE: Final = ("0.0.0.0", "")  # noqa: S104  what RTKLIB's servers listen on
_DEV: Final = "/dev/"


def split_url(url: str) -> tuple[str, str, dict[str, str]]:
    """Return scheme, what stands behind it, and the options of a URL."""
    scheme, _, rest = url.partition("://")
    where, _, query = rest.rpartition("?") if "?" in rest.rpartition("@")[2] else (rest, "", "")
    return scheme, where, dict(parse_qsl(query, keep_blank_values=True))


def input_stream(url: str) -> Stream:
    """Return the input stream of a source."""
    scheme, where, options = split_url(url)
    if scheme == "tcp":
        return "tcpcli", where, ""
    if scheme in ("tcp-listen", "serial"):
        return _either(scheme, where, options)
    if scheme in ("ntrip", "ntrips"):
        lost = "RTKLIB has no TLS" if scheme == "ntrips" else ""
        return "ntripcli", _port(where, 2101 if scheme == "ntrip" else 443), lost
    if scheme == "file":
        return "file", where + _marks(options), ""
    if scheme == "stdin":
        return "file", "", ""
    return "off", "", f"rtkrcv has no input such as {scheme}://"


def output_stream(url: str, dialect: Dialect) -> Stream:
    """Return the output stream of a target."""
    scheme, where, options = split_url(url)
    if scheme in ("tcp-listen", "serial"):
        return _either(scheme, where, options)
    if scheme == "tcp":
        return "tcpcli", where, ""
    if scheme == "udp":
        return ("udpcli", where, "") if dialect == "demo5" else ("off", "", "2.4 has no output udp://")
    if scheme in ("ntrip", "ntrips"):
        return "ntripsvr", where, "RTKLIB has no TLS" if scheme == "ntrips" else "RTKLIB sends no user"
    if scheme == "ntrip-caster":
        return "ntripcas" if dialect == "demo5" else "ntripc_c", where, "users and mounts of the table [output] are not said"
    if scheme == "file":
        swap = f"::S={options['swap']}" if "swap" in options else ""
        return "file", where + ("::T" if options.get("tags") == "yes" else "") + swap, ""
    if scheme == "stdout":
        return "file", "", ""
    if scheme == "zenoh" and dialect == "2.4":
        return "ros", where.replace("/", "_"), "of rtkrcv_ros alone"
    return "off", "", f"rtkrcv has no output such as {scheme}://"


def format_of(observations: str, url: str, usual: str) -> tuple[str, str]:
    """Return RTKLIB's format of an input, and a comment where it is a guess."""
    if observations in _FORMATS:
        return _FORMATS[observations], ""
    ending = _ENDINGS.get(url.partition("?")[0].removesuffix(".gz").rpartition(".")[2].lower())
    return (ending, "by its name") if ending else (usual, "found from the bytes by rtkmesh: say what it is")


def _either(scheme: str, where: str, options: dict[str, str]) -> Stream:
    """What is the same for inputs and outputs."""
    if scheme == "tcp-listen":
        host, _, port = where.rpartition(":")
        return "tcpsvr", f"{'' if host in _EVERYWHERE else host}:{port}", ""
    if where.startswith("by-id/"):
        where = f"{_DEV}serial/{where}"
    if not where.startswith(_DEV):
        return "off", "", f"RTKLIB finds no port by {where}"
    baud = options.get("baud", "115200")
    lost = "baud=auto: say the rate" if not baud.isdecimal() else ""
    return "serial", f"{where.removeprefix(_DEV)}:{baud if baud.isdecimal() else 115200}:8:n:1:off", lost


def _marks(options: dict[str, str]) -> str:
    if options.get("times") != "yes":
        return ""
    start, speed = options.get("start", ""), options.get("speed", "")
    return "::T" + (f"::+{start}" if start else "") + (f"::x{speed}" if speed and speed != "max" else "")


def _port(where: str, usual: int) -> str:
    """Return an address with its port, which RTKLIB wants before the mount point."""
    user, at, address = where.rpartition("@")
    host, slash, mount = address.partition("/")
    return f"{user}{at}{host if ':' in host else f'{host}:{usual}'}{slash}{mount}"
