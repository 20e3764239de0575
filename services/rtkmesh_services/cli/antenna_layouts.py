"""Layouts of antennas as TOML tables: written by a calibration, read by a design and by ``[attitude.ID]``."""

import tomllib
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rtkmesh.attitude.layout_covariance import Triple, blocks_of, joint_covariance
from rtkmesh.attitude.rigid_body import Layout
from rtkmesh_services.errors import SourceError


def layout_toml(layout: Layout, attitude: str, comments: list[str]) -> str:
    """Return the tables ``[attitude.ID.antennas.NAME]`` of a layout with its covariance, to be pasted or loaded."""
    blocks = blocks_of(layout)
    sigmas = np.zeros_like(layout.positions_m) if layout.cov_m2 is None else np.sqrt(np.maximum(np.diag(layout.cov_m2), 0.0)).reshape(-1, 3)
    lines = [f"# {comment}" for comment in comments]
    for name, place, sigma in zip(layout.names, layout.positions_m, sigmas, strict=True):
        lines += ["", f"[attitude.{attitude}.antennas.{_key(name)}]", f"position_m = {_numbers(place)} # forward, right, down"]
        lines += [f"sigma_m = {_numbers(sigma)}"] if layout.cov_m2 is not None else []
        lines += [f"covariance_m2.{_key(other)} = {_small(block)}" for other, block in blocks.get(name, {}).items()]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else '"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _numbers(values: NDArray[np.float64]) -> str:
    return "[" + ", ".join(f"{round(float(value), 4) + 0.0:.4f}" for value in values) + "]"


def _small(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{value:.4e}" if value else "0.0" for value in values) + "]"


def read_layouts(path: Path) -> dict[str, Layout]:
    """Return the layouts of a TOML file: of every ``[attitude.ID]`` that has antennas. SourceError says what is wrong."""
    try:
        content = tomllib.loads(path.read_text())
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from error
    except (ValueError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: {error}") from error
    tables = content.get("attitude")
    found = {name: _layout(path, name, table) for name, table in _tables(tables).items() if "antennas" in _tables(table)}
    if not found:
        raise SourceError(f"{path}: no antennas: it needs [attitude.ID.antennas.NAME] with position_m = [forward, right, down]")
    return found


def _tables(value: Any) -> dict[str, Any]:
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def _layout(path: Path, attitude: str, table: Any) -> Layout:
    antennas = _tables(_tables(table)["antennas"])
    places, sigmas, blocks = list[list[float]](), dict[str, Triple](), dict[str, dict[str, tuple[float, ...]]]()
    for name, antenna in antennas.items():
        where = f"{path}: [attitude.{attitude}.antennas.{name}]"
        places.append(_three(where, "position_m", _tables(antenna).get("position_m")))
        sigma = _tables(antenna).get("sigma_m", 0.0)
        forward, right, down = _three(where, "sigma_m", [sigma] * 3 if isinstance(sigma, int | float) else sigma)
        sigmas[name] = forward, right, down
        told = _tables(_tables(antenna).get("covariance_m2"))
        blocks[name] = {other: tuple(_row(where, "covariance_m2", 9, values)) for other, values in told.items()}
    if not places:
        raise SourceError(f"{path}: [attitude.{attitude}.antennas] has no antenna")
    return Layout(tuple(antennas), np.array(places), joint_covariance(sigmas, blocks))


def _three(where: str, key: str, value: Any) -> list[float]:
    return _row(where, key, 3, value)


def _row(where: str, key: str, count: int, value: Any) -> list[float]:
    values = cast("list[Any]", value) if isinstance(value, list) else []
    if len(values) != count or not all(isinstance(part, int | float) and abs(part) < 1e6 for part in values):
        wanted = "three numbers in metres (forward, right, down) are" if count == 3 else f"{count} numbers in square metres are"
        raise SourceError(f"{where} {key}: {wanted} needed")
    return [float(part) for part in values]
