"""What an output tells of its target: one event when it fails, falls behind, or is well again."""

from collections.abc import Callable
from typing import Any, Final

from rtkmesh_schemas.status import Level, State
from rtkmesh_services.output.sinks import Sink
from rtkmesh_services.runtime.service import Context

DRAIN_NS: Final = 300_000_000  # what had come before the end is still sent, if it does not take longer
BEHIND_NS: Final = 10_000_000_000  # so long after the last loss a target counts as slow


class Watch:
    """Looks after one sink. ``reason`` is empty when all is well."""

    def __init__(self, context: Context, sink: Sink) -> None:
        self._context, self.sink = context, sink
        self.reason = ""
        self._failed = self._behind = False
        self._dropped = self._dropped_before = 0
        self._lost_ns = 0

    @property
    def state(self) -> State:
        """The state of the output."""
        return State.DEGRADED if self.reason else State.RUNNING

    def tick(self, now_mono_ns: int) -> None:
        """Let the sink do its things; tell what has changed."""
        self.sink.tick()
        error, dropped = self.sink.error, self.sink.dropped
        if dropped > self._dropped and not error:  # what is lost in a failure is the failure's
            self._lost_ns = now_mono_ns
        self._dropped = dropped
        behind = self._lost_ns > 0 and now_mono_ns - self._lost_ns < BEHIND_NS
        self.reason = error or (f"too slow: {self._lost} dropped, the oldest first" if behind else "")
        if bool(error) != self._failed:
            self._tell("output_failed" if error else "output_back")
        elif behind and not self._behind and not error:
            self._tell("output_slow")
        self._failed, self._behind = bool(error), behind
        if not self.reason:
            self._dropped_before = self._dropped

    @property
    def _lost(self) -> int:
        """What was dropped since all was well."""
        return self._dropped - self._dropped_before

    def close(self) -> None:
        """Close the sink and say what did not get out."""
        if words := self.sink.close():
            self._context.log.warning("%s", words)

    def _tell(self, code: str) -> None:
        """Publish what has changed; a change of the state is in the log already."""
        if self.reason:
            self._context.event(Level.WARNING, code, self.reason, logged=False)
        else:
            lost = f"; {self._lost} were dropped" if self._lost else ""
            self._context.event(Level.INFO, code, f"the target takes everything again{lost}")


def drain(context: Context, handle: Callable[[Any], None]) -> None:
    """Handle what is in the inbox at the end: the last epochs of a replay are as good as the first."""
    until_ns = context.clock.mono_ns() + DRAIN_NS
    while context.clock.mono_ns() < until_ns and (item := context.inbox.get(0.0)) is not None:
        handle(item)
