"""``rtkmesh solve``: recordings in, RTKLIB's .pos format out. The engine is imported when the command runs, not for its help."""

import gc
import sys
import tomllib
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import degrees, isfinite, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO, cast

import msgspec
from cyclopts import Parameter

from rtkmesh import __version__
from rtkmesh_schemas.config import ModeName, SolverTable
from rtkmesh_schemas.errors import ConfigError
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.errors import SourceError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rtkmesh.rtk.solution import Solution
    from rtkmesh_services.cli.offline import Run
    from rtkmesh_services.cli.solve_conf import ConfOptions
    from rtkmesh_services.output.text_feed import Writer

Position = tuple[float, float, float]
FormName = Literal["llh", "xyz", "enu", "vel_enu", "json"]
AmbiguityName = Literal["off", "instantaneous", "continuous", "fix-and-hold"]

_SOLVED, _UNSOLVED = 0, 1
# key of the solver table -> flag and what it allows (cyclopts checks --mode itself)
_FLAGS_OF_KEYS = {
    "systems": ("systems", "the letters GRECJSI"),
    "frequencies": ("frequencies", "1 to 5"),
    "elevation_mask_deg": ("elmask", "0 to 90 degrees"),
}


# what forms other than llh and xyz have of velocities
_VELOCITY_OF = {"enu": "has none, as RTKLIB's", "vel_enu": "is the velocity", "json": "has it anyway"}

_EXAMPLES = """
rtkmesh solve --rover rover.obs --base base.obs --nav base.nav --out rover.pos
rtkmesh solve --rover rover.ubx --base base.ubx --base-llh 52.1,4.4,43.2
rtkmesh solve --rover rover.rtcm3 --base base.rtcm3 --date 2018-07-14 --json
rtkmesh solve --mode moving-base --rover front.ubx --base rear.ubx --format enu
rtkmesh solve --direction combined --rover rover.ubx --base base.ubx --out rover.pos
rtkmesh solve --rover rover.ubx --base base.ubx --format json --quiet
rtkmesh solve --mode single --rover rover.ubx.gz
rtkmesh solve --conf rnx2rtkp.conf --rover rover.obs --base base.obs --nav base.nav
"""


