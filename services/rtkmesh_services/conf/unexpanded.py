"""A deployment file with its references to the environment as they stand there: what is shown, compared and exported has no secrets."""

import re
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config import Deployment, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.runtime.configuration import MAXIMUM_FILE, load_solver_table, parse_deployment
from rtkmesh_services.runtime.toml_lines import lines_of

_REFERENCE: Final = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_HIDDEN: Final = re.compile("\u27e8([A-Za-z_][A-Za-z0-9_]*)\u27e9")
_DATA: Final = ("{data}", "\u27e8/data/\u27e9")
SOLVER_FILE_ID: Final = "rtk"


def load_unexpanded(path: Path) -> tuple[Deployment, dict[tuple[str, ...], int]]:
    """Return a deployment (of a file with the one table [solver], too) and the line of each of its keys; ConfigErrors names all faults."""
    try:
        text = path.read_text("utf-8") if path.stat().st_size <= MAXIMUM_FILE else ""
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), None, getattr(error, "strerror", None) or "no UTF-8 text") from error
    if re.search(r"(?m)^[ \t]*\[[ \t]*solver[ \t]*\]", text):
        return _solver_file(path, text)
    hidden = _REFERENCE.sub("\u27e8\\1\u27e9", text).replace(*_DATA)
    deployment = parse_deployment(hidden, str(path))
    return msgspec.convert(_restored(msgspec.to_builtins(deployment)), Deployment), lines_of(hidden)


def _solver_file(path: Path, text: str) -> tuple[Deployment, dict[tuple[str, ...], int]]:
    table = load_solver_table(path.resolve().name, path.resolve().parent)
    lines = {(where[0], SOLVER_FILE_ID, *where[1:]): line for where, line in lines_of(text).items()}
    return Deployment(solver={SOLVER_FILE_ID: table}), lines


def _restored(value: Any) -> Any:
    if isinstance(value, str):
        return _HIDDEN.sub(r"${\1}", value.replace(_DATA[1], _DATA[0]))
    if isinstance(value, dict):
        return {_restored(name): _restored(item) for name, item in value.items()}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any TOML
    if isinstance(value, list | tuple):
        return [_restored(item) for item in value]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  as above
    return value


def one_solver(deployment: Deployment, name: str, file: str) -> tuple[str, SolverTable]:
    """Return the solver of a name, or the only one; ConfigError says which there are."""
    solvers = deployment.solver
    if name in solvers or (not name and len(solvers) == 1):
        name = name or next(iter(solvers))
        return name, solvers[name]
    there = ", ".join(solvers) or "none"
    raise ConfigError(
        file, None, f"no [solver.{name}]; there is {there}" if name else f"has {len(solvers)} solvers ({there}): say --solver ID"
    )
