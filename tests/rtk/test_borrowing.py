"""Kernels borrow what they are given: they count no references to it, and still free what they make and keep what they give back."""

import gc
import importlib
import os
import re
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core.runtime.nrt import rtsys

from rtkmesh._borrowing import BorrowingCompiler

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without compilation Python counts")

compiled: Any = numba.njit(nogil=True, error_model="numpy", pipeline_class=BorrowingCompiler)


class Arrays(NamedTuple):
    """What travels together."""

    row: Any
    table: Any


def arrays() -> Arrays:
    return Arrays(np.arange(4.0), np.arange(12.0).reshape(3, 4))


@compiled
def total(given: Arrays, n: int) -> float:
    work = np.empty(n)
    work[:] = given.row[0]
    return work.sum() + given.table[1, 1]


@compiled
def handed_on(given: Arrays, n: int) -> float:
    """Two calls that may raise, a way out before them and one between, a name for a field, and one for each row in a loop."""
    if n > 3:
        return total(given, n)
    table, found = given.table, total(given, n + 1)
    for k in range(len(table)):
        line = table[k]
        part = line[1:3]
        if part[0] < 0.0:
            return line[0]
        found += part[0]
    return found + total(given, n)


@compiled
def given_back(given: Arrays, which: int) -> tuple[Any, Any, Any]:
    """A field, a view and something new, all of them by names that may be something else."""
    chosen = given.row if which == 0 else given.table[which]
    made = np.ones(2)
    row = given.table[0]
    if which == 2:
        made = chosen[:2]
    return chosen, row, made


@compiled
def changed(given: Arrays, times: int) -> Any:
    """A tuple that is replaced in a loop, and a row that is copied by its index."""
    for k in range(times):
        given = Arrays(given.row + 1.0, given.table)
        given.table[k % 3] += given.row
    return given.table[np.array((0, 2))]


def own_code(kernel: Any) -> list[str]:
    """The parts of a kernel's code that are itself, not the wrappers through which Python comes."""
    parts = re.split(r"\ndefine ", next(iter(kernel.inspect_llvm().values())))[1:]
    symbols = [found.group() if (found := re.search(r"@\w+", part)) else "" for part in parts]
    name = kernel.py_func.__name__
    return [part for part, symbol in zip(parts, symbols, strict=True) if name in symbol and not re.search("_ZN7cpython|@cfunc", symbol)]


def test_nothing_that_is_handed_on_is_counted():
    assert handed_on(arrays(), 2) == 2 * 5.0 + 1.0 + 5.0 + 9.0
    code = own_code(handed_on)
    assert code
    assert not any("@NRT_incref(" in part for part in code)


def test_what_is_given_back_outlives_what_it_was_taken_from():
    kept = [given_back(arrays(), which) for which in (0, 1, 2) for _ in range(50)]
    gc.collect()
    noise = [np.full(4, np.nan) for _ in range(1000)]
    for k, (chosen, row, made) in enumerate(kept):
        which = k // 50
        assert chosen.tolist() == (np.arange(4.0) + 4.0 * which).tolist()
        assert row.tolist() == [0.0, 1.0, 2.0, 3.0]
        assert made.tolist() == ([1.0, 1.0] if which < 2 else [8.0, 9.0])
    assert len(noise) == 1000


def test_as_many_arrays_are_freed_as_are_made():
    counting: Any = importlib.import_module("numba.core.runtime._nrt_python")
    counting.memsys_enable_stats()
    one = arrays()

    def work() -> None:
        for n in range(5):
            handed_on(one, n)
            given_back(one, n % 3)
            changed(arrays(), n)

    def living() -> int:
        gc.collect()
        stats: Any = rtsys.get_allocation_stats()
        return int(stats.mi_alloc - stats.mi_free)

    work()
    before, made = living(), rtsys.get_allocation_stats().mi_alloc
    work()
    assert rtsys.get_allocation_stats().mi_alloc > made + 20
    assert living() == before
    assert changed(arrays(), 2).tolist() == [[1.0, 3.0, 5.0, 7.0], [8.0, 9.0, 10.0, 11.0]]
