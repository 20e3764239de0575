"""Setting up a receiver by a recipe: who is it, tell it every step, read back what it then says, save.

Works on an open port of its own, in the calling thread.
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.gnss.receiver import ReceiverVersion
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers.orders import Answer, Conversation, Heard, Order, TextLines, Told
from rtkmesh_services.ingest.receivers.recipes import Recipe, Step
from rtkmesh_services.ingest.receivers.text_receivers import SEPTENTRIO_WAKE, septentrio, unicore
from rtkmesh_services.ingest.receivers.ublox import BBR, FLASH, RAM, acknowledged, payload_of, poll, report_of, valget, valset
from rtkmesh_services.ingest.ubx_commands import framed, ubx_frame
from rtkmesh_services.ingest.wires import Wire

QUIET_S: Final = 0.6  # so long after the last line an answer of many lines is whole
LONGEST_TEXT_S: Final = 4.0
READ_BACK: Final = {"CFG-RATE": 0, "CFG-MSG": 2}  # messages that are polled by so many bytes of their payload


@dataclass(frozen=True, slots=True)
class Row:
    """One setting: what was wanted, whether the receiver took it, and what it then says. ``ok`` None: that cannot be read back."""

    step: str
    setting: str
    wanted: str
    answer: str
    read: str
    ok: bool | None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a recipe. ``identity``: what the receiver calls itself; ``saved``: None if it was not asked for."""

    identity: str
    fits: bool
    rows: tuple[Row, ...] = ()
    saved: bool | None = None

    @property
    def ok(self) -> bool:
        """Whether all was taken, and read back as wanted where it can be read."""
        return self.fits and self.saved is not False and all(row.ok is not False for row in self.rows)


