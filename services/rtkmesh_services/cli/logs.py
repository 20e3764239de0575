"""``rtkmesh logs``: what the processes of a detached deployment wrote, also those that are dead."""

import json
import sys
import time
from collections.abc import Callable
from typing import Annotated, Final, Literal

from cyclopts import Parameter

from rtkmesh_services.cli.deployments import Known, find, is_up, known_deployments
from rtkmesh_services.cli.log_lines import Follower, Wanted, log_files, newest
from rtkmesh_services.cli.network import EXIT_OK, EXIT_UNREACHABLE, Json
from rtkmesh_services.cli.page import command_page
from rtkmesh_services.control.output import OutputLine
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.words import clip, nearest

POLL_S: Final = 0.1
_COLOURS: Final = (36, 32, 35, 34, 96, 92, 95, 94)
_LEVEL_COLOURS: Final = {"warning": "\x1b[33m", "error": "\x1b[31m", "critical": "\x1b[31m", "debug": "\x1b[2m"}
_RESET: Final = "\x1b[0m"
Show = Callable[[OutputLine], None]
LevelName = Literal["debug", "info", "warning", "error"]


def logs(
    *ids: Annotated[str, Parameter(name="ID", help="Processes; without any: all, control too.")],
    follow: Annotated[bool, Parameter(name=["--follow", "-f"], negative="", help="Go on with what comes, until Ctrl-C.")] = False,
    lines: Annotated[int, Parameter(name=["--lines", "-n"], help="How many of the newest lines of each process.")] = 50,
    level: Annotated[LevelName, Parameter(help="Only this level and above. What is no log record counts as a warning.")] = "debug",
    of: Annotated[str, Parameter(help="The deployment: its file or its name. Not needed when only one is up.")] = "",
    as_json: Json = False,
) -> int:
    """Show what processes wrote: those of a deployment that runs detached (or with --outlive), also after their death.

    Of each process one to two megabytes are kept. A deployment in the foreground writes to its terminal.

    Exit codes: 0 done, 2 no such deployment or process, 3 nothing is kept on this host.
    """
    known = [known for known in known_deployments() if log_files(known[0].logs)]
    if not known:
        sys.stderr.write("rtkmesh logs: nothing is kept on this host (a deployment in the foreground writes to its terminal)\n")
        return EXIT_UNREACHABLE
    folder, _ = find(of, _likely(known, of))
    files = log_files(folder.logs)
    for id_ in ids:
        if id_ not in files:
            hint = nearest(id_, list(files)) or f"; there are {', '.join(files)}"
            raise ServiceError(f"{folder.folder.name} has no log of {clip(id_)!r}{hint}")
    wanted, show = Wanted(level), _json if as_json else Printer(list(files)).show
    followers = [Follower(id_, file) for id_, file in files.items() if not ids or id_ in ids]
    _show([line for follower in followers for line in newest(follower.begin(), lines, wanted)], show)
    while follow:
        time.sleep(POLL_S)
        _show([line for follower in followers for line in follower.read() if wanted(line)], show)
    return EXIT_OK


class Printer:
    """Lines for people: on a terminal every process has its colour."""

    def __init__(self, ids: list[str]) -> None:
        self._colours = {id_: f"\x1b[{_COLOURS[i % len(_COLOURS)]}m" for i, id_ in enumerate(ids)} if sys.stdout.isatty() else {}
        self._width = max(map(len, ids), default=0)

    def show(self, line: OutputLine) -> None:
        """Print a line."""
        id_, text = f"{line.id:<{self._width}}", f"{line.level or '-':<8} {line.text}"
        if self._colours:
            id_ = f"{self._colours.get(line.id, '')}{id_}{_RESET}"
            text = f"{_LEVEL_COLOURS.get(line.level, '')}{text}{_RESET}"
        sys.stdout.write(f"{line.time.replace('T', ' ')} {id_} {text}\n")


def _json(line: OutputLine) -> None:
    row = {"time": line.time, "id": line.id, "level": line.level, "text": line.text}
    sys.stdout.write(json.dumps(row, ensure_ascii=False) + "\n")


def _show(lines: list[OutputLine], show: Show) -> None:
    for line in sorted(lines, key=lambda line: line.time):
        show(line)
    if lines:
        sys.stdout.flush()


def _likely(known: list[Known], of: str) -> list[Known]:
    """Return those that may be meant: without a name the ones that are up, if any is."""
    up = [one for one in known if is_up(one)]
    return up if up and not of else known


app = command_page(
    logs,
    """
    rtkmesh logs
    rtkmesh logs rover rtk -f
    rtkmesh logs -n 200 --level warning --of robot
    """,
)
