"""What the console does with a line: words of the process that it speaks to, and a few of its own. No terminal in here.

Own words: use, processes, events, help, exit. Everything else goes to the process, whose ``help`` says what it can do.
"""

import shlex
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, Final

from rtkmesh_schemas.command import Reply
from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.keys import EVENT, Role
from rtkmesh_schemas.status import Event
from rtkmesh_schemas.wire import decode, encode_json
from rtkmesh_services.cli.cmd import show_reply
from rtkmesh_services.cli.network import EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE, exit_code
from rtkmesh_services.runtime.bus import Bus, Handle, Sample
from rtkmesh_services.runtime.calls import call
from rtkmesh_services.runtime.console_words import IN_FULL, Typed, WordError, match_word, typed_line
from rtkmesh_services.runtime.logs import clean
from rtkmesh_services.runtime.words import nearest

OWN_WORDS: Final[Mapping[str, str]] = {
    "use": "ID: speak to another process",
    "processes": "who is on the network",
    "events": "on|off: show what happens to the process as it happens",
    "help": "[WORD]: what can be said",
    "exit": "end the console (also Ctrl-D)",
}
CLEAR: Final = "\x1b[H\x1b[2J"


Wait = Callable[[float], bool]


@contextmanager
def one_screen() -> Generator[Wait]:
    """End a cycle after its first screen: a script has nobody who could end it."""
    yield lambda _: True


@dataclass(slots=True)
class Shell:
    """A console without its terminal. ``pauses`` gives what sleeps within a cycle and returns True when it is to end; ``worst`` is the exit
    code.
    """

    bus: Bus
    id: str = ""
    as_json: bool = False
    ansi: bool = False
    timeout_s: float = 2.0
    pauses: Callable[[], AbstractContextManager[Wait]] = one_screen
    write: Callable[[str], Any] = sys.stdout.write
    complain: Callable[[str], Any] = sys.stderr.write
    ended: bool = False
    worst: int = EXIT_OK
    _operations: dict[str, str] = field(default_factory=dict[str, str])
    _options: list[str] | None = None
    _events: Handle | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self) -> None:
        """Speak to the process that was named, or to the only solver; say which there are when that is not clear."""
        if self.id:
            self.use(self.id)
            return
        solvers = self.ids(Role.SOLVER)
        if len(solvers) == 1:
            self.use(solvers[0])
        elif solvers:
            self.fail(EXIT_USAGE, f"there are several solvers: say use ID, one of {', '.join(solvers)}")
        else:
            self.fail(EXIT_UNREACHABLE, f"no solver is on the network; there are {', '.join(self.ids()) or 'none'}: say use ID")

    def use(self, id_: str) -> None:
        """Speak to a process; one that does not answer is told, and spoken to all the same: it may come."""
        with_events = self._events is not None
        self.show_events(on=False)
        self.id, self._options = id_, None
        self.learn()
        if with_events:
            self.show_events(on=True)

    def learn(self) -> None:
        """Ask the process what it can do."""
        reply = self.ask("help")
        found = reply.data.get("operations")
        self._operations = {str(name): str(text) for name, text in found.items()} if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]  any plain data
        if not reply.ok:
            self.fail(exit_code([reply]), reply.message)

    def obey(self, line: str) -> None:
        """Do what a line says; whatever is wrong with it is told."""
        if not line.strip() or line.lstrip().startswith("#"):
            return
        if line.lstrip().startswith("!"):
            self.fail(EXIT_USAGE, "no shell commands here")
            return
        try:
            typed = self._understood(shlex.split(line))
        except (WordError, ValueError) as error:
            self.fail(EXIT_USAGE, f"{error}")
            return
        self._do(typed)

    def words(self) -> list[str]:
        """Return what may stand first in a line."""
        return sorted({*OWN_WORDS, *self._operations})

    def ids(self, role: Role | None = None) -> list[str]:
        """Return who is on the network."""
        return sorted(id_ for id_, is_a in self.bus.live(timeout_s=1.0).items() if role is None or is_a == role)

    def option_names(self) -> list[str]:
        """Return the names of the process's options: those of its ``option``, else of its table."""
        if self._options is None:
            reply = self.ask("option") if "option" in self._operations else self.ask("config")
            data: dict[str, Any] = reply.data if reply.ok else {}
            table = data.get("options", data.get("table", data))
            self._options = sorted(_names(table, ""))
        return self._options

    def ask(self, op: str, args: dict[str, Any] | None = None) -> Reply:
        """Ask the process; never raises for one that is not there."""
        return call(self.bus, self.id, op, args, self.timeout_s)[0]

    def fail(self, code: int, text: str) -> None:
        """Say what is wrong, and keep it for the exit code."""
        self.worst = max(self.worst, code)
        self.complain(f"{clean(text)}\n")

    def show_events(self, *, on: bool) -> None:
        """Begin or end to show the events of the process."""
        if self._events is not None:
            self._events.close()
            self._events = None
        if on:
            self._events = self.bus.subscribe(EVENT.key(self.id, level="*"), self._event)

    def _understood(self, words: list[str]) -> Typed:
        if self.id and not match_word(words[0], [*self.words(), "?", *IN_FULL]):
            self.learn()  # it may have come only now, or be another version
        try:
            return typed_line(words, self.words())
        except WordError as error:
            hint = "" if match_word(words[0], self.words()) else nearest(words[0], self.words())
            raise WordError(f"{error}{hint}") from None

    def _do(self, typed: Typed) -> None:
        own: dict[str, Callable[[list[str]], None]] = {
            "use": self._use,
            "processes": self._processes,
            "events": self._switch_events,
            "help": self._help,
            "exit": self._exit,
        }
        if typed.op in own:
            own[typed.op]([str(value) for value in typed.args.values()])
        elif not self.id:
            self.fail(EXIT_USAGE, f"say use ID first, one of {', '.join(self.ids()) or 'none'}")
        elif typed.cycle_s:
            self._cycle(typed)
        else:
            self._show(self.ask(typed.op, typed.args))

    def _cycle(self, typed: Typed) -> None:
        """Show a screen again and again; Ctrl-C ends this and not the console."""
        with self.pauses() as wait:
            while True:
                reply = self.ask(typed.op, typed.args)
                if self.ansi:
                    self.write(CLEAR)
                self._show(reply)
                if not reply.ok or wait(typed.cycle_s):
                    return

    def _show(self, reply: Reply) -> None:
        self.worst = max(self.worst, exit_code([reply]))
        with self._lock:
            if self.as_json:
                self.write(f"{encode_json(reply).decode()}\n")
            elif reply.text:
                self.write("".join(f"{clean(line)}\n" for line in reply.text.removesuffix("\n").split("\n")))
            else:
                show_reply(reply, self.write if reply.ok else self.complain)

    def _event(self, sample: Sample) -> None:
        try:
            event = decode(Event, sample.payload, sample.encoding)
        except SchemaError:
            return
        with self._lock:
            if self.as_json:
                self.write(f"{encode_json(event).decode()}\n")
            else:
                self.write(f"[{event.level.value}] {event.id} {event.code}: {clean(event.text)}\n")

    def _use(self, given: list[str]) -> None:
        if len(given) == 1 and given[0] != "*":
            try:
                self.use(given[0])
            except SchemaError as error:
                self.fail(EXIT_USAGE, str(error))
        else:
            self.fail(EXIT_USAGE, f"use ID, one of {', '.join(self.ids()) or 'none'}")

    def _processes(self, given: list[str]) -> None:  # noqa: ARG002  own words share one form
        live = self.bus.live(timeout_s=1.0)
        if self.as_json:
            self.write(f"{encode_json(live).decode()}\n")
        else:
            self.write("".join(f"{'*' if id_ == self.id else ' '} {id_:<20} {role}\n" for id_, role in sorted(live.items())))

    def _switch_events(self, given: list[str]) -> None:
        if given not in (["on"], ["off"]) or not self.id:
            self.fail(EXIT_USAGE, "events on or events off" if self.id else "say use ID first")
        else:
            self.show_events(on=given == ["on"])

    def _help(self, given: list[str]) -> None:
        rows = {**self._operations, **OWN_WORDS}
        shown = {word: text for word, text in rows.items() if not given or word == given[0].lower()}
        if not shown:
            self.fail(EXIT_USAGE, f"no word {given[0]!r}{nearest(given[0], list(rows))}")
        elif self.as_json:
            self.write(f"{encode_json(shown).decode()}\n")
        else:
            self.write("".join(f"{word:<18} {clean(text)}\n" for word, text in shown.items()))

    def _exit(self, given: list[str]) -> None:  # noqa: ARG002
        self.ended = True


