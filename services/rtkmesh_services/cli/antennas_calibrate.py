"""``rtkmesh antennas calibrate``: where the antennas of a vehicle are, from what they measured."""

import sys
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, Connect, Json, Namespace, reach
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from rtkmesh.attitude.calibration import Calibration
    from rtkmesh_services.cli.antenna_sources import Series

EXAMPLES = """
rtkmesh antennas calibrate bow=bow.pos port=port.pos starboard=starboard.pos --out layout.toml --plot layout.png
rtkmesh antennas calibrate rear-front=heading.pos --json
rtkmesh antennas calibrate --rover rear=rear.ubx --rover front=front.ubx --rover mast=mast.ubx --azimuth 180 --level
rtkmesh antennas calibrate --live rear-front=heading_rtk --live rear-mast=roll_rtk --seconds 600
"""


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of ``rtkmesh antennas calibrate``."""

    rover: Annotated[
        tuple[str, ...],
        Parameter(negative="", show_default=False, help="NAME=FILE, a recording; repeated. Solved from the first to each other."),
    ] = ()
    nav: Annotated[
        tuple[Path, ...], Parameter(negative="", show_default=False, help="Further recording with navigation data; may be repeated.")
    ] = ()
    date: Annotated[str, Parameter(help="Day of RTCM 3 recordings, YYYY-MM-DD.")] = ""
    frequencies: Annotated[int, Parameter(help="Bands used of recordings, 1 to 5.")] = 2
    live: Annotated[
        tuple[str, ...],
        Parameter(negative="", show_default=False, help="NAME=SOLVER or FROM-TO=SOLVER, a running solver; may be repeated."),
    ] = ()
    seconds: Annotated[float, Parameter(help="How long to listen to running solvers.")] = 300.0
    floats: Annotated[bool, Parameter(negative="", help="Use floats too, not only fixes.")] = False
    origin: Annotated[Literal["first", "centroid"], Parameter(help="Where the layout's zero is.")] = "first"
    offset: Annotated[str, Parameter(help="F,R,D: the origin's place in the vehicle, metres forward, right, down.")] = "0,0,0"
    azimuth: Annotated[float, Parameter(help="Direction from the first to the second antenna in the vehicle, degrees clockwise.")] = 0.0
    level: Annotated[bool, Parameter(negative="", help="The vehicle's mean pitch and roll while measuring were zero.")] = False
    name: Annotated[str, Parameter(help="The attitude process that the layout is for.")] = "attitude"
    out: Annotated[Path | None, Parameter(help="Write the layout as TOML.")] = None
    plot: Annotated[Path | None, Parameter(help="Write a picture (PNG, PDF, SVG by its name).")] = None
    force: Annotated[bool, Parameter(negative="", help="Replace files that are there.")] = False
    connect: Connect = DEFAULT_ENDPOINT
    namespace: Namespace = ""
    as_json: Json = False
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="No progress.")] = False


def calibrate(
    *files: Annotated[str, Parameter(help="NAME=FILE.pos (positions of an antenna) or FROM-TO=FILE.pos (baselines, enu).")],
    request: Annotated[Request, Parameter(name="*")] = Request(),
) -> int:
    """Find where the antennas of a vehicle are, standing or moving, from solutions, from recordings, or from a running network.

    Solutions are .pos files, ours or RTKLIB's. Wrong fixes are screened by distances and by chi-square. Axes: forward is from
    the first to the second antenna, down is normal to the plane of the first three; --azimuth, --level and --offset turn and move that
    into the vehicle's.

    Exit codes: 0 done, 2 wrong usage, a file that cannot be read, or measurements that tell no layout, 3 no network.
    """
    from rtkmesh.attitude.calibration import calibrate as calibrated
    from rtkmesh_services.cli.antenna_output import written
    from rtkmesh_services.cli.antenna_sources import instants_of, names_of, three, warn
    from rtkmesh_services.cli.written_files import check_free

    offset = three("--offset", request.offset)
    check_free([path for path in (request.out, request.plot) if path is not None], [], force=request.force)
    series = _series(files, request)
    warn(series)
    names = names_of(series)
    if len(names) < 2:
        raise SourceError(f"antennas named: {', '.join(names) or 'none'}; two or more are needed (rtkmesh antennas calibrate --help)")
    with _working(request):
        found = calibrated(names, instants_of(series, names), centred=request.origin == "centroid")
    found = found.mounted(_mounting(found, request)).shifted(offset)
    written(found, request)
    return 0


def _series(files: tuple[str, ...], request: Request) -> list["Series"]:
    """Return what is to be used: files, recordings and running solvers may be mixed."""
    from rtkmesh_services.cli.antenna_sources import Solving, from_network, from_pos, from_recordings, named

    found = [from_pos(named(text), floats=request.floats) for text in files]
    if request.rover:
        shown = not request.quiet and sys.stderr.isatty()
        solving = Solving(nav=request.nav, date=request.date, frequencies=request.frequencies, floats=request.floats, shown=shown)
        found += from_recordings([named(text, "--rover") for text in request.rover], solving)
    if request.live:
        with reach(request.connect, request.namespace) as bus, _working(request):
            found += from_network(bus, [named(text, "--live") for text in request.live], request.seconds, floats=request.floats)
    return found


def _mounting(found: "Calibration", request: Request) -> Any:
    """Return the rotation from the antennas' axes to the vehicle's."""
    from rtkmesh.attitude.rotation import rotation_of_angles

    tilt = (found.mean_pitch_rad, found.mean_roll_rad) if request.level else (0.0, 0.0)
    return rotation_of_angles(radians(request.azimuth), *tilt)


def _working(request: Request) -> AbstractContextManager[Any]:
    """Return a sign of life on a terminal."""
    from rich.console import Console

    shown = not request.quiet and sys.stderr.isatty()
    return Console(stderr=True).status("listening" if request.live else "adjusting") if shown else nullcontext()
