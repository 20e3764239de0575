"""``rtkmesh cmd``: ask a process, or all, to do something."""

import json
import sys
from collections.abc import Callable, Iterator
from typing import Annotated, Any

from cyclopts import Parameter

from rtkmesh_schemas.command import Code, Reply
from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, EXIT_USAGE, Connect, Json, Namespace, exit_code, reach
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.runtime.console_words import SCREENS, WordError, arguments
from rtkmesh_services.runtime.logs import clean

_EXAMPLES = """
rtkmesh cmd rtk stop
rtkmesh cmd rtk load night.toml
rtkmesh cmd rtk help
rtkmesh cmd '*' status --json
rtkmesh cmd control restart rover
"""


def cmd(
    id: Annotated[str, Parameter(help="The process's id, or '*' for all.")],  # noqa: A002  the word of the design
    op: Annotated[str, Parameter(help="What to do: status, help, config, metrics, log, shutdown, and what its role can.")],
    /,
    *args: Annotated[str, Parameter(help="Arguments: name=value, or a bare word where one is usual (load FILE).")],
    timeout: Annotated[float, Parameter(help="Seconds until the answer counts as missing.")] = 2.0,
    expires: Annotated[float, Parameter(help="Not to be done later than in so many seconds; 0: whenever it comes.")] = 0.0,
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Ask a process to do something and print its answer.

    An empty answer is turned into its cause: absent, hung, or refused. The same can be asked by any Zenoh program with a get
    on rtk/ID/cmd (JSON, msgpack, or ?op=status).

    Exit codes: 0 done, 1 failed, 2 wrong usage, 3 not reachable, 4 refused, 124 no answer in time.
    """
    from rtkmesh_services.runtime.calls import call

    try:
        values = arguments(op, args)
    except WordError as error:
        sys.stderr.write(f"rtkmesh cmd: {error}\n")
        return EXIT_USAGE
    with reach(connect, namespace) as bus:
        replies = call(bus, id, op, values, timeout, expires_s=expires)
    if as_json:
        _print_json(id, replies)
    else:
        for reply in replies:
            show_reply(reply, sys.stdout.write if reply.ok else sys.stderr.write, as_screen=op in SCREENS)
    return exit_code(replies)


def _print_json(id: str, replies: list[Reply]) -> None:  # noqa: A002
    from rtkmesh_schemas.wire import encode_json

    sys.stdout.write(encode_json(replies if id == "*" or len(replies) != 1 else replies[0]).decode() + "\n")


def show_reply(reply: Reply, write: Callable[[str], Any], *, as_screen: bool = False) -> None:
    """Write a reply for people: who, the message, the state, and the data below it (``as_screen``: RTKRCV's text if there is one)."""
    head = f"{reply.id}: " if reply.id else ""
    verdict = "" if reply.code is Code.OK else f"{reply.code.value}: "
    state = f" [{reply.state}]" if reply.state else ""
    lines = [f"{head}{verdict}{reply.message}{state}"]
    if as_screen and reply.text:
        lines += [clean(line) for line in reply.text.removesuffix("\n").split("\n")]
    else:
        lines += [line for name, value in reply.data.items() for line in _lines(name, value, 1)]
    write("".join(f"{line}\n" for line in lines))


def _lines(name: str, value: Any, depth: int) -> Iterator[str]:
    indent = "  " * depth
    if isinstance(value, dict) and value:
        yield f"{indent}{name}:"
        for inner, item in value.items():  # pyright: ignore[reportUnknownVariableType]  any plain data
            yield from _lines(str(inner), item, depth + 1)  # pyright: ignore[reportUnknownArgumentType]
    elif isinstance(value, list) and any(isinstance(item, (dict, str)) for item in value):  # pyright: ignore[reportUnknownVariableType]
        yield f"{indent}{name}:"
        for item in value:  # pyright: ignore[reportUnknownVariableType]
            yield f"{indent}  {item if isinstance(item, str) else json.dumps(item)}"
    elif value not in ({}, [], None, ""):
        yield f"{indent}{name}: {value if isinstance(value, (str, int, float)) else json.dumps(value)}"


app = command_page(cmd, _EXAMPLES)
