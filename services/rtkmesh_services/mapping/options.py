"""A solver's table of the deployment file to the engine's options: degrees to radians, absent to default."""

from dataclasses import replace
from math import radians
from pathlib import Path
from typing import Any

import msgspec

from rtkmesh.rtk.options import AmbiguityMode, Mode, RtkOptions
from rtkmesh.rtk.session import SessionOptions, pairing_for
from rtkmesh_schemas.config import SolverTable
from rtkmesh_services.mapping.antennas import antenna_finder


def rtk_options(table: SolverTable) -> RtkOptions:
    """Return the engine's options of a solver table."""
    defaults = RtkOptions()
    ambiguity = _given(table.ambiguity)
    if "mode" in ambiguity:
        ambiguity["mode"] = AmbiguityMode(ambiguity["mode"])
    if "elevation_mask_deg" in ambiguity:
        ambiguity["elevation_mask_rad"] = radians(ambiguity.pop("elevation_mask_deg"))
    return RtkOptions(
        mode=Mode(table.mode),
        systems=table.systems,
        frequencies=table.frequencies,
        elevation_mask_rad=radians(table.elevation_mask_deg),
        cn0_mask_dbhz=table.cn0_mask_dbhz,
        max_age_s=table.max_age_s,
        time_tolerance_s=table.sync.tolerance_s,
        baseline_length_m=table.baseline_length_m,
        baseline_sigma_m=table.baseline_sigma_m,
        fixed_position_ecef_m=table.fixed_position_ecef_m,
        excluded=table.excluded,
        noise=replace(defaults.noise, **_given(table.noise)),
        dynamics=replace(defaults.dynamics, **_given(table.dynamics)),
        ambiguity=replace(defaults.ambiguity, **ambiguity),
        integrity=replace(defaults.integrity, **_given(table.integrity)),
    )


def session_options(
    table: SolverTable, *, replay: bool, base_position_ecef_m: tuple[float, float, float] | None = None, folder: Path = Path()
) -> SessionOptions:
    """Return the session's options; ``replay`` when every source is a recording; ``folder`` is where relative file names begin."""
    options = rtk_options(table)
    return SessionOptions(
        rtk=options,
        pairing=pairing_for(
            options, replay=replay, maximum_wait_s=table.sync.max_wait_s, matched_only=table.sync.matched_only,
            interpolate=table.sync.interpolate or False,
        ),
        base_position_ecef_m=base_position_ecef_m,
        navigation_streams=len(navigation_only(table)),
        rover_antenna=table.rover_antenna,
        base_antenna=table.base_antenna,
        find_antenna=antenna_finder(folder / table.antex if table.antex else None),
    )  # fmt: skip


def navigation_only(table: SolverTable) -> tuple[str, ...]:
    """Return the ids of the ingests that give a solver nothing but navigation data."""
    return tuple(name for name in dict.fromkeys(table.navigation) if name not in (table.rover, table.base))


def _given(table: msgspec.Struct) -> dict[str, Any]:
    return {name: value for name, value in msgspec.structs.asdict(table).items() if value is not None}
