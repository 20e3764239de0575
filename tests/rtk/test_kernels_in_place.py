"""Kernels that count no references: what is returned to one would never be freed, what one returns might be freed too soon."""

import ast
import gc
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from numba.core.runtime.nrt import rtsys
from tests.rtk.test_engine import run

import rtkmesh

ENGINE = Path(rtkmesh.__file__).parent
NUMBERS = {"None", "bool", "int", "float"}
TUPLES_OF_NUMBERS = {"Six", "Guard"}


class Kernel(NamedTuple):
    """A kernel of the engine: its decorator, its definition, and the names of its module, as (module, name) where they come from."""

    decorator: str
    function: ast.FunctionDef
    names: dict[str, tuple[str, str]]
    module: str


def kernels() -> Iterator[Kernel]:
    """Yield every kernel of the engine."""
    for path in ENGINE.rglob("*.py"):
        body = ast.parse(path.read_text()).body
        module = ".".join(("rtkmesh", *path.relative_to(ENGINE).with_suffix("").parts))
        names = {node.name: (module, node.name) for node in body if isinstance(node, ast.FunctionDef)}
        for node in body:
            if isinstance(node, ast.ImportFrom):
                names |= {one.asname or one.name: (node.module or "", one.name) for one in node.names}
        for node in body:
            if isinstance(node, ast.FunctionDef):
                decorators = [ast.unparse(one) for one in node.decorator_list]
                yield from (Kernel(one, node, names, module) for one in decorators if one.startswith("kernel"))


def returns_numbers(function: ast.FunctionDef) -> bool:
    """Return whether only numbers come back from a kernel."""
    said = ast.unparse(function.returns) if function.returns else ""
    inner = said.removeprefix("tuple[").removesuffix("]").split(", ")
    return said in TUPLES_OF_NUMBERS or set(inner) <= NUMBERS


def test_no_array_comes_back_to_a_kernel_that_would_not_free_it():
    """A kernel in place returns numbers and calls kernels that return numbers."""
    found = list(kernels())
    with_arrays = {(one.module, one.function.name) for one in found if not returns_numbers(one.function)}
    in_place = [one for one in found if one.decorator == "kernel_in_place"]
    assert len(in_place) > 100
    for one in in_place:
        calls = [node.func for node in ast.walk(one.function) if isinstance(node, ast.Call)]
        called = {one.names.get(name.id, ("", name.id)) for name in calls if isinstance(name, ast.Name)}
        assert returns_numbers(one.function), one.function.name
        assert not called & with_arrays, (one.function.name, called & with_arrays)


def made_from_scratch(function: ast.FunctionDef) -> set[str]:
    """Return the names that a kernel gives to room on its stack, in simple assignments and those of several names."""
    names = set[str]()
    for node in ast.walk(function):
        if isinstance(node, ast.Assign) and (target := node.targets[0]):
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            names |= {name.id for name, value in pairs if isinstance(name, ast.Name) and scratches(value)}
    return names


def scratches(node: ast.AST) -> list[ast.AST]:
    """Return the calls below a node that make room on the stack."""
    calls = [one for one in ast.walk(node) if isinstance(one, ast.Call) and isinstance(one.func, ast.Name)]
    return [one for one in calls if isinstance(one.func, ast.Name) and one.func.id.startswith("scratch")]


def whole_names(node: ast.AST | None) -> Iterator[str]:
    """Yield the names that a returned expression hands out as they are: by themselves, in tuples, in calls of a class."""
    if isinstance(node, ast.Name):
        yield node.id
    elif isinstance(node, ast.Tuple):
        for part in node.elts:
            yield from whole_names(part)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id[0].isupper():
        for part in node.args:
            yield from whole_names(part)
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice):
        yield from whole_names(node.value)


def test_no_room_of_a_stack_outlives_its_kernel_or_grows_in_a_loop():
    """What ``scratch`` and its like make is neither returned nor made in a loop: the stack is given back when the kernel returns."""
    users = [one.function for one in kernels() if scratches(one.function)]
    assert len(users) > 30
    for function in users:
        loops = [node for node in ast.walk(function) if isinstance(node, ast.For | ast.While)]
        assert not any(scratches(part) for loop in loops for part in loop.body), function.name
        returned = [node.value for node in ast.walk(function) if isinstance(node, ast.Return)]
        assert not {name for value in returned for name in whole_names(value)} & made_from_scratch(function), function.name


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
