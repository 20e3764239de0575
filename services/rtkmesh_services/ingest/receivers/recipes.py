"""Recipes: how a kind of receiver is set up for a job, as TOML files. A step is told, and then read back.

    title = "..."                            # one line for people
    language = "ublox"                       # ublox, ublox-legacy, unicore, septentrio
    models = ["ZED-F9P"]                     # one of these is in what the receiver calls itself
    [[step]]
    what = "five epochs a second"
    [step.keys]                              # ublox: configuration keys
    "CFG-RATE-MEAS" = 200
    # or messages = ["CFG-RATE 200 1 1"]     # ublox-legacy: as in receiver commands; CFG-RATE and CFG-MSG are read back
    # or commands = ["MODE ROVER"]           # unicore, septentrio: with what to ask for afterwards, and what then is in the answer
    #    ask = ["MODE"]
    #    expect = ["MODE ROVER"]

``{port}`` stands for the receiver's own name of the port.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.receivers.ublox import MAXIMUM_KEYS
from rtkmesh_services.ingest.ubx_commands import key_of, ubx_frame
from rtkmesh_services.runtime.shipped import config_folders
from rtkmesh_services.runtime.words import nearest

FOLDER: Final = "receivers"
MAXIMUM_FILE: Final = 65536
_OF_LANGUAGE: Final = {"ublox": "keys", "ublox-legacy": "messages", "unicore": "commands", "septentrio": "commands"}
_PORTS: Final = {  # language: (USB of the receiver itself, a serial line), and what else its ports may be called
    "ublox": ("USB", "UART1", ("UART1", "UART2", "USB", "I2C", "SPI")),
    "ublox-legacy": ("USB", "UART1", ("UART1", "UART2", "USB")),
    "unicore": ("COM1", "COM1", ("COM1", "COM2", "COM3")),
    "septentrio": ("USB1", "COM1", ("COM1", "COM2", "COM3", "COM4", "USB1", "USB2")),
}
_LINES: Final = ("messages", "commands", "ask", "expect")
_Line = Annotated[str, Meta(min_length=1, max_length=400)]


class Step(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One step."""

    what: str
    keys: dict[str, int | float] = {}
    messages: tuple[_Line, ...] = ()
    commands: tuple[_Line, ...] = ()
    ask: tuple[_Line, ...] = ()
    expect: tuple[_Line, ...] = ()


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole recipe; ``name`` is its file's."""

    title: str
    language: Literal["ublox", "ublox-legacy", "unicore", "septentrio"]
    step: tuple[Step, ...]
    models: tuple[str, ...] = ()
    name: str = ""


def shipped_recipes() -> dict[str, Path]:
    """Return the recipes that we ship by name."""
    folder = next((folder / FOLDER for folder in config_folders() if (folder / FOLDER).is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_recipe(name: str, port: str = "", device: str = "") -> Recipe:
    """Return a shipped recipe by name, or one of a file, for the receiver's ``port`` (guessed from our ``device`` if not said).

    SourceError says what is wrong with it.
    """
    shipped = shipped_recipes()
    path = Path(name) if "/" in name or name.endswith(".toml") else shipped.get(name)
    if path is None:
        raise SourceError(f"no recipe {name!r}{nearest(name, list(shipped))}; there are {', '.join(shipped)}, or say a file")
    recipe = msgspec.structs.replace(_read(path), name=path.stem)
    ports = _PORTS[recipe.language][2]
    if port and port not in ports:
        raise SourceError(f"{port!r} is no port of such a receiver: {', '.join(ports)}")
    recipe = for_port(recipe, port or port_of(recipe.language, device))
    _check(path, recipe)
    return recipe


def port_of(language: str, device: str) -> str:
    """Return what the receiver probably calls the port that we call by its device."""
    usb, line, _ = _PORTS[language]
    return usb if "ttyACM" in device or "usb-u-blox" in device else line


def for_port(recipe: Recipe, port: str) -> Recipe:
    """Return the recipe with ``{port}`` filled in."""
    steps: list[Step] = []
    for step in recipe.step:
        lines = {name: tuple(line.replace("{port}", port) for line in getattr(step, name)) for name in _LINES}
        keys = {key.replace("{port}", port): value for key, value in step.keys.items()}
        steps.append(Step(what=step.what, keys=keys, **lines))
    return msgspec.structs.replace(recipe, step=tuple(steps))


def _read(path: Path) -> Recipe:
    try:
        if path.stat().st_size > MAXIMUM_FILE:
            raise SourceError(f"{path}: more than {MAXIMUM_FILE} bytes")
        content: dict[str, Any] = tomllib.loads(path.read_text())
        return msgspec.convert(content, Recipe)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: no TOML: {error}") from error
    except msgspec.ValidationError as error:
        raise SourceError(f"{path}: {error}") from error


def _check(path: Path, recipe: Recipe) -> None:
    """SourceError unless every step says what its language takes."""
    wanted = _OF_LANGUAGE[recipe.language]
    for number, step in enumerate(recipe.step, 1):
        said = [name for name in ("keys", "messages", "commands") if getattr(step, name)]
        if said != [wanted]:
            raise SourceError(f"{path}: step {number} ({step.what}): a step in {recipe.language} has {wanted}, and nothing else")
        if (step.ask or step.expect) and wanted != "commands":
            raise SourceError(f"{path}: step {number} ({step.what}): ask and expect are of receivers of text")
        if len(step.keys) > MAXIMUM_KEYS:
            raise SourceError(f"{path}: step {number} ({step.what}): more than {MAXIMUM_KEYS} keys")
        try:
            for key in step.keys:
                key_of(key)
            for message in step.messages:
                ubx_frame(message)
        except SourceError as error:
            raise SourceError(f"{path}: step {number} ({step.what}): {error}") from None
