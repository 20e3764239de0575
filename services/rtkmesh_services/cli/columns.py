"""Columns that fit a terminal, and the colours of states: one colour and one word per state, everywhere."""

import math
from dataclasses import dataclass
from typing import Final

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

WIDE: Final = 200
_COLOURS: Final = {
    "FIX": "bold green",
    "FLOAT": "yellow",
    "DGPS": "cyan",
    "SINGLE": "blue",
    "NONE": "red",
    "RUNNING": "green",
    "STARTING": "cyan",
    "WARMING": "cyan",
    "STOPPING": "cyan",
    "WAITING": "yellow",
    "DEGRADED": "yellow",
    "STALE": "yellow",
    "FAILED": "bold red",
    "STOPPED": "dim",
    "ok": "green",
    "failed": "bold red",
    "unavailable": "dim",
}
FREE_TEXT, _FREE_TEXT_WIDTH = "says", 24
_GAP, _EDGES = 3, -1  # what rich's SIMPLE_HEAD puts between two columns, and around all of them when each is given one gap


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table. Those of the highest ``rank`` go first when the terminal is too narrow.

    ``least`` is its usual width, so that columns do not come and go with every digit.
    """

    name: str
    rank: int = 0
    right: bool = False
    least: int = 0


def coloured(word: str) -> Text:
    """Return a state's word in its colour."""
    return Text(word, style=_COLOURS.get(word, ""))


def number(value: float, digits: int) -> str:
    """Return a number with so many digits behind the point, or a dash."""
    return f"{value:z.{digits}f}" if math.isfinite(value) else "-"


def cells(*words: str | Text) -> list[Text]:
    """Return the cells of a row."""
    return [word if isinstance(word, Text) else Text(word) for word in words]


def fitted_table(columns: list[Column], rows: list[list[Text]], width: int) -> Table:
    """Return a table of the columns that fit; free text at its end is cut to what is left."""
    width -= _EDGES
    widths = [max([column.least, cell_len(column.name), *(row[i].cell_len for row in rows)]) + _GAP for i, column in enumerate(columns)]
    if columns[-1].name == FREE_TEXT:
        widths[-1] = min(widths[-1], _FREE_TEXT_WIDTH)
    kept = list(range(len(columns)))
    for i in sorted(kept, key=lambda i: -columns[i].rank):
        if columns[i].rank and sum(widths[k] for k in kept) > width:
            kept.remove(i)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, header_style="dim")
    for i in kept:
        column = columns[i]
        free = column.name == FREE_TEXT
        room = max(widths[i], width - sum(widths[k] for k in kept if k != i)) - _GAP
        table.add_column(
            column.name,
            justify="right" if column.right else "left",
            no_wrap=True,
            min_width=None if free else widths[i] - _GAP,
            max_width=room,
        )
    for row in rows:
        table.add_row(*(row[i] for i in kept))
    return table
