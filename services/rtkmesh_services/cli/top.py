"""``rtkmesh top``: the live table of a running network."""

import sys
import time
from typing import Annotated, Final

from cyclopts import Parameter

from rtkmesh_services.cli.board import Board
from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, Connect, Namespace, reach
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.cli.table import Display, View, once

_SETTLE_S: Final = 1.2  # a status comes once a second


def top(
    *,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
    seconds: Annotated[float, Parameter(help="End after this time; 0: at Ctrl-C.")] = 0.0,
) -> None:
    """Watch a running network: positions, headings and processes, four times a second. Ctrl-C ends it.

    Away from a terminal it prints the table once.
    """
    board = Board()
    with reach(connect, namespace) as bus:
        board.attach(bus)
        view = View(board, f"rtkmesh top {connect}")
        if not sys.stdout.isatty():
            take_for(board, seconds or _SETTLE_S)
            once(view)
            return
        display = Display(view)
        display.start()
        try:
            watch(board, display, seconds)
        except KeyboardInterrupt:
            pass
        finally:
            display.stop()


def watch(board: Board, display: Display, seconds: float) -> None:
    """Take messages and draw for some time, 0: for ever."""
    end_s = time.monotonic() + seconds
    while not seconds or time.monotonic() < end_s:
        board.take(0.1)
        display.refresh(time.monotonic())


def take_for(board: Board, seconds: float) -> None:
    """Take messages for some time."""
    end_s = time.monotonic() + seconds
    while (left_s := end_s - time.monotonic()) > 0.0:
        board.take(left_s)


app = command_page(
    top,
    """
    rtkmesh top
    rtkmesh top --connect tcp/192.168.1.20:7547
    """,
)