class Talker:
    """Talks on an open port; keeps what was heard while an order was waited for."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._framer, self._lines = Framer([Protocol.UBX]), TextLines()
        self._framer.feed(b"\n")  # compiles or loads its kernel before anybody waits for an answer
        self.heard: list[Heard] = []

    def tell(self, *orders: Order) -> list[Told]:
        """Say orders; return those that were said, with their answers. The first that fails is the last."""
        talk = Conversation(orders, self._send)
        self.heard = []
        while not talk.ended:
            talk.tick(time.monotonic())
            for heard in self._read():
                self.heard.append(heard)
                talk.hear(heard, time.monotonic())
        return talk.told

    def ask(self, order: Order) -> list[str]:
        """Say an order and return all lines that follow, until it is quiet; none where it is refused."""
        if not accepted(self.tell(order)):
            return []
        lines = [line for line in self.heard if isinstance(line, str)]
        begun_s = last_s = time.monotonic()
        while time.monotonic() - last_s < QUIET_S and time.monotonic() - begun_s < LONGEST_TEXT_S:
            found = [line for line in self._read() if isinstance(line, str)]
            if any(not line.startswith("$G") for line in found):
                last_s = time.monotonic()
            lines += found
        return lines

    def _send(self, data: bytes) -> bool:
        self._wire.write(data)
        return True

    def _read(self) -> list[Heard]:
        data = self._wire.read()
        if data == b"":
            raise SourceError(f"{self._wire.detail}: closed by the other side")
        return [*self._framer.feed(data), *self._lines.feed(data)] if data else []


def accepted(told: Sequence[Told]) -> bool:
    """Return whether the receiver took all of what was said."""
    return bool(told) and all(one.answer is not None and one.answer.accepted for one in told)


def configure(wire: Wire, recipe: Recipe, *, save: bool, force: bool, say: Callable[[str], None] = lambda _: None) -> Outcome:
    """Set up the receiver behind an open port; a receiver of another model is told nothing unless forced."""
    talker = Talker(wire)
    identity = identify(talker, recipe.language)
    fits = not recipe.models or any(model.lower() in identity.lower() for model in recipe.models)
    if not (fits or force):
        return Outcome(identity, fits=False)
    rows: list[Row] = []
    for step in recipe.step:
        say(step.what)
        rows += _STEPS[recipe.language](talker, step, save)
    saved = _save(talker, recipe.language) if save else None
    return Outcome(identity, fits=True, rows=tuple(rows), saved=saved)


def identify(talker: Talker, language: str) -> str:
    """Return what a receiver calls itself; SourceError when nobody answers in its language."""
    if language in ("ublox", "ublox-legacy"):
        talker.tell(poll(0x0A, 0x04, "MON-VER"))
        found = [version for heard in talker.heard if (version := version_of(heard))]
    elif language == "unicore":
        lines = talker.ask(unicore("VERSIONA"))
        found = [line.partition(";")[2].partition("*")[0].replace('"', "") for line in lines if "VERSIONA," in line and ";" in line]
    else:
        talker.tell(Order("wake", SEPTENTRIO_WAKE, lambda _: Answer(accepted=True), needed=False, attempts=1))
        lines = talker.ask(septentrio("lstInternalFile, Identification"))
        found = [" ".join(line.strip() for line in lines if "<" in line or "mosaic" in line.lower() or "asterx" in line.lower())]
    if not found:
        raise SourceError(f"nobody answers in the language of {language} receivers (wrong port, wrong baud rate, another receiver?)")
    return found[0].strip()


def version_of(heard: Heard) -> str:
    """Return the texts of a MON-VER, the model first; nothing for anything else."""
    report = report_of(heard)
    if not isinstance(report, ReceiverVersion):
        return ""
    texts = (report.model, report.software, *report.extensions)
    return ", ".join(text for text in texts if text and not text.startswith("MOD="))[:400]


def orders_of(recipe: Recipe, *, save: bool) -> list[tuple[str, str]]:
    """Return what would be said, as pairs of step and text: for a dry run."""
    said: list[tuple[str, str]] = []
    for step in recipe.step:
        said += [(step.what, f"{key} = {value}") for key, value in step.keys.items()]
        said += [(step.what, line) for line in (*step.messages, *step.commands)]
    return said + ([("save", _SAVES[recipe.language])] if save else [])


def _keys(talker: Talker, step: Step, save: bool) -> list[Row]:
    """Set keys at once, or one by one where the receiver does not take all of them, and read them back."""
    layers = RAM | BBR | FLASH if save else RAM
    told = talker.tell(valset(step.keys, layers))
    answers = dict.fromkeys(step.keys, _word(told))
    if not accepted(told) and told[-1].answer is not None and len(step.keys) > 1:
        answers = {key: _word(talker.tell(valset({key: value}, layers))) for key, value in step.keys.items()}
    taken = [key for key, word in answers.items() if word == _TAKEN]
    values: dict[str, float] = {}
    if taken:
        read = talker.tell(valget(taken))
        values = read[-1].answer.values if read[-1].answer is not None else {}
    return [
        Row(step.what, key, str(wanted), answers[key], str(values.get(key, "")), answers[key] == _TAKEN and values.get(key) == wanted)
        for key, wanted in step.keys.items()
    ]


def _messages(talker: Talker, step: Step, save: bool) -> list[Row]:
    del save
    rows: list[Row] = []
    for text in step.messages:
        frame, name = ubx_frame(text), text.split()[0]
        word = _word(talker.tell(acknowledged(name, frame)))
        if word != _TAKEN or name not in READ_BACK:
            rows.append(Row(step.what, name, text, word, "", None if word == _TAKEN else False))
            continue
        payload = frame[6:-2]
        talker.tell(_poll_of(name, frame[2], frame[3], payload[: READ_BACK[name]]))
        kind = f"{frame[2]:02x}-{frame[3]:02x}"
        read = [payload_of(heard) for heard in talker.heard if isinstance(heard, Frame) and heard.kind == kind]
        rows.append(Row(step.what, name, text, word, read[-1].hex(" ") if read else "", payload in read))
    return rows


def _poll_of(name: str, class_: int, number: int, payload: bytes) -> Order:
    order = poll(class_, number, name)
    return Order(name, framed(class_, number, payload), order.judge, needed=False)


def _commands(talker: Talker, step: Step, order_of: Callable[[str], Order]) -> list[Row]:
    words = {command: _word(talker.tell(order_of(command))) for command in step.commands}
    lines = [line for question in step.ask for line in talker.ask(order_of(question)) if not _is_echo(line)]
    seen = {text: any(_says(line, text) for line in lines) for text in step.expect}
    rows = [Row(step.what, command, command, word, "", None if word == _TAKEN else False) for command, word in words.items()]
    return rows + [Row(step.what, text, text, "", text if found else "", found) for text, found in seen.items()]


def _is_echo(line: str) -> bool:
    """Return whether a line only repeats a command, and says nothing of what is set."""
    return "response:" in line or line.rpartition("$R")[2][:1] in (":", "?")


def _says(line: str, text: str) -> bool:
    """Return whether a text stands in a line as a whole: ``GPGGA COM1 1`` is not in ``GPGGA COM1 10``."""
    pattern = r"\s+".join(re.escape(word) for word in text.split())
    return re.search(rf"(?<![\w.]){pattern}(?![\w.])", line, re.IGNORECASE) is not None


def _save(talker: Talker, language: str) -> bool:
    """Let the receiver keep what it was told; u-blox's keys were told to its flash already."""
    if language == "ublox":
        return True
    text = _SAVES[language]
    order = acknowledged("CFG-CFG", ubx_frame(text)) if language == "ublox-legacy" else _ORDERS[language](text)
    return accepted(talker.tell(order))


def _word(told: Sequence[Told]) -> str:
    answer = told[-1].answer
    if answer is None:
        return "no answer"
    return _TAKEN if answer.accepted else answer.text or "refused"


_TAKEN: Final = "taken"
_ORDERS: Final[dict[str, Callable[[str], Order]]] = {"unicore": unicore, "septentrio": septentrio}
_SAVES: Final = {
    "ublox": "layers RAM, BBR, flash",
    "ublox-legacy": "CFG-CFG 0 65535 0 23",
    "unicore": "SAVECONFIG",
    "septentrio": "exeCopyConfigFile, Current, Boot",
}
_STEPS: Final[dict[str, Callable[[Talker, Step, bool], list[Row]]]] = {
    "ublox": _keys,
    "ublox-legacy": _messages,
    "unicore": lambda talker, step, _: _commands(talker, step, unicore),
    "septentrio": lambda talker, step, _: _commands(talker, step, septentrio),
}
