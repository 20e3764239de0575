"""``rtkmesh console``: a shell for one process, on a terminal or for scripts."""

import os
import re
import select
import signal
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import Parameter

from rtkmesh_services.cli.network import DEFAULT_ENDPOINT, EXIT_USAGE, Connect, Json, Namespace, reach
from rtkmesh_services.cli.page import command_page

MAXIMUM_HISTORY: Final = 1000
MAXIMUM_LINE: Final = 4096
_SECRET: Final = re.compile(r"passw|secret|token|://[^ /]*:[^ /]*@", re.IGNORECASE)

_EXAMPLES = """
rtkmesh console
rtkmesh console rtk
rtkmesh console control
rtkmesh console rtk --json < words.txt
"""


def console(
    id: Annotated[str, Parameter(help="The process to speak to; default: the only solver.")] = "",  # noqa: A002  the word of the design
    /,
    *,
    timeout: Annotated[float, Parameter(help="Seconds until the answer counts as missing.")] = 2.0,
    as_json: Json = False,
    connect: Connect = DEFAULT_ENDPOINT,
    namespace: Namespace = "",
) -> int:
    """Speak to a process: its words, RTKRCV's among them, abbreviated where that is clear, completed with Tab, kept from one time to
    the next.

    ``status 2`` shows a screen every two seconds until Enter or Ctrl-C. Nothing asks back. Lines of a pipe or file are done one after
    the other; ``#`` begins a comment, and a screen with a cycle is shown once.

    Exit codes: the highest of all lines: 0 done, 1 failed, 2 wrong usage, 3 not reachable, 4 refused, 124 no answer in time.
    """
    from rtkmesh_services.cli.console_shell import Shell

    with reach(connect, namespace) as bus:
        shell = Shell(bus, id, as_json=as_json, timeout_s=timeout)
        try:
            run_terminal(shell) if sys.stdin.isatty() and not as_json else run_script(shell)
        finally:
            shell.show_events(on=False)
    return shell.worst


def run_script(shell: Any) -> None:
    """Do the lines of the standard input; a first process that cannot be spoken to ends it."""
    shell.begin()
    for line in iter(lambda: sys.stdin.readline(MAXIMUM_LINE), ""):
        if len(line) >= MAXIMUM_LINE:
            shell.fail(EXIT_USAGE, f"a line of more than {MAXIMUM_LINE} characters: nothing of the rest is done")
            return
        shell.obey(line)
        sys.stdout.flush()
        if shell.ended:
            return


def run_terminal(shell: Any) -> None:
    """Prompt for lines until ``exit`` or Ctrl-D; Ctrl-C drops a line or ends a cycle."""
    editor = Editor(shell)
    shell.ansi = sys.stdout.isatty()
    shell.pauses = pauses
    shell.write = shell.complain = editor.write
    shell.begin()
    try:
        while not shell.ended:
            try:
                shell.obey(editor.line())
            except KeyboardInterrupt:
                sys.stdout.write("\n")
            except EOFError:
                sys.stdout.write("\n")
                return
    finally:
        editor.keep()


@contextmanager
def pauses() -> Generator[Callable[[float], bool]]:
    """Give a wait that a typed line or Ctrl-C ends. Ctrl-C leaves a note: an exception in the midst of anything could be lost."""
    reader, writer = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def note(number: int, frame: Any) -> None:  # noqa: ARG001  the form of a handler
        os.write(writer, b"\x03")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield partial(wait_for_end, reader)
    finally:
        signal.signal(signal.SIGINT, before)
        os.close(reader)
        os.close(writer)


def wait_for_end(noted: int, seconds: float) -> bool:
    """Wait; True as soon as a line is typed, or Ctrl-C was noted."""
    ready = select.select([sys.stdin, noted], [], [], seconds)[0]
    if noted in ready:
        sys.stdout.write("\n")
    elif ready:
        os.read(sys.stdin.fileno(), MAXIMUM_LINE)
    return bool(ready)


class Editor:
    """The terminal's line with its history and completion."""

    def __init__(self, shell: Any) -> None:
        import readline

        from rtkmesh_services.runtime.state_files import state_folder

        self._readline, self._shell = readline, shell
        self._file = state_folder() / "console_history"
        self._found: list[str] = []
        self._prompting = False
        readline.set_completer(self._complete)
        readline.set_completer_delims(" ")
        readline.parse_and_bind("tab: complete")
        readline.set_history_length(MAXIMUM_HISTORY)
        try:
            readline.read_history_file(self._file)
        except OSError:
            self._readline.clear_history()  # none yet, or not ours to read

    def line(self) -> str:
        """Return the next line that is typed. Lines with secrets are not kept."""
        self._prompting = True
        try:
            line = input(f"{self._shell.id or 'no process'}> ")
        finally:
            self._prompting = False
        if line.strip() and _SECRET.search(line):
            self._readline.remove_history_item(self._readline.get_current_history_length() - 1)
        return line

    def write(self, text: str) -> None:
        """Write; while a line is being typed, above it."""
        if self._prompting:
            typed = self._readline.get_line_buffer()
            text = f"\r\x1b[K{text}{self._shell.id}> {typed}"
        sys.stdout.write(text)
        sys.stdout.flush()

    def keep(self) -> None:
        """Keep the history, for the owner's eyes; a state folder that cannot be written costs only that."""
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._file.touch(mode=0o600)
            self._readline.write_history_file(self._file)
        except OSError as error:
            sys.stderr.write(f"rtkmesh console: the history is not kept: {error}\n")

    def _complete(self, text: str, state: int) -> str | None:
        """Return the next way to complete the word, as readline asks for it."""
        from rtkmesh_services.cli.console_shell import candidates

        if state == 0:
            self._found = candidates(self._shell, self._readline.get_line_buffer()[: self._readline.get_begidx()] + text, _files)
        return self._found[state] if state < len(self._found) else None


def _files() -> list[str]:
    """Return the files of this folder that may be loaded."""
    return [path.name for path in Path().iterdir() if path.suffix in (".toml", ".conf") and path.is_file()]


app = command_page(console, _EXAMPLES)
