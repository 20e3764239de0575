"""What RTK-SURVEY sets: settings that are checked whole before any of them counts, and the order to the base that follows from them.

Differences from Skybrush, on purpose: the accuracy of a fixed position is no goal of the next survey; settings that no base would follow
are refused.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Final, TypeGuard

from msgspec import UNSET

from rtkmesh_schemas.flockwave import GNSS_TYPES, MESSAGE_SETS, RTKSurveySettings
from rtkmesh_services.control.flockwave.coordinates import Position, millimetres
from rtkmesh_services.errors import ServiceError

ACCURACY_M: Final = 1.0
DURATION_S: Final = 60
SETTINGS_INVALID: Final = "Settings object missing or invalid"
_SYSTEMS: Final = {"gps": "G", "glonass": "R", "galileo": "E", "sbas": "S", "qzss": "J", "beidou": "C", "irnss": "I"}


class SurveyError(ServiceError):
    """Settings that are none, or that nobody here can follow; the text is the reason of the answer."""


@dataclass(frozen=True, slots=True)
class SurveySettings:
    """``accuracy_m`` is that of the fixed position where there is one, ``goal_m`` that of surveys."""

    duration_s: float = DURATION_S
    goal_m: float = ACCURACY_M
    accuracy_m: float = ACCURACY_M
    message_set: str = "msm7"
    position_ecef_m: Position | None = None
    gnss_types: tuple[str, ...] = ()

    def told(self) -> RTKSurveySettings:
        """Return the settings as they are told."""
        values: dict[str, Any] = {
            "duration": self.duration_s,
            "accuracy": self.accuracy_m,
            "message_set": self.message_set,
            "position": UNSET if self.position_ecef_m is None else millimetres(self.position_ecef_m),
            "gnss_types": list(self.gnss_types) or UNSET,
        }
        return RTKSurveySettings(**values)

    def changed(self, update: Any) -> "SurveySettings":
        """Return the settings with an update merged in; SurveyError says what is wrong with it, and then nothing is changed."""
        if not is_map(update):
            raise SurveyError(SETTINGS_INVALID)
        made = self
        for name, change in _CHANGES.items():
            if name in update:
                made = change(made, update[name])
        return _with_accuracy(made, update) if "accuracy" in update else made

    def without_position(self) -> "SurveySettings":
        """Return the settings of a survey to the accuracy that surveys had."""
        return replace(self, position_ecef_m=None, accuracy_m=self.goal_m)

    def order(self) -> tuple[str, dict[str, Any]]:
        """Return the command to the base's ingest, and its arguments."""
        sent = {"messages": self.message_set, "systems": "".join(_SYSTEMS[name] for name in self.gnss_types)}
        if self.position_ecef_m is not None:
            return "fix_position", {"position_ecef_m": list(self.position_ecef_m), "accuracy_m": self.accuracy_m, **sent}
        return "survey_start", {"minimum_s": self.duration_s, "accuracy_m": self.accuracy_m, **sent}


def _with_accuracy(settings: SurveySettings, update: Mapping[str, Any]) -> SurveySettings:
    """Take an accuracy: that of a position which comes with it, else the goal of surveys; a position that stands keeps its own."""
    value = _positive(update["accuracy"], "accuracy")
    if settings.position_ecef_m is None:
        return replace(settings, accuracy_m=value, goal_m=value)
    return replace(settings, accuracy_m=value) if "position" in update else settings


def _with_duration(settings: SurveySettings, value: Any) -> SurveySettings:
    return replace(settings, duration_s=_positive(value, "duration"))


def _with_message_set(settings: SurveySettings, value: Any) -> SurveySettings:
    if value not in MESSAGE_SETS:
        raise SurveyError(f"{str(value)[:64]!r} is not a valid RTKMessageSet")
    return replace(settings, message_set=value)


def _with_position(settings: SurveySettings, value: Any) -> SurveySettings:
    if value is None:
        return settings.without_position()
    if not is_list(value) or len(value) != 3 or not all(_is_number(part) for part in value):
        raise SurveyError("invalid base station position")
    x, y, z = (part * 1e-3 for part in value)
    return replace(settings, position_ecef_m=(x, y, z))


def _with_gnss_types(settings: SurveySettings, value: Any) -> SurveySettings:
    if value is not None and not (is_list(value) and all(isinstance(name, str) and name in GNSS_TYPES for name in value)):
        raise SurveyError("invalid GNSS type list")
    return replace(settings, gnss_types=tuple(sorted(set(value or ()))))


def _positive(value: Any, name: str) -> float:
    if not _is_number(value) or value <= 0:
        raise SurveyError(f"invalid {name}")
    return float(value)


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15 and isfinite(value)


def is_map(value: Any) -> TypeGuard[Mapping[str, Any]]:
    """Return whether a value is a JSON object."""
    return isinstance(value, Mapping)


def is_list(value: Any) -> TypeGuard[list[Any]]:
    """Return whether a value is a JSON array."""
    return isinstance(value, list)


def _checked_accuracy(settings: SurveySettings, value: Any) -> SurveySettings:
    _positive(value, "accuracy")
    return settings


# In the order in which faults are told; the accuracy is taken last, when it is known whether a position comes with it.
_CHANGES: Final[dict[str, Callable[[SurveySettings, Any], SurveySettings]]] = {
    "accuracy": _checked_accuracy,
    "duration": _with_duration,
    "messageSet": _with_message_set,
    "position": _with_position,
    "gnssTypes": _with_gnss_types,
}
