"""Source URLs: ``scheme://where?option=value``, checked against the options that each scheme knows."""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from math import nan
from typing import Any, Final
from urllib.parse import parse_qsl, unquote, urlsplit

from rtkmesh_schemas.keys import ID, RESERVED_IDS
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.address import NTRIP_SCHEMES, CasterAddress, parse_caster, shown_url
from rtkmesh_services.ntrip.place import Place
from rtkmesh_services.runtime.port_names import is_port_name

_NTRIP: Final = {
    "version": "auto (2, and 1 where that fails), 1 or 2",
    "gga": "whether the caster is told where the rover is: auto (where the source table says so), on, off",
    "gga_period": "seconds between two positions to the caster, default 10",
    "position": "LAT,LON or LAT,LON,HEIGHT: tell this position instead of the rover's",
    "nearest": "choose the mount point that is nearest to the position",
    "max_distance": "km, the nearest mount point may be so far away, default 100",
    "timeout": "seconds without data after which the connection is made anew, default 30",
}
_ANTENNA: Final = {"antenna": "1, or 2: the observations of a receiver's second antenna (Unicore OBSVH)"}
# scheme -> options with their meaning (shown in the reference)
SCHEMES: Final[dict[str, dict[str, str]]] = {
    "serial": {"baud": "bits per second, default 115200; auto: found by listening", **_ANTENNA},
    "tcp": {"timeout": "seconds without data after which the connection is made anew, default 10", **_ANTENNA},
    "tcp-listen": {"timeout": "as tcp", **_ANTENNA},
    "udp": _ANTENNA,
    "ingest": _ANTENNA,
    "ntrip": _NTRIP,
    "ntrips": {
        **_NTRIP,
        "ca": "a file with certificates to trust instead of the system's",
        "verify": "yes, or no: trust anybody who answers",
    },
    "file": {
        "speed": "1 real time, 10 ten times as fast, max as fast as the consumers go (default 1)",
        "times": "yes: play the bytes as they came, by PATH.tag of RTKLIB or PATH.times of our recorder; no: by the epochs in them",
        "start": "seconds from the beginning that are played at once, default 0",
        **_ANTENNA,
    },
    "stdin": _ANTENNA,
    "sim": {"rate": "epochs per second, default 5", "seed": "default 1"},
}
_PATHS: Final = ("file", "serial", "sim", "ingest")
_NUMBERS: Final = ("baud", "timeout", "rate", "seed", "gga_period", "max_distance", "start")
_WORDS: Final[dict[str, tuple[str, ...]]] = {
    "version": ("auto", "1", "2"),
    "gga": ("auto", "on", "off"),
    "verify": ("yes", "no"),
    "nearest": ("", "yes", "no"),
    "times": ("no", "yes"),
    "antenna": ("1", "2"),
}


@dataclass(frozen=True, slots=True)
class SourceUrl:
    """A source: ``path`` for serial, file, sim (``scenario/stream``), ingest (its id), host and port for others, ``caster`` for NTRIP."""

    scheme: str
    host: str
    port: int
    path: str
    options: dict[str, str]
    caster: CasterAddress | None = None

    def __str__(self) -> str:
        if self.caster is not None:
            return str(self.caster)
        if self.scheme in ("serial", "stdin"):
            return self.path or "standard input"
        return f"{self.scheme}://{self.path}" if self.path else f"{self.scheme}://{self.host}:{self.port}"

    @property
    def antenna(self) -> int:
        """Which antenna's observations are wanted."""
        return int(self.word("antenna"))

    def number(self, name: str, default: float) -> float:
        """Return an option as a number; SourceError if it is none."""
        text = self.options.get(name, "")
        try:
            value = float(text) if text else default
        except ValueError:
            value = nan
        if not 0.0 <= value <= 1e9:
            raise SourceError(f"{name}={text!r} is no number from 0 on{', nor auto' if name == 'baud' else ''}")
        return value

    def word(self, name: str) -> str:
        """Return an option that is one of a few words; the first of them by default. SourceError for another word."""
        allowed = _WORDS[name]
        word = self.options.get(name, allowed[0])
        if word not in allowed:
            raise SourceError(f"{name}={word!r}: allowed are {', '.join(filter(None, allowed))}{_hint(word, allowed)}")
        return word

    @property
    def speed(self) -> float:
        """Replay speed: 1 real time, 0 as fast as the consumers go."""
        if self.options.get("speed") == "max":
            return 0.0
        speed = self.number("speed", 1.0)
        if not 0.0 < speed <= 1e6:
            raise SourceError(f"speed={self.options['speed']} must be above 0, or 'max'")
        return speed

    @property
    def place(self) -> Place | None:
        """The configured position; SourceError if it is none."""
        text = self.options.get("position", "")
        if not text:
            return None
        try:
            lat_deg, lon_deg, *height = (float(part) for part in text.split(","))
        except ValueError:
            lat_deg, lon_deg, height = nan, nan, [0.0]
        if not (-90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 360.0 and len(height) < 2 and abs(sum(height)) < 1e5):
            raise SourceError(f"position={text!r} is no LAT,LON or LAT,LON,HEIGHT in degrees and metres")
        return Place(lat_deg, lon_deg, *height)


