"""Zenoh endpoints on this host: who listens there, and what is free."""

import contextlib
import socket


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


def free_port() -> int:
    """Return a loopback TCP port that is free now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port
