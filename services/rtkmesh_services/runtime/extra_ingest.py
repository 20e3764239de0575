"""The table of an ingest that is in no file: control hands it to the process that it starts for a preset, in the environment."""

import os
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import msgspec

from rtkmesh_schemas.config import IngestTable, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.runtime.configuration import Site

INGEST_VARIABLE: Final = "RTKMESH_INGEST"
_WITHOUT_STATION: Final = ("single", "moving-base")


def ingest_environment(table: IngestTable) -> dict[str, str]:
    """Return what the process of an ingest is told beside its file."""
    return {INGEST_VARIABLE: msgspec.json.encode(table).decode()}


def with_extra_ingest(site: Site, id: str, environment: Mapping[str, str] = os.environ) -> Site:  # noqa: A002  the word of the design
    """Return the site with the ingest that the environment describes, as base of every solver that may use it; ConfigError for none.

    So a caster that wants to know where the rover is learns it from those solvers.
    """
    text = environment.get(INGEST_VARIABLE)
    if not text:
        return site
    try:
        table = msgspec.json.decode(text, type=IngestTable)
    except msgspec.MsgspecError as error:
        raise ConfigError(INGEST_VARIABLE, None, f"no table of an ingest: {error}") from error
    deployment = site.deployment
    solvers = {name: _with_base(solver, id) for name, solver in deployment.solver.items()}
    return replace(site, deployment=msgspec.structs.replace(deployment, ingest={**deployment.ingest, id: table}, solver=solvers))


def _with_base(solver: SolverTable, base: str) -> SolverTable:
    return solver if solver.mode in _WITHOUT_STATION else msgspec.structs.replace(solver, base=base)
