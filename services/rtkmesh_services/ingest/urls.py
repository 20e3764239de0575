"""Source URLs: ``scheme://where?option=value``, checked against the options that each scheme knows."""

from dataclasses import dataclass
from difflib import get_close_matches
from math import nan
from typing import Final
from urllib.parse import parse_qsl, unquote, urlsplit

from rtkmesh_services.errors import SourceError

# scheme -> options with their meaning (shown in the reference)
SCHEMES: Final[dict[str, dict[str, str]]] = {
    "serial": {"baud": "bits per second, default 115200"},
    "tcp": {"timeout": "seconds without data after which the connection is made anew, default 10"},
    "tcp-listen": {"timeout": "as tcp"},
    "udp": {},
    "file": {"speed": "1 real time, 10 ten times as fast, max as fast as the consumers go (default 1)"},
    "sim": {"rate": "epochs per second, default 5", "seed": "default 1"},
}
_NUMBERS: Final = ("baud", "timeout", "rate", "seed")


@dataclass(frozen=True, slots=True)
class SourceUrl:
    """A source: ``path`` for serial, file and sim (``scenario/stream``), host and port for the others."""

    scheme: str
    host: str
    port: int
    path: str
    options: dict[str, str]

    def number(self, name: str, default: float) -> float:
        """Return an option as a number; SourceError if it is none."""
        text = self.options.get(name, "")
        try:
            value = float(text) if text else default
        except ValueError:
            value = nan
        if not 0.0 <= value <= 1e9:
            raise SourceError(f"{name}={text!r} is no number from 0 on")
        return value

    @property
    def speed(self) -> float:
        """Replay speed: 1 real time, 0 as fast as the consumers go."""
        if self.options.get("speed") == "max":
            return 0.0
        speed = self.number("speed", 1.0)
        if not 0.0 < speed <= 1e6:
            raise SourceError(f"speed={self.options['speed']} must be above 0, or 'max'")
        return speed


def parse_source(text: str) -> SourceUrl:
    """Return the parts of a source URL; SourceError names what is wrong and the nearest right name."""
    scheme, found, rest = text.partition("://")
    if not found or scheme not in SCHEMES:
        raise SourceError(
            f"{text!r}: unknown source {scheme!r}{_hint(scheme, SCHEMES)}; sources are {', '.join(s + '://' for s in SCHEMES)}"
        )
    if scheme in ("file", "serial", "sim"):
        path, _, query = rest.partition("?")
        host, port = "", 0
    else:
        parts = urlsplit(text)
        path, query, host = "", parts.query, parts.hostname or ""
        try:
            port = parts.port or 0
        except ValueError:
            port = 0
        if not port:
            raise SourceError(f"{text!r}: needs host:port with a port from 1 to 65535")
    options = dict(parse_qsl(query, keep_blank_values=True))
    for name in options:
        if name not in SCHEMES[scheme]:
            raise SourceError(f"{text!r}: unknown option {name!r}{_hint(name, SCHEMES[scheme])}")
    if scheme in ("file", "serial", "sim") and not path:
        raise SourceError(f"{text!r}: needs a path")
    url = SourceUrl(scheme, host, port, unquote(path), options)
    for name in _NUMBERS:
        url.number(name, 1.0)
    return url


def _hint(word: str, known: dict[str, dict[str, str]] | dict[str, str]) -> str:
    close = get_close_matches(word, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
