"""RTKLIB's receiver options (``inpstrN-rcvopt``, convbin's ``-ro``): text to values. Standard library only.

Options that ask for what is done anyway are accepted, with the reason. The words are those of RTKLIB demo5 2.5.0 (``input_ubx``,
``input_rtcm3``, ``input_sbf`` and kin).
"""

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from math import isfinite
from typing import Any, Final

from rtkmesh.errors import OptionError


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """What is done to the messages of one receiver. All by default: nothing.

    ``all_ephemerides``: also those that repeat the last one. ``galileo``: ``"inav"`` or ``"fnav"``, the only Galileo ephemerides that
    pass; empty: both. ``rounding_s``: epochs are moved to multiples of it, ranges by the clock (0: not). ``invert_doppler`` turns the
    sign of RTCM 3. ``slip_sigma`` and ``drop_sigma`` in steps of 0.004 cycles: a phase of at least this reported sigma has
    slipped, one of more than this is left out (None: not). ``station``: the only RTCM 3 station whose messages are read. ``antenna``: of
    an SBF receiver, 0 main, 1 and 2 auxiliary. ``signals``: (system, band, attribute): where a satellite has this signal, its others of
    the band are left out. ``notes``: what of the text asks for nothing, and why.
    """

    all_ephemerides: bool = False
    galileo: str = ""
    rounding_s: float = 0.0
    invert_doppler: bool = False
    slip_sigma: int | None = None
    drop_sigma: int | None = None
    station: int | None = None
    antenna: int = 0
    signals: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=(), compare=False)


# Options with nothing behind them -> values of ReceiverOptions.
_FLAGS: Final[dict[str, dict[str, Any]]] = {
    "-EPHALL": {"all_ephemerides": True},
    "-GALINAV": {"galileo": "inav"},
    "-GALFNAV": {"galileo": "fnav"},
    "-INVPRR": {"invert_doppler": True},
    "-AUX1": {"antenna": 1},
    "-AUX2": {"antenna": 2},
}
# Options with a number: field, least, largest, whether it is a whole one.
_NUMBERS: Final[dict[str, tuple[str, float, float, bool]]] = {
    "-TADJ": ("rounding_s", 0.0, 60.0, False),
    "-STD_SLIP": ("slip_sigma", 0, 15, True),
    "-MAX_STD_CP": ("drop_sigma", 0, 15, True),
    "-STA": ("station", 0, 4095, True),
}
_NEEDLESS: Final = {
    "-MULTICODE": "all codes are always passed on",
    "-RCVSTDS": "the receiver's own sigmas are always passed on",
    "-IHALFC": "phases with an unknown half cycle are always passed on, marked as such",
    "-RT_INP": 'a live stream is always dated by the system\'s clock; for a recording say date = "YYYY-MM-DD"',
    "-NO_MEAS3": "Meas3 blocks are not read",
    "-INVCP": "phases of RXM-RAWX need it not; old RXM-RAW and SkyTraq, which do, are not read",
    "-TRKM_ADJ": "the undocumented TRK-MEAS messages are not read",
    "-NOET": "there is no Javad decoder that it could speak to",
}
_REFUSED: Final = {
    "-NO_MEAS2": "it would leave no observations: of Septentrio's blocks MeasEpoch is read, Meas3 is not",
    "-GLOBIAS": "GLONASS code biases are learned by the solver, they cannot be given",
    "-TTCORR": "there is no decoder of Hemisphere receivers",
    "-ENAGLO": "there is no decoder of Hemisphere receivers",
    "-WEEK": "there is no decoder of RT17",
}
_SIGNAL: Final = re.compile(r"-([GRECJSI])L?([1-9])([A-Z])")


def parse_receiver_options(text: str) -> ReceiverOptions:
    """Return the options of a text such as ``-EPHALL -TADJ=0.1 -GL2L``; OptionError names what is wrong, with the nearest right name."""
    values: dict[str, Any] = {}
    signals: list[str] = []
    notes: list[str] = []
    for word in text.split():
        name, equals, number = word.partition("=")
        if name in _NEEDLESS:
            notes.append(f"{name}: {_NEEDLESS[name]}")
        elif name in _REFUSED:
            raise OptionError(f"{name} is not possible: {_REFUSED[name]}")
        elif name in _NUMBERS:
            values |= _numbered(name, number, given=bool(equals))
        elif equals and name in _FLAGS:
            raise OptionError(f"{name} takes no value")
        elif name in _FLAGS:
            values |= _joined(values, _FLAGS[name], name)
        elif match := _SIGNAL.fullmatch(word):
            signals.append("".join(match.groups()))
        else:
            raise OptionError(f"no receiver option {_shown(word)}{_nearest(name)}")
    return ReceiverOptions(**values, signals=tuple(signals), notes=tuple(notes))


def _joined(values: dict[str, Any], new: dict[str, Any], name: str) -> dict[str, Any]:
    for key, value in new.items():
        if values.get(key, value) != value:
            raise OptionError(f"{name} contradicts an option before it")
    return new


def _numbered(name: str, text: str, *, given: bool) -> dict[str, Any]:
    key, least, largest, whole = _NUMBERS[name]
    kind: Callable[[str], float] = int if whole else float
    try:
        value = kind(text)
    except ValueError:
        value = float("nan")
    if not given or not (isfinite(value) and least <= value <= largest):
        what = "a whole number" if whole else "a number"
        raise OptionError(f"{name} needs {what} from {least:g} to {largest:g}, as in {name}={largest:g}")
    return {key: value}


def _nearest(name: str) -> str:
    known: Iterable[str] = [*_FLAGS, *_NUMBERS, *_NEEDLESS, "-GL1W", "-GL2L", "-GL2X", "-GL2W", "-RL2C", "-EL6B", "-CL1P", "-JL1L"]
    found = get_close_matches(name if name.startswith("-") else f"-{name}".upper(), known, 1, 0.5)
    return f"; did you mean {found[0]}?" if found else ""


def _shown(word: str) -> str:
    return repr("".join(character if character.isprintable() else "?" for character in word[:40]))
