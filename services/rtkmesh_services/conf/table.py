"""The table of all keys of both dialects, in RTKLIB's order, and how a file's name finds its row."""

from typing import Final

from rtkmesh_services.conf import rows_positioning, rows_streams, rows_texts
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.rows import Row

_STATS: Final = tuple(row for row in rows_positioning.ROWS if row.name.startswith("stats-"))
_POSITIONING: Final = tuple(row for row in rows_positioning.ROWS if not row.name.startswith("stats-"))
_OUT: Final = tuple(row for row in rows_texts.ROWS if row.name.startswith("out-"))
_REST: Final = tuple(row for row in rows_texts.ROWS if not row.name.startswith("out-"))
RECEIVER_ROWS: Final[tuple[Row, ...]] = rows_streams.ROWS
SYSTEM_ROWS: Final[tuple[Row, ...]] = (*_POSITIONING, *_OUT, *_STATS, *_REST)
ALL_ROWS: Final[dict[str, Row]] = {row.name: row for row in (*RECEIVER_ROWS, *SYSTEM_ROWS)}


def row_like(name: str, dialect: Dialect) -> Row | None:
    """Return the row that RTKLIB takes a name for: the first one, system keys before receiver keys, that has it somewhere in its name."""
    known = [row for row in (*SYSTEM_ROWS, *RECEIVER_ROWS) if row.known_to(dialect)]
    return next((row for row in known if name and name in row.name), None)
