"""What a configuration means: every value that counts, with where it comes from. Passwords are not among what is shown."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from rtkmesh_schemas.config import Deployment
from rtkmesh_services.conf.conf_file import DialectWish, read_conf
from rtkmesh_services.conf.importer import import_conf
from rtkmesh_services.conf.report import MASKED
from rtkmesh_services.conf.solver_setters import ENGINE_DEFAULTS
from rtkmesh_services.conf.unexpanded import load_unexpanded
from rtkmesh_services.runtime.deployment_checks import NAMED

_CREDENTIALS: Final = re.compile(r"^([a-z-]+://[^:/?@]*):(.*)@(?=[^@]*$)", re.DOTALL)
_REFERENCE: Final = re.compile(r"\$\{\w+\}")
_SECRET: Final = re.compile(r"password|passwd|secret|token", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Setting:
    """One value. ``origin``: ``line N`` of the file, or ``default``."""

    key: str
    value: Any
    origin: str


def settings_of(path: Path, dialect: DialectWish = "auto") -> dict[str, Setting]:
    """Return all effective values of a deployment, a solver file or a .conf file; ConfigErrors and ConfError name what is wrong."""
    if path.suffix == ".toml":
        deployment, lines = load_unexpanded(path)
        return _settings(deployment, lines)
    imported = import_conf(read_conf(path, dialect))
    return _settings(imported.deployment, imported.origins)


def _settings(deployment: Deployment, lines: dict[tuple[str, ...], int]) -> dict[str, Setting]:
    found: dict[str, Setting] = {}
    content: dict[str, Any] = msgspec.to_builtins(deployment)
    for role, table in content.items():
        rows = {(role, name): row for name, row in table.items()} if role in NAMED else {(role,): table}
        for path, row in rows.items():
            for key, value in _leaves(row, path):
                name = ".".join(key)
                line = lines.get(key)
                found[name] = Setting(name, _shown(key, _engines(key, value)), f"line {line}" if line else "default")
    return found


def _leaves(table: dict[str, Any], path: tuple[str, ...]) -> list[tuple[tuple[str, ...], Any]]:
    leaves: list[tuple[tuple[str, ...], Any]] = []
    for name, value in table.items():
        leaves += _leaves(value, (*path, name)) if isinstance(value, dict) else [((*path, name), value)]  # pyright: ignore[reportUnknownArgumentType]  any TOML
    return leaves


def _engines(key: tuple[str, ...], value: Any) -> Any:
    """Return what the engine uses where a solver's table says nothing."""
    return ENGINE_DEFAULTS.get(".".join(key[2:])) if value is None and key[0] == "solver" else value


def _shown(key: tuple[str, ...], value: Any) -> Any:
    """Return a value without secrets; references to the environment are none."""
    if isinstance(value, list | tuple):
        return [_shown(key, item) for item in value]  # pyright: ignore[reportUnknownVariableType]  any TOML
    if not isinstance(value, str) or not value:
        return value
    if _SECRET.search(key[-1]) or key[-2:-1] == ("users",):
        return value if _REFERENCE.fullmatch(value) else MASKED
    return _CREDENTIALS.sub(lambda match: f"{match[1]}:{match[2] if _REFERENCE.fullmatch(match[2]) else MASKED}@", value)


@dataclass(frozen=True, slots=True)
class Difference:
    """One key with its values in both files; None where a file has no such table."""

    key: str
    one: Setting | None
    other: Setting | None


def differences(one: dict[str, Setting], other: dict[str, Setting]) -> list[Difference]:
    """Return the keys whose effective values differ. Where each side has one solver, one rover ... their ids do not count."""
    names = {_canonical(key, one): key for key in one}
    others = {_canonical(key, other): key for key in other}
    rows: list[Difference] = []
    for name in dict.fromkeys([*names, *others]):
        a, b = one.get(names.get(name, "")), other.get(others.get(name, ""))
        if a is None or b is None or _value(a) != _value(b):
            rows.append(Difference(name, a, b))
    return rows


def comparable(one: Path, other: Path, dialect: DialectWish = "auto") -> tuple[dict[str, Setting], dict[str, Setting]]:
    """Return the settings of two files that can be compared: of solvers alone, where one of them has nothing else."""
    both = settings_of(one, dialect), settings_of(other, dialect)
    if all(any(key.startswith("ingest.") for key in settings) for settings in both):
        return both
    first, second = ({key: row for key, row in settings.items() if key.startswith("solver.")} for settings in both)
    return first, second


def _canonical(key: str, settings: dict[str, Setting]) -> str:
    solvers = _solvers(settings)
    role, _, rest = key.partition(".")
    if role == "solver" and len(solvers) == 1:
        return f"solver.{rest.partition('.')[2]}"
    return key


def _value(setting: Setting) -> Any:
    return 0.0 + setting.value if isinstance(setting.value, int) and not isinstance(setting.value, bool) else setting.value


def _solvers(settings: dict[str, Setting]) -> set[str]:
    return {key.split(".")[1] for key in settings if key.startswith("solver.")}
