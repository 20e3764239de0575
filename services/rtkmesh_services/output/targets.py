"""Where an output goes, as a URL."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import Final
from urllib.parse import parse_qsl, urlsplit

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.errors import BadKeyError
from rtkmesh_schemas.keys import ROOT, TEXT, Stream, check_id
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ntrip.address import NTRIP_SCHEMES, PORT, CasterAddress, parse_caster, shown_url
from rtkmesh_services.ntrip.connection import TlsOptions
from rtkmesh_services.runtime.port_names import DEFAULT_BAUD, is_port_name

CASTER_SCHEME: Final = "ntrip-caster"
_PUSH: Final = {"version": "1 or 2; default 2 with a user, 1 without"}
# scheme -> options with their meaning (shown in the reference)
SCHEMES: Final[dict[str, dict[str, str]]] = {
    "file": {
        "swap": "HOURS: the next file at whole hours (RTKLIB's ::S=HOURS)",
        "margin": "seconds before and after that instant in which both files are written, default 0",
        "tags": "yes: RTKLIB's .tag beside it (::T)",
    },
    "serial": {"baud": f"bits per second, default {DEFAULT_BAUD}"},
    "tcp-listen": {},
    "tcp": {},
    "udp": {},
    "ntrip": _PUSH,
    "ntrips": {**_PUSH, "ca": "as for sources", "verify": "as for sources"},
    CASTER_SCHEME: {},
    "ingest": {},
    "stdout": {},
    "zenoh": {},
}
_WORDS: Final = {"version": ("1", "2"), "verify": ("yes", "no"), "tags": ("yes", "no")}
_NUMBERS: Final = {"swap": (1e6, "hours"), "margin": (3600.0, "seconds up to 3600"), "baud": (1e7, "bits per second")}
_NOT_IN_KEYS: Final = frozenset("*?#${}@ ")


@dataclass(frozen=True, slots=True)
class TargetUrl:
    """Where a stream goes: a path (file, port, ingest, key, mount point of our own caster), or host and port, or a caster that is fed."""

    scheme: str
    path: str = ""
    host: str = ""
    port: int = 0
    caster: CasterAddress | None = None
    options: Mapping[str, str] = field(default_factory=dict[str, str])

    def __str__(self) -> str:
        if self.caster is not None:
            return str(self.caster)
        where = f"{self.host}:{self.port}{f'/{self.path}' if self.path else ''}" if self.port else self.path
        return f"{self.scheme}://{where}"

    @property
    def swap_hours(self) -> float:
        """Hours after which a file is followed by the next one; 0: never."""
        return float(self.options.get("swap", "0"))

    @property
    def margin_s(self) -> float:
        """How long before and after that both are written."""
        return float(self.options.get("margin", "0"))

    @property
    def tags(self) -> bool:
        """Whether a file has RTKLIB's ``.tag`` beside it."""
        return self.options.get("tags") == "yes"

    @property
    def baud(self) -> int:
        """Of a serial port."""
        return int(float(self.options.get("baud", DEFAULT_BAUD)))

    @property
    def version(self) -> int:
        """NTRIP's, when a caster is fed."""
        user = self.caster is not None and self.caster.user
        return int(self.options.get("version", "2" if user else "1"))

    @property
    def tls(self) -> TlsOptions:
        """Whom we trust."""
        return TlsOptions(authority=self.options.get("ca", ""), verify=self.options.get("verify") != "no")


