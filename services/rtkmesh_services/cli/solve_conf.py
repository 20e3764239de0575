"""What a .conf file of RTKLIB says to ``rtkmesh solve``."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, cast

from rtkmesh_schemas.config import SolverTable

Direction = Literal["forward", "backward", "combined"]
Form = Literal["llh", "xyz", "enu"]
TimeForm = Literal["calendar", "tow"]
_FORMATS: Final = ("llh", "xyz", "enu")


@dataclass(frozen=True, slots=True)
class ConfOptions:
    """The solver and what else of the file is a flag of ``rtkmesh solve``."""

    solver: SolverTable
    folder: Path
    direction: Direction
    form: Form
    velocity: bool
    time_form: TimeForm
    base_ecef_m: tuple[float, float, float] | None


def conf_options(path: Path, *, quiet: bool) -> ConfOptions:
    """Return what a .conf file says, reported on standard error unless ``quiet``; ConfError for a file that cannot be read."""
    from rtkmesh_services.cli.conf_report import print_report
    from rtkmesh_services.conf.conf_file import read_conf
    from rtkmesh_services.conf.importer import import_conf

    conf = read_conf(path)
    imported = import_conf(conf)
    direction = conf.choice("pos1-soltype").removesuffix("-nophasereset")
    form = conf.choice("out-solformat")
    if form not in _FORMATS:
        sys.stderr.write(f"{path}: out-solformat={form} is not written by solve: llh instead\n")
    if not quiet:
        print_report(imported)
    return ConfOptions(
        solver=imported.solver,
        folder=path.resolve().parent,
        direction=cast("Direction", direction if imported.solver.mode != "single" else "forward"),
        form=form if form in _FORMATS else "llh",
        velocity=conf.choice("out-outvel") == "on",
        time_form="tow" if conf.choice("out-timeform") == "tow" else "calendar",
        base_ecef_m=imported.base_ecef_m,
    )
