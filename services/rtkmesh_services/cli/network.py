"""What the commands that ask a running network have in common: where it is, and what their exit codes say."""

import os
from typing import Annotated, Final

from cyclopts import Parameter

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_services.runtime.bus import Bus

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7547"
CONNECT_VARIABLE: Final = "RTKMESH_CONNECT"
NAMESPACE_VARIABLE: Final = "RTKMESH_NAMESPACE"
REACH_S: Final = 0.3

EXIT_OK: Final = 0
EXIT_FAILED: Final = 1
EXIT_USAGE: Final = 2
EXIT_UNREACHABLE: Final = 3
EXIT_REFUSED: Final = 4
EXIT_TIMEOUT: Final = 124

_EXIT_OF: Final = {
    Code.ABSENT: EXIT_UNREACHABLE,
    Code.UNREACHABLE: EXIT_UNREACHABLE,
    Code.REFUSED: EXIT_REFUSED,
    Code.NOT_ALLOWED: EXIT_REFUSED,
    Code.STALE: EXIT_REFUSED,
    Code.CONFLICT: EXIT_REFUSED,
    Code.HUNG: EXIT_TIMEOUT,
    Code.UNKNOWN_OP: EXIT_USAGE,
    Code.BAD_ARGUMENTS: EXIT_USAGE,
    Code.BAD_REQUEST: EXIT_USAGE,
    Code.TOO_LARGE: EXIT_USAGE,
}

Connect = Annotated[
    str, Parameter(name="--connect", env_var=CONNECT_VARIABLE, help="Where the hub listens, as a Zenoh endpoint.", show_env_var=True)
]
Namespace = Annotated[str, Parameter(name="--namespace", env_var=NAMESPACE_VARIABLE, help="Prefix of the site's keys.", show_env_var=True)]
Json = Annotated[bool, Parameter(name="--json", negative="", help="Write JSON, for programs.")]


def reach(connect: str, namespace: str) -> Bus:
    """Return a bus to the running network; UnreachableError (exit code 3) when no hub answers."""
    from rtkmesh_services.runtime.zenoh_bus import open_bus

    return open_bus(f"cli_{os.getpid()}", connect.split(","), namespace=namespace, timeout_s=REACH_S)


def exit_code(replies: list[Reply]) -> int:
    """Return the exit code for a command's replies: that of the first failure."""
    for reply in replies:
        if not reply.ok:
            return _EXIT_OF.get(reply.code, EXIT_FAILED)
    return EXIT_OK if replies else EXIT_UNREACHABLE