def candidates(shell: Shell, before: str, files: Callable[[], Iterable[str]]) -> list[str]:
    """Return what may complete a line: ``before`` ends with the unfinished word."""
    *earlier, begun = before.split(" ")
    words = [word for word in earlier if word]
    if not words:
        known: Iterable[str] = shell.words()
        return [word for word in known if word.startswith(begun) and (word not in IN_FULL or begun == word)]
    kinds: dict[str, Callable[[], Iterable[str]]] = {
        **dict.fromkeys(("set", "option", "get"), shell.option_names),
        **dict.fromkeys(("use", "start", "stop", "restart", "output"), shell.ids),
        **dict.fromkeys(("load", "save"), files),
        "help": shell.words,
        "events": lambda: ("on", "off"),
        "log": lambda: ("debug", "info", "warning", "error"),
    }
    among = kinds.get(words[0], tuple)() if len(words) == 1 else ()
    return sorted(word for word in among if word.startswith(begun))


def _names(value: Any, above: str) -> Iterable[str]:
    """Yield the names of a table's options, those of tables within it with a dot; a list of rows gives their names or keys."""
    if isinstance(value, dict):
        for name, inner in value.items():  # pyright: ignore[reportUnknownVariableType]  any plain data
            full = f"{above}.{name}" if above else str(name)  # pyright: ignore[reportUnknownArgumentType]
            is_row = isinstance(inner, dict) and "value" in inner
            yield from _names(inner, full) if isinstance(inner, dict) and not is_row else (full,)
    elif isinstance(value, list):
        for row in value:  # pyright: ignore[reportUnknownVariableType]
            if isinstance(row, dict) and (name := row.get("name") or row.get("key")):  # pyright: ignore[reportUnknownVariableType, reportUnknownMemberType]
                yield str(name)  # pyright: ignore[reportUnknownArgumentType]
