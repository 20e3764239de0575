"""``rtkmesh warm`` leaves nothing to compile: no solver stands still for a minute because a rare case comes."""

import ast
import importlib
from collections.abc import Iterator
from pathlib import Path

import pytest

import rtkmesh
import rtkmesh_services
from rtkmesh_services.cli.warm import steps

Name = tuple[str, str]


def sources() -> dict[str, ast.Module]:
    """Return the modules of engine and services, parsed."""
    found: dict[str, ast.Module] = {}
    for package in (rtkmesh, rtkmesh_services):
        root = Path(package.__path__[0])
        for path in root.rglob("*.py"):
            found[".".join((root.name, *path.relative_to(root).with_suffix("").parts))] = ast.parse(path.read_text())
    return found


def is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any(ast.unparse(one) in {"kernel", "kernel_in_place"} for one in node.decorator_list)


def names_in_python(node: ast.AST) -> Iterator[str]:
    """Yield the names that are used outside kernels."""
    for child in ast.iter_child_nodes(node):
        if is_kernel(child):
            continue
        if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Load):
            yield child.id
        yield from names_in_python(child)


def kernels_of(tree: ast.Module) -> set[str]:
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and is_kernel(node)}


def imports_of(tree: ast.Module) -> Iterator[tuple[str, Name]]:
    """Yield what a module imports from others, by the name that it has here."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((alias.asname or alias.name, (node.module, alias.name)) for alias in node.names)


def called_from_python() -> set[Name]:
    """Return the kernels that code outside kernels uses: those that are compiled by themselves."""
    modules = sources()
    kernels = {(module, name) for module, tree in modules.items() for name in kernels_of(tree)}
    called: set[Name] = set()
    for module, tree in modules.items():
        known = {name: (module, name) for name in kernels_of(tree)} | {here: there for here, there in imports_of(tree) if there in kernels}
        called |= {known[name] for name in names_in_python(tree) if name in known}
    return called


@pytest.mark.slow  # which is not run without JIT: there is nothing to compile
def test_every_kernel_that_python_calls_is_warm():
    for _, action in steps():
        action()
    called = called_from_python()
    assert len(called) > 40
    assert ("rtkmesh.rtk.relative", "solve") in called
    cold = [(module, name) for module, name in sorted(called) if not getattr(importlib.import_module(module), name).overloads]
    assert cold == []
