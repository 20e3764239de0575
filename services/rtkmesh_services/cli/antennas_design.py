"""``rtkmesh antennas design``: what a planned layout of antennas will give."""

import json
import sys
from dataclasses import asdict, astuple, dataclass
from math import degrees, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from cyclopts import Parameter

from rtkmesh_services.cli.network import Json
from rtkmesh_services.errors import SourceError
from rtkmesh_services.runtime.words import nearest

if TYPE_CHECKING:
    from rtkmesh.attitude.design import Design, Noise, Sigmas
    from rtkmesh.attitude.rigid_body import Layout

EXAMPLES = """
rtkmesh antennas design --preset square:0.8
rtkmesh antennas design --preset right-angle:1 --preset best-angle:1 --preset triangle:1 --preset cube-corner:1 --plot layouts.png
rtkmesh antennas design --antenna rear=0,0,0 --antenna front=1.2,0,0 --antenna mast=0.6,0.4,-0.3 --point 0,0,1.5
rtkmesh antennas design layout.toml --sigma-horizontal 0.005 --sigma-vertical 0.01 --json
"""
_SIGMA_HEADS: Final = (
    "layout", "without", "shape", "heading deg", "pitch deg", "roll deg", "point horizontal mm", "point vertical mm", "redundancy",
)  # fmt: skip
_FOUND_ONLY: Final = 3  # degrees of freedom that three antennas have: not enough to tell which one is wrong
_FAULT_HEADS: Final = ("layout", "fault of", "forward mm", "right mm", "down mm")
_LEVEL_HEADS: Final = ("layout", "heading deg", "pitch deg", "roll deg")


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of ``rtkmesh antennas design``."""

    antenna: Annotated[
        tuple[str, ...], Parameter(negative="", show_default=False, help="NAME=F,R,D: metres forward, right, down; repeated.")
    ] = ()
    preset: Annotated[
        tuple[str, ...],
        Parameter(negative="", show_default=False, help="NAME:SIZE, a usual layout; repeated. `--preset list` tells them."),
    ] = ()
    point: Annotated[str, Parameter(help="F,R,D: a point of the vehicle whose position is wanted.")] = "0,0,0"
    sigma_horizontal: Annotated[float, Parameter(help="Sigma of an antenna's position against the others, metres.")] = 0.01
    sigma_vertical: Annotated[float, Parameter(help="The same, vertically.")] = 0.02
    base_horizontal: Annotated[float, Parameter(help="Sigma of what all positions share (the base's error), metres.")] = 0.0
    base_vertical: Annotated[float, Parameter(help="The same, vertically.")] = 0.0
    false_alarm: Annotated[float, Parameter(help="Probability of finding a fault where there is none.")] = 1e-3
    power: Annotated[float, Parameter(help="Probability of finding the smallest fault.")] = 0.9
    risk: Annotated[float, Parameter(help="Probability that an angle is further off than its protection level.")] = 1e-5
    antenna_fault: Annotated[float, Parameter(help="Probability that an antenna is off by more than its sigma says.")] = 1e-4
    plot: Annotated[Path | None, Parameter(help="Write a picture (PNG, PDF, SVG by its name).")] = None
    force: Annotated[bool, Parameter(negative="", help="Replace a file that is there.")] = False
    as_json: Json = False


def design(
    *files: Annotated[Path, Parameter(help=r"TOML with \[attitude.ID.antennas.NAME] tables.")],
    request: Annotated[Request, Parameter(name="*")] = Request(),
) -> int:
    """Tell what a layout of antennas will give: sigmas, what the loss of each antenna leaves, the smallest faults that are found.

    Sigmas are for a level vehicle that heads north. Several layouts stand side by side: files, --antenna (one layout) and --preset.

    Exit codes: 0 done, 2 wrong usage or a file that cannot be read.
    """
    from rtkmesh.attitude.design import Noise
    from rtkmesh.attitude.design import design as designed
    from rtkmesh.attitude.protection import Guarding
    from rtkmesh_services.cli.antenna_sources import three
    from rtkmesh_services.cli.written_files import check_free

    if "list" in request.preset:
        return _list()
    _check(request)
    noise = Noise(request.sigma_horizontal, request.sigma_vertical, request.base_horizontal, request.base_vertical)
    point = np.array(three("--point", request.point))
    check_free([request.plot] if request.plot else [], [*files], force=request.force)
    layouts = _layouts(files, request)
    guarding = Guarding(request.risk, request.antenna_fault)
    designs = {
        name: (layout, designed(layout, noise, point, false_alarm=request.false_alarm, power=request.power, guarding=guarding))
        for name, layout in layouts.items()
    }
    _show(designs, noise, request)
    return 0


def _check(request: Request) -> None:
    positive = {"--sigma-horizontal": request.sigma_horizontal, "--sigma-vertical": request.sigma_vertical}
    bad = [flag for flag, value in positive.items() if not 0.0 < value < 100.0]
    common = {"--base-horizontal": request.base_horizontal, "--base-vertical": request.base_vertical}
    bad += [flag for flag, value in common.items() if not 0.0 <= value < 100.0]
    if bad:
        raise SourceError(f"{bad[0]}: metres between 0 and 100 are needed")
    if not (0.0 < request.risk < 1.0 and 0.0 <= request.antenna_fault < 1.0):
        raise SourceError("--risk and --antenna-fault are probabilities")
    if not 0.0 < request.false_alarm < request.power < 1.0:
        raise SourceError("--false-alarm and --power are probabilities, the first smaller than the second")


def _list() -> int:
    from rtkmesh.attitude.presets import PRESETS

    sys.stdout.write("".join(f"{name:13} {text}\n" for name, (_, text) in PRESETS.items()))
    return 0


def _layouts(files: tuple[Path, ...], request: Request) -> dict[str, "Layout"]:
    """Return all layouts that are to be compared, by name."""
    from rtkmesh_services.cli.antenna_layouts import read_layouts

    found: dict[str, Layout] = {}
    for path in files:
        found |= {name if len(files) == 1 else f"{path.stem} {name}": layout for name, layout in read_layouts(path).items()}
    if request.antenna:
        found["antennas"] = _told(request.antenna)
    found |= {text: _preset(text) for text in request.preset}
    if not found:
        raise SourceError("a layout is needed: a TOML file, --antenna NAME=F,R,D ... or --preset NAME:SIZE (--preset list)")
    return found


def _told(texts: tuple[str, ...]) -> "Layout":
    from rtkmesh.attitude.rigid_body import Layout
    from rtkmesh_services.cli.antenna_sources import three

    parts = [text.partition("=") for text in texts]
    if bad := [text for text, (name, dash, _) in zip(texts, parts, strict=True) if not (name and dash)]:
        raise SourceError(f"--antenna {bad[0]}: say NAME=F,R,D")
    return Layout(tuple(name for name, _, _ in parts), np.array([three(f"--antenna {name}:", place) for name, _, place in parts]))


def _preset(text: str) -> "Layout":
    from rtkmesh.attitude.presets import PRESETS, preset

    name, _, size = text.partition(":")
    if name not in PRESETS:
        hint = nearest(name, list(PRESETS)) or f"; there are {', '.join(PRESETS)}"
        raise SourceError(f"--preset {text}: there is no layout {name!r}{hint}")
    try:
        return preset(name, float(size or "1"))
    except ValueError:
        raise SourceError(f"--preset {text}: say NAME:SIZE, the size in metres") from None


def _show(designs: dict[str, tuple["Layout", "Design"]], noise: "Noise", request: Request) -> None:
    from rtkmesh_services.cli.antenna_output import finite
    from rtkmesh_services.cli.plain_table import print_table

    if request.plot is not None:
        from rtkmesh_services.cli.antenna_plots import plot_designs

        plot_designs(designs, noise, request.plot)
    if request.as_json:
        rows = {name: _figures(layout, made) for name, (layout, made) in designs.items()}
        sys.stdout.write(json.dumps(finite(rows), indent=1) + "\n")
        return
    sigmas = [row for name, (_, made) in designs.items() for row in _sigma_rows(name, made)]
    print_table(_SIGMA_HEADS, sigmas, right=_SIGMA_HEADS[3:])
    faults = [(name, at, *map(_mm, astuple(fault))) for name, (_, made) in designs.items() for at, fault in made.detectable.items()]
    sys.stdout.write(f"Smallest faults found with probability {request.power:g} (false alarms {request.false_alarm:g}):\n")
    print_table(_FAULT_HEADS, faults, right=_FAULT_HEADS[2:])
    sys.stdout.write(f"Protection levels while all agree (risk {request.risk:g}, faults of an antenna {request.antenna_fault:g}):\n")
    print_table(_LEVEL_HEADS, [(name, *map(_level, made.levels_rad)) for name, (_, made) in designs.items()], right=_LEVEL_HEADS[1:])
    sys.stdout.write("".join(f"{name}: {text}\n" for name, (_, made) in designs.items() for text in warnings(name, made)))


def _figures(layout: "Layout", made: "Design") -> dict[str, Any]:
    return {"antennas": dict(zip(layout.names, layout.positions_m.tolist(), strict=True)), **asdict(made), "warnings": warnings("", made)}


def _sigma_rows(name: str, made: "Design") -> list[tuple[str, ...]]:
    return [_sigma_cells(name, "-", made.whole), *(_sigma_cells("", at, sigmas) for at, sigmas in made.without.items())]


def _sigma_cells(name: str, without: str, sigmas: "Sigmas") -> tuple[str, ...]:
    angles = [_deg(value) for value in (sigmas.heading_rad, sigmas.pitch_rad, sigmas.roll_rad)]
    return name, without, sigmas.shape.value, *angles, _mm(sigmas.horizontal_m), _mm(sigmas.vertical_m), str(sigmas.redundancy)


def _deg(value_rad: float) -> str:
    return f"{degrees(value_rad):.3f}" if isfinite(value_rad) else "not seen"


def _level(value_rad: float) -> str:
    return "not bounded" if value_rad == np.inf else _deg(value_rad)


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.1f}" if isfinite(value_m) else "none" if value_m == np.inf else "not seen"


def warnings(name: str, made: "Design") -> list[str]:
    """Return what is wrong with a layout, in words."""
    from rtkmesh.attitude.rigid_body import Shape

    whole, full = made.whole, made.whole.shape not in (Shape.LINE, Shape.POINT)
    line, antennas = whole.shape is Shape.LINE, len(made.without)
    blind = [at for at, fault in made.detectable.items() if not isfinite(fault.down_m)]
    bare = [at for at, sigmas in made.without.items() if sigmas.shape in (Shape.LINE, Shape.POINT)]
    left = min((sigmas.redundancy for sigmas in made.without.values()), default=0)
    said = {
        "one antenna, or all in one place: no attitude": whole.shape is Shape.POINT,
        "the antennas are on one line: the turn about it is not seen": line and antennas > 2,
        "two antennas: heading and one tilt; the turn about their line is not seen": line and antennas == 2,
        "two antennas: a fault across their line changes no length and is found by nothing": line and antennas == 2,
        "no redundancy: no fault is found": whole.redundancy < 1,
        f"vertical faults are not found at {', '.join(blind)}: raise one antenna out of the plane, or add one": bool(blind) and full,
        f"without {', '.join(bare)} full attitude is lost": bool(bare) and full,
        "faults are found, but not whose they are": 0 < whole.redundancy <= _FOUND_ONLY,
        "after the loss of one antenna faults are found, but not whose they are": 0 < left <= _FOUND_ONLY < whole.redundancy,
        "74.5 degrees (best-angle) beats the paper's right angle, whose sides share an antenna": name.startswith("right-angle"),
    }
    return [text for text, true in said.items() if true]
