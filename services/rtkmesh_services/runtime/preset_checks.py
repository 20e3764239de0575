"""What is checked of ``[preset.NAME]``: names, sources, positions, and the lists of solvers that name them."""

from typing import Final

from rtkmesh_schemas.config import Deployment
from rtkmesh_schemas.config_presets import PresetTable
from rtkmesh_schemas.presets import PRESET_NAME, ingest_id
from rtkmesh_services.runtime.file_faults import Faults
from rtkmesh_services.runtime.words import clip, nearest

SCHEMES: Final = ("serial", "tcp", "tcp-listen", "udp", "ntrip", "ntrips", "sim", "ingest")


def check_presets(reader: Faults, deployment: Deployment) -> None:
    """Gather the faults of presets, and of solvers that name them."""
    for name, table in deployment.preset.items():
        _check_preset(reader, name, table)
    known = reader.names_of("preset")
    for id_, solver in deployment.solver.items():
        for index, name in enumerate(solver.presets):
            if name not in known:
                there = nearest(name, known) or f"; there {'are' if len(known) != 1 else 'is'} {', '.join(known) or 'none'}"
                reader.fault(("solver", id_, "presets", str(index)), f"[solver.{id_}] presets: no [preset.{clip(name)}]{there}")
        if solver.presets and solver.mode in ("single", "moving-base"):
            reader.fault(("solver", id_, "presets"), f"[solver.{id_}] presets: mode {solver.mode!r} has no base station")


def source_fault(source: str) -> str:
    """Return what is wrong with a source of a base station, or nothing. Its options are checked by who opens it."""
    scheme, found, _ = source.partition("://")
    if found and scheme in SCHEMES:
        return ""
    why = "a recording or the standard input is no base station" if scheme in ("file", "stdin") else f"unknown source {clip(scheme)!r}"
    return f"{why}{nearest(scheme, list(SCHEMES))}; sources are {', '.join(SCHEMES)}"


def _check_preset(reader: Faults, name: str, table: PresetTable) -> None:
    if ingest_id(name) in reader.names_of("ingest"):
        reader.fault(("preset", name), f"[preset.{name}] its stream is read by a process {ingest_id(name)!r}: [ingest] has one of that id")
    if not PRESET_NAME.fullmatch(name):
        reader.fault(("preset", name), f"[preset.{clip(name)}] is no preset's name: 1 to 64 letters, digits, '_', '-', '.'")
    for index, source in enumerate(table.sources):
        if fault := source_fault(source):
            reader.fault(("preset", name, "sources", str(index)), f"[preset.{name}] sources: {fault}")
    if table.position_ecef_m is not None and table.position_llh_deg is not None:
        reader.fault(("preset", name, "position_llh_deg"), f"[preset.{name}] has two positions: say one of them")