@dataclass(frozen=True, kw_only=True)
class Request:
    """The options of ``rtkmesh solve``."""

    rover: Annotated[Path, Parameter(help="Recording of the receiver to be positioned.")]
    base: Annotated[Path | None, Parameter(help="Recording of the reference receiver; not needed in mode single.")] = None
    nav: Annotated[
        tuple[Path, ...], Parameter(negative="", show_default=False, help="Further recording with navigation data; may be repeated.")
    ] = ()
    mode: Annotated[ModeName | None, Parameter(help="What moves. Default: kinematic.")] = None
    direction: Annotated[
        Literal["forward", "backward", "combined"] | None,
        Parameter(
            help="Which way through the recordings (RTKLIB's pos1-soltype). Combined: forward, then backward, and of each epoch what both "
            "know of it; a fix that one direction contradicts is not kept unless the evidence is for it. Default: forward."
        ),
    ] = None
    causal: Annotated[
        bool,
        Parameter(
            negative="",
            show_default=False,
            help="Know nothing before the recordings tell it, as on the spot: the same solutions as a replay. Without it ephemerides and "
            "base position of the first two minutes count from the first epoch on, and base epochs are interpolated.",
        ),
    ] = False
    frequencies: Annotated[int | None, Parameter(help="Carrier bands used per satellite, 1 to 5. Default: 2.")] = None
    systems: Annotated[
        str | None,
        Parameter(help="Systems used, as RINEX letters: G GPS, R GLONASS, E Galileo, C BeiDou, J QZSS, I NavIC. Default: GREJC."),
    ] = None
    ambiguity: Annotated[
        AmbiguityName | None,
        Parameter(
            help="Integer ambiguities: none, of each epoch alone, kept as long as they last, or also told to the filter when they have "
            "proven themselves. Default: continuous."
        ),
    ] = None
    elmask: Annotated[float | None, Parameter(help="Elevation mask in degrees. Default: 15.")] = None
    base_ecef: Annotated[
        str | None,
        Parameter(
            allow_leading_hyphen=True,
            help="Position of the base antenna as X,Y,Z in metres. Default: what its recording says (RTCM 1005/1006 or the RINEX header).",
        ),
    ] = None
    base_llh: Annotated[
        str | None, Parameter(allow_leading_hyphen=True, help="The same as LAT,LON,H in degrees and metres above the ellipsoid.")
    ] = None
    interpolation: Annotated[
        bool | None,
        Parameter(
            show_default=False,
            help="Where no base epoch is of the rover's time, interpolate those on both sides of it (RTKLIB's misc-timeinterp), so that a "
            "base every 5 to 30 s serves a faster rover. --no-interpolation: use the last one with its age. Default: on without --causal.",
        ),
    ] = None
    date: Annotated[
        str | None,
        Parameter(help="Day on which RTCM 3 logs begin, YYYY-MM-DD: they carry no date. Not needed beside a dated recording."),
    ] = None
    receiver_options: Annotated[
        str,
        Parameter(
            allow_leading_hyphen=True,
            help='RTKLIB\'s receiver options for the logs of rover and base: "-TADJ=0.1 -GL2L".',
        ),
    ] = ""
    config: Annotated[
        Path | None, Parameter(help=r"TOML file with one solver: \[solver], or a deployment's one \[solver.NAME]; flags overrule it.")
    ] = None
    conf: Annotated[
        Path | None,
        Parameter(help="RTKLIB's .conf file, of either dialect, instead of --config: what rnx2rtkp would do with -k. Flags overrule it."),
    ] = None
    out: Annotated[Path | None, Parameter(help="The .pos file. Default: standard output.")] = None
    form: Annotated[
        FormName | None,
        Parameter(
            name="--format",
            help="Geodetic coordinates, ECEF, the baseline east-north-up, the velocity east-north-up, or a line of JSON with all that is "
            "known of an epoch: velocity and acceleration with full covariances, grade, probability, protection levels. Default: llh.",
        ),
    ] = None
    velocity: Annotated[
        bool | None, Parameter(negative="", show_default=False, help="Columns of velocity and its deviations behind those of llh and xyz.")
    ] = None
    time_form: Annotated[
        Literal["calendar", "tow"] | None, Parameter(help="Date and time of day, or GPS week and seconds of week. Default: calendar.")
    ] = None
    as_json: Annotated[
        bool,
        Parameter(
            name="--json",
            negative="",
            show_default=False,
            help="Summary as JSON on standard output; the .pos is then only written with --out.",
        ),
    ] = False
    quiet: Annotated[bool, Parameter(negative="", show_default=False, help="No progress bar and no summary.")] = False


def solve(request: Annotated[Request, Parameter(name="*")]) -> int:
    """Solve recordings offline, with the engine of the running system, and write RTKLIB's .pos format.

    Recordings are RINEX 2 and 3 (also Hatanaka), logs of UBX, SBF, Unicore, NovAtel and RTCM 3, or logs that mix these, plain or
    compressed; the kind is found from the content. Logs bring their own navigation data. The defaults need no tuning.

    Exit codes: 0 solved, 1 not one epoch could be solved, 2 wrong usage or a file that cannot be read.
    """
    if request.velocity and request.form not in (None, "llh", "xyz"):
        raise SourceError(f"--velocity: columns of llh and xyz; --format {request.form} {_VELOCITY_OF[request.form]}")
    told = _conf_of(request)
    request = _completed(request, told)
    table, folder = _solver_table(request, told)
    if request.base is None and table.mode != "single":
        raise SourceError(f"mode '{table.mode}' needs --base (or say --mode single)")
    if table.mode == "single" and request.direction != "forward":
        raise SourceError(f"--direction {request.direction}: mode 'single' has no memory, all directions are the same")
    if table.mode == "single" and request.form in ("enu", "vel_enu"):
        raise SourceError(f"--format {request.form} is in the horizon of the base, and mode 'single' has none")
    if table.mode == "fixed" and table.fixed_position_ecef_m is None:
        where = "fixed_position_ecef_m in the [solver] table of a --config file, or ant1-pos1 of a --conf file"
        raise SourceError(f"mode 'fixed' needs the rover's position: {where}")
    position = _base_position(request) or (told.base_ecef_m if told else None)

    run = _begun(request, table, folder, position)
    from rtkmesh_services.cli.solve_display import ProgressBar, report

    try:
        with _output(request) as output, ProgressBar(run, shown=not request.quiet and sys.stderr.isatty()):
            _write(run, run.solutions(), request, output)
            if output is not None:
                output.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise SourceError(f"{request.out or 'standard output'}: {error.strerror}") from error
    report(run, as_json=request.as_json, quiet=request.quiet)
    return _SOLVED if run.tally.solved else _UNSOLVED


