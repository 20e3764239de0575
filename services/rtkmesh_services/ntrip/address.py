"""``ntrip://USER:PASSWORD@HOST:PORT/MOUNT?options``, and ``ntrips://`` for TLS.

User and password are taken as they are: everything before the last ``@``, the user up to its first colon. Nothing is
percent-decoded, so that a password from the environment may hold any character; a user may be a mail address.
"""

import re
from dataclasses import dataclass, field
from typing import Final

from rtkmesh_services.errors import SourceError

PORT: Final = 2101
TLS_PORT: Final = 443
NTRIP_SCHEMES: Final = ("ntrip", "ntrips")
_WHERE: Final = re.compile(
    r"(?:(?P<user>.*)@)?(?P<host>\[[0-9A-Fa-f:.]+\]|[^@\[\]/?:\s]+)(?::(?P<port>\d{1,5}))?(?:/(?P<mount>[^?@\s]*))?(?:\?(?P<query>[^@]*))?",
    re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class CasterAddress:
    """A mount point of a caster and who asks for it; the empty mount point is the source table."""

    host: str
    port: int
    mount: str = ""
    user: str = ""
    password: str = field(default="", repr=False)
    tls: bool = False

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'ntrips' if self.tls else 'ntrip'}://{host}:{self.port}/{self.mount}"

    @property
    def host_header(self) -> str:
        """The value of the header Host."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def parse_caster(text: str) -> tuple[CasterAddress, str]:
    """Return the address in an NTRIP URL and the query behind it; SourceError says what is wrong, without the password."""
    scheme, _, rest = text.partition("://")
    match = _WHERE.fullmatch(rest)
    if match is None:
        raise SourceError(f"{shown_url(text)!r}: is no {scheme}://USER:PASSWORD@HOST:PORT/MOUNT")
    port = int(match["port"] or (TLS_PORT if scheme == "ntrips" else PORT))
    if not 0 < port < 65536:
        raise SourceError(f"{shown_url(text)!r}: the port is none from 1 to 65535")
    if not (match["mount"] or "").isascii():
        raise SourceError(f"{shown_url(text)!r}: a mount point has letters, digits and signs of ASCII")
    user, _, password = (match["user"] or "").partition(":")
    address = CasterAddress(match["host"].strip("[]"), port, match["mount"] or "", user, password, tls=scheme == "ntrips")
    return address, match["query"] or ""


def shown_url(text: str) -> str:
    """Return a URL without user and password."""
    scheme, found, rest = text.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}" if found else text