def parse_source(text: str) -> SourceUrl:
    """Return the parts of a source URL; SourceError names what is wrong and the nearest right name."""
    scheme, found, rest = text.partition("://")
    if not found or scheme not in SCHEMES:
        raise SourceError(
            f"{shown_url(text)!r}: unknown source {scheme!r}{_hint(scheme, SCHEMES)}; sources are {', '.join(s + '://' for s in SCHEMES)}"
        )
    where, query = _located(text, scheme, rest)
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        if name not in SCHEMES[scheme]:
            raise SourceError(f"{shown_url(text)!r}: unknown option {name!r}{_hint(name, SCHEMES[scheme])}")
    url = SourceUrl(scheme, options=options, **where)
    for name in _NUMBERS:
        if (name, options.get(name)) != ("baud", "auto"):
            url.number(name, 1.0)
    for name in _WORDS:
        url.word(name)
    _check_mount(url)
    return url


def _located(text: str, scheme: str, rest: str) -> tuple[dict[str, Any], str]:
    """Return where a source is, and its query."""
    where: dict[str, Any] = {"host": "", "port": 0, "path": ""}
    if scheme in NTRIP_SCHEMES:
        caster, query = parse_caster(text)
        return {**where, "host": caster.host, "port": caster.port, "caster": caster}, query
    if scheme in _PATHS:
        path, _, query = rest.partition("?")
        if scheme == "file":
            path, query = _rtklib_form(path, query)
        if not path:
            raise SourceError(f"{text!r}: needs a path")
        if scheme == "serial" and not is_port_name(path):
            raise SourceError(f"{text!r}: names no port: /dev/NAME, by-id/NAME, VID:PID or VID:PID:SERIAL")
        if scheme == "ingest" and (not ID.fullmatch(path) or path in RESERVED_IDS):
            raise SourceError(f"{text!r}: {path!r} is no id of an ingest")
        return {**where, "path": path if scheme == "file" else unquote(path)}, query
    if scheme == "stdin":
        return where, rest.partition("?")[2]
    parts = urlsplit(text)
    try:
        port = parts.port or 0
    except ValueError:
        port = 0
    if not port:
        raise SourceError(f"{shown_url(text)!r}: needs host:port with a port from 1 to 65535")
    return {**where, "host": parts.hostname or "", "port": port}, parts.query


def _rtklib_form(path: str, query: str) -> tuple[str, str]:
    """Return path and query of a file as RTKLIB writes it: ``PATH::T::+30::x10``."""
    path, *marks = path.split("::")
    options = [query] if query else []
    for mark in marks:
        name, value = {"T": ("times", "yes"), "+": ("start", mark[1:]), "x": ("speed", mark[1:])}.get(mark[:1], ("", ""))
        if not name or (mark[:1] == "T" and mark != "T"):
            raise SourceError(f"{path!r}: ::{mark} means nothing here; ::T, ::+SECONDS and ::xSPEED do")
        options.append(f"{name}={value}")
    return path, "&".join(options)


def _check_mount(url: SourceUrl) -> None:
    """SourceError where a caster's source says neither which mount point nor that the nearest is wanted."""
    _ = url.place
    if url.caster is not None and not url.caster.mount and not wants_nearest(url):
        raise SourceError(f"'{url}': says no mount point; `rtkmesh ntrip list {url.host}` shows them, ?nearest chooses one")


def wants_nearest(url: SourceUrl) -> bool:
    """Return whether a caster's mount point is to be chosen by distance."""
    by_option = "nearest" in url.options and url.word("nearest") != "no"
    return by_option or (url.caster is not None and url.caster.mount == "nearest")


def _hint(word: str, known: Mapping[str, object] | tuple[str, ...]) -> str:
    close = get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
