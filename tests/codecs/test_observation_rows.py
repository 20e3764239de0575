"""Rows of observations: room for any number of them, and their order."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.observation_rows import (
    MAX_MESSAGE_ROWS,
    PRIORITY_SHIFT,
    ROW_MASK,
    SATELLITE_SHIFT,
    SIGNAL_MASK,
    SIGNAL_SHIFT,
    Rows,
    sort_keys,
)

SIGNALS = st.tuples(st.integers(1, 447), st.sampled_from([28, 44, 63, 130]), st.integers(0, 1))


@given(
    signals=st.lists(st.one_of(SIGNALS, st.tuples(st.integers(1, 3), st.just(28), st.integers(0, 1))), max_size=60), in_order=st.booleans()
)
@settings(max_examples=80, deadline=None)
def test_rows_come_in_the_order_of_satellite_and_signal_each_once(signals: list[tuple[int, int, int]], in_order: bool):
    """Against a plain sort: of equal signals the lower priority stays, then the one that came first."""
    signals = sorted(signals) if in_order else signals
    keys = np.array(
        [s << SATELLITE_SHIFT | g << SIGNAL_SHIFT | p << PRIORITY_SHIFT | row for row, (s, g, p) in enumerate(signals)], np.int64
    )
    kept: dict[tuple[int, int], int] = {}
    for satellite, signal, _, row in sorted((*signal, row) for row, signal in enumerate(signals)):
        kept.setdefault((satellite, signal), row)
    count = sort_keys(keys)
    found = [(key >> SATELLITE_SHIFT, key >> SIGNAL_SHIFT & SIGNAL_MASK, key & ROW_MASK) for key in keys[:count].tolist()]
    assert found == [(*signal, row) for signal, row in kept.items()]


@given(
    sizes=st.lists(st.tuples(st.integers(0, MAX_MESSAGE_ROWS), st.sampled_from(["keep", "keep", "keep", "drop", "finish"])), max_size=60)
)
@settings(max_examples=60, deadline=None)
def test_rows_in_use_survive_whatever_comes_behind_them(sizes: list[tuple[int, str]]):
    """Messages that are kept, dropped, or begin a new epoch: the rows in use are those of the epoch, in order, and never overwritten."""
    rows, used, number = Rows(), list[int](), 0
    for size, what in sizes:
        first = rows.reserve()
        assert first == rows.end
        assert len(rows.cells) == len(rows.values) >= first + MAX_MESSAGE_ROWS
        numbers = np.arange(number, number + size)
        rows.cells[first : first + size], rows.values[first : first + size] = numbers[:, None] % 30_000, numbers[:, None]
        rows.values[first + size : first + MAX_MESSAGE_ROWS] = np.nan
        number += size
        if what == "finish":
            rows.begin, used = rows.end, []
        if what != "drop":
            rows.end += size
            used += numbers.tolist()
        assert rows.values[rows.begin : rows.end, 4].tolist() == used
        assert rows.cells[rows.begin : rows.end, 0].tolist() == [x % 30_000 for x in used]