def _begun(request: Request, table: SolverTable, folder: Path, base_ecef_m: Position | None) -> "Run":
    """Return the run over the opened recordings. What is loaded for it stays: it is not looked through, neither now nor later."""
    gc.disable()
    try:
        return _run_of(request, table, folder, base_ecef_m)
    finally:
        gc.freeze()
        gc.enable()


def _run_of(request: Request, table: SolverTable, folder: Path, base_ecef_m: Position | None) -> "Run":
    from rtkmesh.errors import OptionError
    from rtkmesh_services.cli.offline import Run, SolutionType, open_inputs
    from rtkmesh_services.cli.recordings import day_of
    from rtkmesh_services.mapping.options import session_options

    date = day_of(request.date) if request.date else None
    inputs = open_inputs(request.rover, None if table.mode == "single" else request.base, request.nav, date, request.receiver_options)
    try:
        options = session_options(table, replay=True, base_position_ecef_m=base_ecef_m, folder=folder)
    except OptionError as error:
        raise SourceError(f"{file}: {error}" if (file := request.config or request.conf) else str(error)) from error
    return Run(inputs, options, SolutionType(request.direction or "forward"), causal=request.causal)


def _conf_of(request: Request) -> "ConfOptions | None":
    if request.conf is None:
        return None
    if request.config is not None:
        raise SourceError("--config and --conf are both given")
    from rtkmesh_services.cli.solve_conf import conf_options

    return conf_options(request.conf, quiet=request.quiet)


def _completed(request: Request, told: "ConfOptions | None") -> Request:
    """Return the request with what no flag says: from the .conf file, or the defaults."""
    return replace(
        request,
        direction=request.direction or (told.direction if told else "forward"),
        form=request.form or (told.form if told else "llh"),
        velocity=request.velocity if request.velocity is not None else (told.velocity if told else False),
        time_form=request.time_form or (told.time_form if told else "calendar"),
    )


def _solver_table(request: Request, told: "ConfOptions | None") -> tuple[SolverTable, Path]:
    """Return the solver's table, the configuration file's or the defaults, overruled by the flags; and the folder of its files."""
    flags = {
        "mode": request.mode,
        "systems": request.systems,
        "frequencies": request.frequencies,
        "elevation_mask_deg": request.elmask,
    }
    table, folder = (told.solver, told.folder) if told else (SolverTable(rover="rover"), Path())
    table, folder = _configured(request.config) if request.config else (table, folder)
    content = msgspec.to_builtins(table) | {name: value for name, value in flags.items() if value is not None}
    content["ambiguity"] |= {"mode": request.ambiguity} if request.ambiguity is not None else {}
    content["sync"]["interpolate"] = _interpolates(request, table)
    content |= {"rover": "rover", "base": "base", "navigation": [f"nav{k}" for k in range(len(request.nav))]}
    try:
        return msgspec.convert(content, SolverTable), folder
    except msgspec.ValidationError as error:
        key = str(error).rpartition("`$.")[2].rstrip("`")
        flag, allowed = _FLAGS_OF_KEYS[key]
        raise SourceError(f"--{flag} {flags[key]}: allowed are {allowed}") from error


def _interpolates(request: Request, table: SolverTable) -> bool:
    """Return whether base epochs are interpolated: as a flag says, or the file; else where it may be known what comes."""
    said = table.sync.interpolate if request.interpolation is None else request.interpolation
    return not request.causal if said is None else said


def _configured(path: Path) -> tuple[SolverTable, Path]:
    """Return the one solver of a solver file ([solver]) or of a deployment file ([solver.NAME]), and the folder of its files.

    ConfigError names all faults.
    """
    from rtkmesh_services.runtime.configuration import load_deployment, load_solver_table

    if not path.is_file():
        raise ConfigError(str(path), None, "no such file")
    path = path.resolve()
    if not _has_named_solvers(path):
        return load_solver_table(path.name, path.parent), path.parent
    deployment = load_deployment(path)
    tables = deployment.solver
    if len(tables) != 1:
        raise ConfigError(str(path), None, f"has {len(tables)} solvers ({', '.join(tables)}); a file with one is needed here")
    return next(iter(tables.values())), path.parent / deployment.deployment.config_folder


