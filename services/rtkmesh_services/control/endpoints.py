"""Zenoh endpoints on this host: who listens there, and what is free."""

import contextlib
import secrets
import socket
from typing import Final

_PORTS: Final = range(20_000, 32_000)  # below those that Linux, Windows and macOS give to outgoing connections


def accepts(endpoint: str) -> bool:
    """Whether somebody takes connections at a Zenoh endpoint ``tcp/HOST:PORT``; other protocols count as yes."""
    address = tcp_address(endpoint)
    if address is None:
        return True
    with contextlib.suppress(OSError), socket.create_connection(address, timeout=0.2):
        return True
    return False


def is_free(endpoint: str) -> bool:
    """Whether this host can listen at ``tcp/HOST:PORT``; other protocols count as yes."""
    address = tcp_address(endpoint)
    if address is None:
        return True
    family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port in TIME_WAIT is free for a new hub
        try:
            probe.bind(address)
        except OSError:
            return False
    return True


def tcp_address(endpoint: str) -> tuple[str, int] | None:
    """Return (host, port) of ``tcp/HOST:PORT``, or None for any other form."""
    scheme, _, rest = endpoint.partition("/")
    host, _, port = rest.partition("#")[0].partition("?")[0].rpartition(":")
    if scheme != "tcp" or not port.isdigit():
        return None
    return host.strip("[]"), int(port)


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a loopback port (TCP, or UDP by ``kind``) that is free now, and that no connection is given before its user listens."""
    while True:
        port = secrets.choice(_PORTS)
        with contextlib.suppress(OSError), socket.socket(type=kind) as probe:
            probe.bind(("127.0.0.1", port))
            return port
