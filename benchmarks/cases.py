"""The recordings of ``cases.toml`` as values: what is solved, with which options, and what it is held against."""

import os
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import score_pos

REPOSITORY = Path(__file__).resolve().parents[1]
QUICK = ("tokyo_static_l125", "kanagawa_60s", "geonet_2005", "yamatogawa_walk")


@dataclass(frozen=True, slots=True)
class Case:
    """One pair of receivers. Paths are absolute."""

    name: str
    folder: Path
    rover: Path
    base: Path
    navigation: tuple[Path, ...]
    base_ecef_m: tuple[float, float, float]
    frequencies: int
    systems: str
    epochs: int
    moving: bool
    date: str
    truth: score_pos.Truth
    stored: dict[str, Path]

    @property
    def against(self) -> str:
        """What errors are errors from."""
        if self.truth.position_ecef_m is not None:
            return "known position"
        if self.truth.reference is not None:
            return "another engine's track"
        return "none" if self.moving else "own median"

    def score(self, pos: Path) -> score_pos.Row:
        """Return the figures of a .pos file of this case; a file without solutions is a row of nothing."""
        try:
            row = score_pos.score(pos, self.truth, epochs=self.epochs)
        except (OSError, score_pos.ScoreError) as error:
            return {"failed": str(error)}
        if self.against == "none":
            return {name: row[name] for name in ("solutions", "of_epochs", "fix_pct", "float_pct", "ttff_s")}
        return row

    def score_common(self, pos: Path, other: Path) -> score_pos.Row | None:
        """Return the errors of a file at epochs that another one has fixed too; None without any or without a truth."""
        if self.against == "none":
            return None
        try:
            return score_pos.common_fixes(pos, other, self.truth)
        except (OSError, score_pos.ScoreError):
            return None


def data_folder() -> Path | None:
    """Return the folder of the recordings (RTKMESH_DATA or ../shared/data), or None."""
    for candidate in (os.environ.get("RTKMESH_DATA"), REPOSITORY.parent / "shared" / "data"):
        if candidate and (Path(candidate) / "cases.toml").is_file():
            return Path(candidate).resolve()
    return None


def load(data: Path, names: list[str] | None = None) -> list[Case]:
    """Return the cases of ``data``/cases.toml, in its order; KeyError names a case that it does not have."""
    rows: list[dict[str, Any]] = tomllib.loads((data / "cases.toml").read_text())["case"]
    cases = {row["name"]: _case(data / row["set"], row) for row in rows}
    return list(cases.values()) if names is None else [cases[name] for name in names]


def _case(folder: Path, row: dict[str, Any]) -> Case:
    position = row.get("truth_ecef_m")
    reference = folder / row["reference"] if "reference" in row else None
    return Case(
        name=row["name"],
        folder=folder,
        rover=folder / row["rover"],
        base=folder / row["base"],
        navigation=tuple(folder / name for name in row["nav"]),
        base_ecef_m=tuple(row["base_ecef_m"]),
        frequencies=row["frequencies"],
        systems=row["systems"],
        epochs=row["epochs"],
        moving=row.get("moving", False),
        date=row.get("date", ""),
        truth=score_pos.Truth(position_ecef_m=tuple(position) if position else None, reference=reference),
        stored={name: folder / file for name, file in row["rtklib"].items()},
    )
