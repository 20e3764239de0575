"""The command ``rtkmesh``: a table of subcommands, each imported when it is used.

Exit codes of every subcommand: 0 done, 1 not done (no solution, no answer), 2 wrong usage or input, 3 no network or process
reached, 4 refused, 124 no answer in time, 130 interrupted.
"""

import gc
import os
import sys
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from typing import Final, NoReturn

from cyclopts import App, CycloptsError

from rtkmesh import __version__
from rtkmesh_services.runtime.kernel_cache import use_kernel_cache

EXIT_DONE, EXIT_NOT_DONE, EXIT_USAGE, EXIT_UNREACHABLE, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

# name -> (where, one line of help)
COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "solve": ("rtkmesh_services.cli.solve:app", "Solve recordings offline, of any format that is read, and write RTKLIB's .pos format."),
    "convert": ("rtkmesh_services.cli.convert:app", "Convert recordings to RINEX, RTCM 3, JSON or CSV."),
    "demo": ("rtkmesh_services.cli.demo:app", "Run everything on simulated receivers, with the truth beside it."),
    "up": ("rtkmesh_services.cli.up:app", "Run all processes of a deployment file."),
    "down": ("rtkmesh_services.cli.down:app", "End a deployment of this host."),
    "ps": ("rtkmesh_services.cli.ps:app", "Show the deployments of this host and their processes."),
    "logs": ("rtkmesh_services.cli.logs:app", "Show what processes wrote, also those that are dead."),
    "run": ("rtkmesh_services.cli.run:app", "Run one process of a deployment in the foreground."),
    "cmd": ("rtkmesh_services.cli.cmd:app", "Ask a process to do something: start, stop, restart, load FILE, status, shutdown, help."),
    "console": ("rtkmesh_services.cli.console:app", "Speak to a process: a shell with RTKRCV's words, completion, history and cycles."),
    "status": ("rtkmesh_services.cli.status:app", "Show the state of all processes of a running network."),
    "top": ("rtkmesh_services.cli.top:app", "Watch a running network: positions, headings, processes."),
    "echo": ("rtkmesh_services.cli.echo:app", "Print messages as they come."),
    "check": ("rtkmesh_services.cli.check:app", "Check a deployment file: every fault with line, key and nearest name."),
    "conf": ("rtkmesh_services.cli.conf:app", "Import, export, show and compare configurations, RTKLIB's .conf files among them."),
    "receiver": ("rtkmesh_services.cli.receiver:app", "Set up a receiver by a recipe, and read back what it says."),
    "ports": ("rtkmesh_services.cli.ports:app", "Show the serial ports, and who is behind them."),
    "antennas": ("rtkmesh_services.cli.antennas:app", "Calibrate the antennas of a vehicle, and design a layout of them."),
    "base": ("rtkmesh_services.cli.base:app", "Show, save and forget the positions of base stations of this host."),
    "preset": ("rtkmesh_services.cli.preset:app", "List, select, make and score the base stations of a running network."),
    "ntrip": ("rtkmesh_services.cli.ntrip:app", "Ask a caster: which mount points it has, and which is nearest."),
    "recover": ("rtkmesh_services.cli.recover:app", "Repair raw logs after a crash or a power cut; the originals stay."),
    "warm": ("rtkmesh_services.cli.warm:app", "Compile the engine's kernels into the cache."),
    "keys": ("rtkmesh_services.cli.show:keys_app", "Print the table of keys."),
    "schema": ("rtkmesh_services.cli.show:schema_app", "Print the JSON Schema of a message or of the deployment file."),
}


def application(name: str) -> App:
    """Return the command line with the subcommand ``name`` imported, or, for ``--help``, with the table of all of them."""
    app = App(
        name="rtkmesh",
        help="GNSS positioning for robots: raw signals of antennas to centimetre positions and attitudes.",
        version=__version__,
    )
    if name in COMMANDS:
        module, _, attribute = COMMANDS[name][0].partition(":")
        app.command(getattr(import_module(module), attribute), name=name)
        return app
    for command, (where, text) in COMMANDS.items():
        app.command(where, name=command, help=text)
    return app


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code."""
    from rtkmesh.errors import RtkmeshError
    from rtkmesh_schemas.errors import SchemaError
    from rtkmesh_services.errors import ServiceError, UnreachableError

    name = arguments[0] if arguments else "--help"
    if not name.startswith("-") and name not in COMMANDS:
        return _unknown(name)
    try:
        app = application(name)
        gc.enable()
        result = app(arguments, exit_on_error=False, result_action="return_value")
        if sys.stdout:  # None where it was closed before we began
            sys.stdout.flush()
    except CycloptsError:  # printed by cyclopts
        return EXIT_USAGE
    except (RtkmeshError, SchemaError, ServiceError) as error:
        sys.stderr.write(f"rtkmesh: {error}\n")
        return EXIT_UNREACHABLE if isinstance(error, UnreachableError) else EXIT_USAGE
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_NOT_DONE
    return result if isinstance(result, int) else EXIT_DONE


def main() -> None:
    """Run the command line and end the process with its exit code."""
    gc.disable()  # until the command is imported: there is nothing to collect yet
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: threads only cost time and memory
    use_kernel_cache()
    code = run(sys.argv[1:])
    if sys.argv[1:2] == ["solve"]:  # which has closed all that it opened
        _leave(code)
    sys.exit(code)


def _leave(code: int) -> NoReturn:
    """End the process at once: the interpreter's farewell takes as long as solving a hundred epochs."""
    with suppress(OSError, ValueError):  # what was printed before an error; nobody reads it any more, or it was closed
        if sys.stdout:
            sys.stdout.flush()
    os._exit(code)


def _unknown(name: str) -> int:
    near = get_close_matches(name, COMMANDS, 1)
    hint = f"; did you mean '{near[0]}'?" if near else ""
    sys.stderr.write(f"rtkmesh: there is no command '{name}'{hint} (commands: {', '.join(COMMANDS)})\n")
    return EXIT_USAGE


if __name__ == "__main__":
    main()
