"""Kernels that count no references: what is returned to one would never be freed, what one returns might be freed too soon."""

import ast
import gc
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba.core.runtime.nrt import rtsys
from tests.rtk.test_engine import run

import rtkmesh

ENGINE = Path(rtkmesh.__file__).parent
NUMBERS = {"None", "bool", "int", "float"}
TUPLES_OF_NUMBERS = {"Six"}


def kernels() -> Iterator[tuple[str, ast.FunctionDef]]:
    """Yield the decorator and the definition of every kernel of the engine."""
    for path in ENGINE.rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef):
                yield from ((ast.unparse(one), node) for one in node.decorator_list if ast.unparse(one).startswith("kernel"))


def returns_numbers(function: ast.FunctionDef) -> bool:
    """Return whether only numbers come back from a kernel."""
    said = ast.unparse(function.returns) if function.returns else ""
    inner = said.removeprefix("tuple[").removesuffix("]").split(", ")
    return said in TUPLES_OF_NUMBERS or set(inner) <= NUMBERS


def test_no_array_comes_back_to_a_kernel_that_would_not_free_it():
    """A kernel in place returns numbers and calls kernels that return numbers: by name, for names are unique enough."""
    found = list(kernels())
    with_arrays = {function.name for _, function in found if not returns_numbers(function)}
    in_place = [function for decorator, function in found if decorator == "kernel_in_place"]
    assert len(in_place) > 100
    for function in in_place:
        called = {node.func.id for node in ast.walk(function) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        assert returns_numbers(function), function.name
        assert not called & with_arrays, (function.name, called & with_arrays)


@pytest.mark.data
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without compilation Python counts")
def test_epochs_leave_no_arrays_behind(recording: Any):
    """The same epochs a second time, by an engine that begins anew: as many arrays are freed as were made."""

    def solve() -> None:
        assert all(solution.ambiguities for solution in run(*recording)[0])

    def kept() -> int:
        gc.collect()
        made: Any = rtsys.get_allocation_stats()
        assert made.mi_alloc > 1000, "nothing was counted"
        return int(made.mi_alloc - made.mi_free)

    counting: Any = importlib.import_module("numba.core.runtime._nrt_python")
    counting.memsys_enable_stats()
    solve()
    before = kept()
    solve()
    assert kept() == before