def parse_target(url: str) -> TargetUrl:
    """Return the parts of a target's URL; SourceError says what is wrong with it."""
    scheme, found, rest = url.partition("://")
    if not found or scheme not in SCHEMES:
        near = get_close_matches(scheme, list(SCHEMES), 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise SourceError(f"{shown_url(url)!r}: unknown target{hint}; targets are {', '.join(s + '://' for s in SCHEMES)}")
    target = _located(url, scheme, rest)
    _check_options(target)
    if target.caster is not None and target.version == 1 and any(character.isspace() for character in target.caster.password):
        raise SourceError(f"'{target}': a password with spaces needs version=2")
    return target


def check_output(table: OutputTable) -> None:
    """SourceError for a target that does not fit what is to be sent, or that lets in everybody without being told to."""
    target = parse_target(table.target)
    if target.scheme == "zenoh" and not table.solver:
        raise SourceError(f"'{target}': a receiver's frames are on the network already, on its keys raw; here goes a solver's text")
    if target.scheme == CASTER_SCHEME and not (table.users or table.anonymous or _is_loopback(target.host)):
        raise SourceError(f"'{target}': everybody could read: say users, or anonymous = true to allow it")


def text_stream(url: TargetUrl) -> Stream:
    """Return the stream of texts on a key of the user's."""
    return replace(TEXT, name=f"text {url.path}", template=url.path)


def _located(url: str, scheme: str, rest: str) -> TargetUrl:
    if scheme in NTRIP_SCHEMES:
        return _push_target(url, scheme)
    if scheme == "file":
        return _file_target(url, rest)
    if scheme in ("serial", "ingest", "stdout", "zenoh"):
        path, _, query = rest.partition("?")
        target = TargetUrl(scheme, path, options=_options(query))
        _PATH_CHECKS[scheme](url, path)
        return target
    parts = urlsplit(url)
    try:
        port = parts.port or (PORT if scheme == CASTER_SCHEME else None)
    except ValueError:
        port = None
    path = parts.path.strip("/")
    if not port or (path and scheme != CASTER_SCHEME):
        raise SourceError(f"{shown_url(url)!r}: needs host:port{' and nothing behind it' if port else ''}")
    return TargetUrl(scheme, path, parts.hostname or "127.0.0.1", port, options=_options(parts.query))


def _check_port(url: str, path: str) -> None:
    if not is_port_name(path):
        raise SourceError(f"{url!r}: names no port: /dev/NAME, by-id/NAME, VID:PID or VID:PID:SERIAL")


def _check_ingest(url: str, path: str) -> None:
    try:
        _ = check_id(path)
    except BadKeyError as error:
        raise SourceError(f"{url!r}: {error}") from None


def _check_nothing(url: str, path: str) -> None:
    if path:
        raise SourceError(f"{url!r}: has nothing behind ://")


def _check_key(url: str, path: str) -> None:
    """The keys of the table belong to their owners; other programs' keys are free."""
    if path and (_NOT_IN_KEYS & set(path) or "" in path.split("/") or not path.isprintable()):
        raise SourceError(f"{url!r}: {path!r} is no key: words with / between them")
    if path.split("/", maxsplit=1)[0] == ROOT:
        raise SourceError(f"{url!r}: keys below {ROOT}/ have their owners; without a key it goes to {TEXT.template}")


_PATH_CHECKS: Final = {"serial": _check_port, "ingest": _check_ingest, "stdout": _check_nothing, "zenoh": _check_key}


def _check_options(target: TargetUrl) -> None:
    known = SCHEMES[target.scheme]
    for name, value in target.options.items():
        if name not in known:
            has = f"known are {', '.join(known)}" if known else f"{target.scheme}:// has none"
            raise SourceError(f"'{target}': unknown option {name!r}; {has}")
        if name in _WORDS and value not in _WORDS[name]:
            raise SourceError(f"'{target}': {name}={value!r}: allowed are {', '.join(_WORDS[name])}")
        if name in _NUMBERS and not 0.0 <= _number(value) <= _NUMBERS[name][0]:
            raise SourceError(f"'{target}': {name}={value!r} is no number of {_NUMBERS[name][1]}")


def _file_target(url: str, rest: str) -> TargetUrl:
    """Return the target of a file, with ``?swap=HOURS&tags=yes`` or RTKLIB's ``::S=HOURS::T``."""
    path, _, query = rest.partition("?")
    path, *marks = path.split("::")
    options = _options(query)
    for mark in marks:
        name, value = ("tags", "yes") if mark == "T" else ("swap", mark[2:]) if mark.startswith("S=") else ("", "")
        if not name:
            raise SourceError(f"{url!r}: ::{mark} means nothing here; ::T and ::S=HOURS do")
        options[name] = value
    if not path:
        raise SourceError(f"{url!r}: needs a path")
    return TargetUrl("file", path, options=options)


def _push_target(url: str, scheme: str) -> TargetUrl:
    address, query = parse_caster(url)
    if not address.mount:
        raise SourceError(f"'{address}': says no mount point to feed")
    return TargetUrl(scheme, host=address.host, port=address.port, caster=address, options=_options(query))


def _options(query: str) -> dict[str, str]:
    return dict(parse_qsl(query, keep_blank_values=True))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return -1.0


def _is_loopback(host: str) -> bool:
    return host in ("localhost", "::1") or host.startswith("127.")
