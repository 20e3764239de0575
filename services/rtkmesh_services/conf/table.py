"""The table of all keys of both dialects, in RTKLIB's order, and how a file's name finds its row."""

from typing import Final

from rtkmesh_services.conf import rows_positioning, rows_streams, rows_texts
from rtkmesh_services.conf.choices import Dialect
from rtkmesh_services.conf.rows import Row


def _beginning(*prefixes: str) -> tuple[Row, ...]:
    return tuple(row for row in (*rows_positioning.ROWS, *rows_texts.ROWS) if row.name.startswith(prefixes))


RECEIVER_ROWS: Final[tuple[Row, ...]] = rows_streams.ROWS
_PARTS: Final = (("pos1-", "pos2-"), ("out-",), ("stats-",), ("ant",), ("misc-",), ("file-",))
SYSTEM_ROWS: Final[tuple[Row, ...]] = tuple(row for prefixes in _PARTS for row in _beginning(*prefixes))
ALL_ROWS: Final[dict[str, Row]] = {row.name: row for row in (*RECEIVER_ROWS, *SYSTEM_ROWS)}


def row_like(name: str, dialect: Dialect) -> Row | None:
    """Return the row that RTKLIB takes a name for: the first one, system keys before receiver keys, that has it somewhere in its name."""
    known = [row for row in (*SYSTEM_ROWS, *RECEIVER_ROWS) if row.known_to(dialect)]
    return next((row for row in known if name and name in row.name), None)
