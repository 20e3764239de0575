"""Addresses to listen on, ``HOST:PORT``."""

from typing import Final

LOOPBACK: Final = ("127.", "localhost", "::1")


def address_of(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT`` or ``[HOST]:PORT``; ValueError says what is wrong."""
    host, found, port = text.rpartition(":")
    bare = host.removeprefix("[").removesuffix("]")
    if not found or not bare or (":" in bare and bare == host):
        raise ValueError("is no HOST:PORT")
    if not port.isdecimal() or not 0 < int(port[:6]) < 65536:
        raise ValueError("the port is none from 1 to 65535")
    return bare, int(port)


def is_loopback(host: str) -> bool:
    """Return whether only this host reaches an address."""
    return host.startswith(LOOPBACK[0]) or host in LOOPBACK[1:]