def _has_named_solvers(path: Path) -> bool:
    try:
        solvers = tomllib.loads(path.read_text()).get("solver")
    except (OSError, ValueError):  # the loaders say it better
        return False
    return isinstance(solvers, dict) and all(isinstance(value, dict) for value in cast("dict[str, Any]", solvers).values())


def _base_position(request: Request) -> Position | None:
    """Return the given base position in ECEF metres, or None."""
    if request.base_ecef is not None and request.base_llh is not None:
        raise SourceError("--base-ecef and --base-llh are both given")
    if request.base_ecef is not None:
        position = _three_numbers("--base-ecef", request.base_ecef)
        radius_m = sum(value * value for value in position) ** 0.5
        if not 6.2e6 < radius_m < 7.5e6:
            raise SourceError(f"--base-ecef={request.base_ecef} is {radius_m / 1e3:.0f} km from the earth's centre")
        return position
    if request.base_llh is None:
        return None
    latitude_deg, longitude_deg, height_m = _three_numbers("--base-llh", request.base_llh)
    if not (-90.0 <= latitude_deg <= 90.0 and -360.0 <= longitude_deg <= 360.0 and -12e3 <= height_m <= 1e6):
        raise SourceError(f"--base-llh={request.base_llh} is no latitude, longitude (degrees) and height (metres)")
    from rtkmesh.gnss.frames import ecef_from_geodetic

    x, y, z = ecef_from_geodetic(radians(latitude_deg), radians(longitude_deg), height_m).tolist()
    return x, y, z


def _three_numbers(flag: str, text: str) -> Position:
    try:
        a, b, c = (float(part) for part in text.split(","))
    except ValueError:
        raise SourceError(f"{flag}={text} is not three numbers with commas between") from None
    return a, b, c


def _output(request: Request) -> AbstractContextManager[TextIO | None]:
    """Return the open output, or None where only a summary is wanted."""
    if request.out is None:
        return nullcontext(None if request.as_json else sys.stdout)
    try:
        return request.out.open("w", encoding="ascii")
    except OSError as error:
        raise SourceError(f"{request.out}: {error.strerror}") from error


def _write(run: "Run", results: "Iterator[Solution]", request: Request, output: TextIO | None) -> None:
    """Write the header before the first solution, then a line per solution as it comes."""
    from rtkmesh_services.mapping.solution import position_message, solution_message
    from rtkmesh_services.texts import TextAbout

    writer, headed, mode = _writer(request), False, run.options.rtk.mode.value
    for sequence, solution in enumerate(results):
        if output is None:
            continue
        if not headed:
            output.write(writer.header(TextAbout(f"rtkmesh {__version__}", _notes(run, solution))).decode())
            headed = True
        if request.form == "json":
            message = solution_message(solution, source="", start_id="", sequence=sequence, mode=mode)
        else:
            message = position_message(solution)
        output.write(writer.epoch(message).decode())


def _writer(request: Request) -> "Writer":
    from rtkmesh_services.output.text_feed import JsonWriter
    from rtkmesh_services.texts import TextOptions, TextWriter

    if request.form == "json":
        return JsonWriter()
    time_form = "tow" if request.time_form == "tow" else "hms"
    return TextWriter(TextOptions(format=request.form or "llh", time_form=time_form, velocity=bool(request.velocity), line_end="lf"))


def _notes(run: "Run", first: "Solution") -> list[tuple[str, str]]:
    """Return the notes of the .pos header, in RTKLIB's words."""
    from rtkmesh_services.texts.header import position_note, time_note

    options = run.options.rtk
    notes = [("inp file", str(recording.path)) for recording in run.inputs.all()]
    notes += [
        ("obs start", time_note(first.time.week, first.time.tow_s)),
        ("pos mode", options.mode.value),
        ("freqs", str(options.frequencies)),
        *([] if options.mode.value == "single" else [("solution", run.kind.value)]),
        ("elev mask", f"{degrees(options.elevation_mask_rad):.1f} deg"),
        ("navi sys", options.systems),
        ("amb res", options.ambiguity.mode.value),
        ("val thres", f"{options.ambiguity.ratio:.1f}"),
    ]
    notes += [(f"{end} ant", name) for end, name in run.session.antennas.items() if name]
    base = first.base_ecef_m.tolist()
    return [*notes, ("ref pos", position_note(base))] if all(map(isfinite, base)) else notes


app = command_page(solve, _EXAMPLES)
