"""When rules begin and end: one small state machine for each rule and key. Values and times in, changes out."""

from dataclasses import dataclass, field
from typing import Any, Final

from rtkmesh_services.runtime.rule_words import Rule

MAXIMUM_KEYS: Final = 1000  # of one rule: an expression may match what a stranger publishes


@dataclass(frozen=True, slots=True)
class Change:
    """A rule that has begun, or ended, on a key. ``value`` is what it saw last."""

    rule: Rule
    key: str
    begun: bool
    value: Any


@dataclass(slots=True)
class _Watched:
    """One key of a rule. Times in seconds of the monotonic clock."""

    heard_s: float
    begun: bool = False
    value: Any = None
    turning_s: float | None = None  # since when the condition has been other than ``begun``


@dataclass(slots=True)
class RuleState:
    """A rule with its keys. Mutable."""

    rule: Rule
    now_s: float
    begun_before: tuple[str, ...] = ()
    changes: int = 0
    _keys: dict[str, _Watched] = field(default_factory=dict[str, _Watched])

    def __post_init__(self) -> None:
        for key in self.begun_before:
            self._keys[key] = _Watched(self.now_s, begun=True)
        if self.rule.condition.silent:
            self._keys.setdefault(self.rule.table.key, _Watched(self.now_s))

    @property
    def begun(self) -> list[str]:
        """The keys on which it holds."""
        return [key for key, watched in self._keys.items() if watched.begun]

    @property
    def seen(self) -> dict[str, Any]:
        """The values that it saw last."""
        return {key: watched.value for key, watched in self._keys.items()}

    def take(self, key: str, message: Any, now_s: float) -> Change | None:
        """Take a message of a key; return what it changes."""
        watched = self._keys.get(key)
        if watched is None:
            if len(self._keys) >= MAXIMUM_KEYS:
                return None
            watched = self._keys[key] = _Watched(now_s)
        watched.heard_s = now_s
        if not self.rule.condition.silent:
            watched.value = self.rule.condition.of(message)
        return self._look(key, watched, now_s)

    def tick(self, now_s: float) -> list[Change]:
        """Return what time alone has changed."""
        changes = (self._look(key, watched, now_s) for key, watched in self._keys.items())
        return [change for change in changes if change is not None]

    def _look(self, key: str, watched: _Watched, now_s: float) -> Change | None:
        holds = self._holds(watched, now_s)
        if holds is None or holds is watched.begun:
            watched.turning_s = None
            return None
        watched.turning_s = now_s if watched.turning_s is None else watched.turning_s
        if now_s - watched.turning_s < self._delay_s(watched):
            return None
        watched.begun, watched.turning_s = holds, None
        self.changes += 1
        return Change(self.rule, key, holds, watched.value)

    def _holds(self, watched: _Watched, now_s: float) -> bool | None:
        if self.rule.condition.silent:
            return now_s - watched.heard_s >= self.rule.table.delay_s
        return self.rule.condition.holds(watched.value, begun=watched.begun)

    def _delay_s(self, watched: _Watched) -> float:
        if watched.begun:
            return self.rule.table.end_delay_s
        return 0.0 if self.rule.condition.silent else self.rule.table.delay_s
