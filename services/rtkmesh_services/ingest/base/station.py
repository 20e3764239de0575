"""The base station of an ingest: finds or tells its position, watches it, saves it. Runs in the work loop.

A position comes by one of five ways (``BaseStationTable.mode``). What was saved under a name is compared with what is found, and is
never replaced unless somebody asks for it. A station that is not where it stood is an error event, and the process DEGRADED.
"""

from collections.abc import Callable
from math import inf
from typing import Any, Final

import msgspec

from rtkmesh.gnss.ephemeris import ReceiverFix, ReferenceStation
from rtkmesh.gnss.receiver import SurveyIn
from rtkmesh_schemas.base import BasePosition
from rtkmesh_schemas.config import BaseStationTable
from rtkmesh_schemas.status import Level
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.ingest.base.averaging import Mean, PositionAverage
from rtkmesh_services.ingest.base.found import UNKNOWN_ACCURACY_M, Found, distance_m, found_of, since
from rtkmesh_services.ingest.base.presets import PresetStore
from rtkmesh_services.ingest.base.watch import Move, PositionWatch, code_limit_m, move
from rtkmesh_services.ingest.receivers.orders import Conversation, Heard, Order
from rtkmesh_services.ingest.receivers.survey import Position
from rtkmesh_services.ingest.receivers.text_receivers import dialect_of
from rtkmesh_services.mapping.position import ecef_of
from rtkmesh_services.runtime.service import Context

SAME_M: Final = 0.01  # a receiver that sends this position was told it already
FIRST_RETRY_S: Final = 5.0
LAST_RETRY_S: Final = 60.0
CHECK_PATIENCE_S: Final = 60.0  # a receiver without any fix for so long is told its saved position unchecked
MEAN_EVERY_S: Final = 1.0
SILENT_S: Final = 45.0  # a base sends its place at least every 30 s
EXTRA_S: Final = 30.0  # a receiver that does not tell its progress has so much longer to send its 1005/1006

Publish = Callable[[Position, str, str], None]


class BaseStation:
    """``send`` queues bytes for the receiver; ``publish`` makes a position (with origin and datum) that of the published reference."""

    def __init__(
        self, context: Context, table: BaseStationTable, send: Callable[[bytes], bool], publish: Publish, store: PresetStore | None = None
    ) -> None:
        self.table, self.store = table, store or PresetStore()
        self._context, self._send, self._publish = context, send, publish
        self.dialect = dialect_of(table.receiver)
        self.watch = PositionWatch(table.moved_limit_m)
        self.state = "waiting"
        self.found: Found | None = None
        self.failure = ""
        self.name = table.preset
        self.minimum_s, self.accuracy_m = table.minimum_s, table.accuracy_m
        self.messages: list[Order] = []  # about which messages it sends: said before each survey and each told position
        self._conversation: Conversation | None = None
        self._then = ""  # the state after the conversation
        self.progress: SurveyIn | None = None
        self._average = PositionAverage()
        self.mean: Mean | None = None
        self.sender = ReferenceStation(station_id=0)  # what the receiver says of itself and its antenna
        self.sent_ecef_m: Position | None = None
        self._target: BasePosition | None = None
        self.begun_s = self._state_s = 0.0
        self._next_mean_s = 0.0
        self._retry_at_s: float | None = None
        self._retry_s = FIRST_RETRY_S
        self._lost = True
        self._unsaid = ""
        self._freed = False
        self._sent_s = inf

    # What the ingest hands over

    def connected(self, now_s: float) -> None:
        """The receiver is there (again): it may have lost its power, and with it what it was told."""
        if self._lost and self.state != "off":
            self._begin(now_s)
        self._lost = False

    def lost(self) -> None:
        """The connection is gone."""
        self._lost, self._conversation, self._retry_at_s = True, None, None
        self._sent_s = inf

    def hear(self, heard: Heard, now_s: float) -> None:
        """Take what the receiver says."""
        progress = None if self.dialect is None else self.dialect.progress(heard)
        if progress is not None:
            self.progress = progress
        if self._conversation is not None:
            self._conversation.hear(heard, now_s)
            self._settle(now_s)
        if progress is not None and self.state == "surveying":
            self._look_at_progress(progress)
        elif progress is not None and self.state == "surveyed" and not (progress.valid or progress.active):
            self._forgot(now_s, "the receiver's survey is gone")

    def fix(self, fix: ReceiverFix, now_s: float) -> None:
        """Take a fix of the receiver itself."""
        if self.state in ("averaging", "checking"):
            self._average.add(fix, now_s)

    def reference(self, station: ReferenceStation) -> None:
        """Take what the receiver says of itself."""
        self.sender = station

    def sent(self, position: Position, now_s: float) -> None:
        """Take a position that the receiver sends to rovers (1005, 1006)."""
        self.sent_ecef_m, self._sent_s = position, now_s
        if self.state == "checking" and self._target is not None:
            self._sent_while_checking(position, self._target)
        elif self.state == "surveying" and self.dialect is not None and not self.dialect.tells_progress:
            if now_s - self.begun_s >= self.minimum_s:
                self._surveyed(Found(position, UNKNOWN_ACCURACY_M, "survey-in", now_s - self.begun_s))
        elif self.state in ("watching", "fixed", "surveyed", "averaged"):
            self._tell_move(self.watch.sent(position))

    def _sent_while_checking(self, position: Position, target: BasePosition) -> None:
        """An earlier run of ours told it already; or it stands at another place, and has to be a rover to have fixes of its own."""
        if distance_m(position, target.position_ecef_m) < SAME_M:
            self._stand(target)
        elif self.dialect is not None and not self._freed and self._conversation is None:
            self._freed = True
            self._talk(self.dialect.rover(), "checking")

    def tick(self, now_s: float) -> None:
        """Do what time asks for."""
        if self._conversation is not None:
            self._conversation.tick(now_s)
            self._settle(now_s)
        if self._retry_at_s is not None and now_s >= self._retry_at_s:
            self._retry_at_s = None
            self._begin(now_s)
        if self.state == "surveying" and self.dialect is not None and not self.dialect.tells_progress:
            late = now_s - self.begun_s > self.minimum_s + EXTRA_S
            self.failure = "the survey's time is over and no 1005/1006 comes (is it set to be sent?)" if late else ""
        if self.state in ("fixed", "surveyed") and now_s - self._sent_s > SILENT_S and self.dialect is not None and not self._lost:
            self._forgot(now_s, f"no 1005/1006 for {SILENT_S:.0f} s")
        if self.state in ("averaging", "checking") and now_s >= self._next_mean_s:
            self._next_mean_s = now_s + MEAN_EVERY_S
            self.mean = self._average.mean()
            self._look_at_average(now_s)

    def _forgot(self, now_s: float, why: str) -> None:
        """The receiver does not know any more what it was told: it has lost its power, or somebody told it something else."""
        self._event(Level.WARNING, "base_forgot", f"{why}; it is told again")
        self._sent_s = inf
        self._begin(now_s)

    def complaint(self) -> str:
        """Return what is wrong, or nothing."""
        if self.watch.moved is not None:
            return f"the base has moved: {self.watch.moved}"
        return f"base station: {self.failure}" if self.failure else ""

    # What is asked for (base/commands.py)

    def survey(self, minimum_s: float, accuracy_m: float, now_s: float) -> None:
        """Begin a new survey, or a new average where the receiver has none; what was believed counts no more."""
        self.minimum_s, self.accuracy_m = minimum_s, accuracy_m
        self.watch.believe(None, "")
        self._forget_found()
        if self.dialect is None:
            self._enter("averaging", now_s)
        else:
            self._survey(now_s)

    def stop(self) -> None:
        """End the survey: the receiver is a rover again, and nobody looks after its position."""
        self._forget_found()
        self.state = "off"
        if self.dialect is not None:
            self._talk(self.dialect.rover(), "off")

    def use(self, position: BasePosition, now_s: float, *, unchecked: bool) -> None:
        """Go to a saved position: compared with the receiver's own fixes first, unless that is not wanted."""
        self.name = position.name
        self._forget_found()
        self._target = position
        self.watch.believe(position.position_ecef_m, since(position))
        if unchecked:
            self._tell(position, now_s)
            return
        self._enter("checking", now_s)
        if self.dialect is not None:
            self._talk(self.dialect.rover(), "checking")

    def present(self) -> Found | None:
        """Return the position that is known now: the one found, or another one that the receiver sends."""
        sent, found = self.sent_ecef_m, self.found
        if sent is None or (found is not None and distance_m(sent, found.position_ecef_m) <= SAME_M):
            return found
        return Found(sent, UNKNOWN_ACCURACY_M if found is None else found.accuracy_m, "rtcm3")

    def trust(self, position: BasePosition) -> None:
        """Believe a position that was saved just now, wherever the station stood before."""
        self.name = position.name
        self.watch.believe(position.position_ecef_m, since(position))

    # How it goes on

    def _begin(self, now_s: float) -> None:
        """Begin what the mode asks for."""
        mode, dialect = self.table.mode, self.dialect
        self.failure = ""
        if mode == "fixed":
            self._tell(self._configured(), now_s)
            return
        saved = self._saved()
        if saved is not None and mode in ("preset", "watch") and self.watch.believed is None:
            self.watch.believe(saved.position_ecef_m, since(saved))
        if mode == "preset" and saved is not None:
            self._target = saved
            self._enter("checking", now_s)
        elif mode in ("survey-in", "preset") and dialect is not None:
            if asking := dialect.ask():
                self.progress = None
                self._enter("asking", now_s)
                self._talk(asking, "asked")
            else:
                self._survey(now_s)
        elif mode == "average":
            self._enter("averaging", now_s)
        else:
            self._enter("watching", now_s)

    def _survey(self, now_s: float) -> None:
        assert self.dialect is not None, "only a receiver that we can talk to surveys"
        self.progress = None
        self._enter("telling", now_s)
        self._talk([*self.messages, *self.dialect.survey(self.minimum_s, self.accuracy_m)], "surveying")

    def _tell(self, position: BasePosition, now_s: float) -> None:
        self._target = position
        if self.dialect is None:
            self._stand(position)
            return
        self._enter("telling", now_s)
        self._talk([*self.messages, *self.dialect.fixed(position.position_ecef_m, position.accuracy_m)], "fixed")

    def _talk(self, orders: list[Order], then: str) -> None:
        self._conversation, self._then = Conversation(orders, self._send), then

    def _settle(self, now_s: float) -> None:
        """Go on when a conversation has ended."""
        conversation = self._conversation
        if conversation is None or not conversation.ended:
            return
        self._conversation = None
        if conversation.failure:
            self._fail(conversation.failure, now_s)
        elif self._then == "asked":
            self._asked(now_s)
        elif self._then == "surveying":
            self._enter("surveying", now_s)
            self._retry_s = FIRST_RETRY_S
            self._event(Level.INFO, "survey_started", f"survey-in of at least {self.minimum_s:.0f} s, to {self.accuracy_m:g} m")
        elif self._then == "fixed" and self._target is not None:
            self._retry_s = FIRST_RETRY_S
            self._stand(self._target)
        elif self._then == "checking":
            self._enter("checking", now_s)

    def _asked(self, now_s: float) -> None:
        """Let a survey that goes on or is done be; begin one else."""
        progress = self.progress
        if progress is None or not (progress.valid or progress.active):
            self._survey(now_s)
            return
        self._enter("surveying", now_s)
        self.begun_s = now_s - progress.duration_s
        self._look_at_progress(progress)

    def _fail(self, why: str, now_s: float) -> None:
        self.state, self.failure = ("off" if self.state == "off" else "failed"), why
        self._retry_at_s = None if self.state == "off" else now_s + self._retry_s
        self._event(Level.ERROR, "base_failed", f"{why}; trying again in {self._retry_s:.0f} s", logged=self._unsaid != why)
        self._unsaid = why
        self._retry_s = min(LAST_RETRY_S, 2.0 * self._retry_s)

    def _enter(self, state: str, now_s: float) -> None:
        if state in ("averaging", "checking"):
            self._average, self.mean, self._next_mean_s = PositionAverage(), None, now_s
        self.state, self._state_s, self.failure = state, now_s, ""
        if state in ("surveying", "averaging", "telling"):
            self.begun_s = now_s

    def _look_at_progress(self, progress: SurveyIn) -> None:
        if progress.valid and not progress.active and progress.position_ecef_m is not None:
            found = (progress.position_ecef_m, progress.accuracy_m, "survey-in", progress.duration_s, progress.observations)
            self._surveyed(Found(*found))

    def _surveyed(self, found: Found) -> None:
        self.state, self.found = "surveyed", found
        text = f"survey-in done: {found.accuracy_m:.2f} m after {found.duration_s:.0f} s and {found.observations} observations"
        self._event(Level.INFO, "survey_done", text, position_ecef_m=found.position_ecef_m, accuracy_m=found.accuracy_m)
        self._publish(found.position_ecef_m, "survey-in", self.table.datum)
        self._compare_or_save(found)

    def _look_at_average(self, now_s: float) -> None:
        mean = self.mean
        if self.state == "checking":
            self._look_at_check(mean, now_s)
        elif mean is not None and mean.duration_s >= self.minimum_s and mean.accuracy_m <= self.accuracy_m:
            found = Found(mean.position_ecef_m, mean.accuracy_m, "average", mean.duration_s, mean.observations)
            self.state, self.found = "averaged", found
            text = f"position averaged: {mean.accuracy_m:.2f} m after {mean.duration_s:.0f} s and {mean.observations} fixes"
            self._event(Level.INFO, "average_done", text, position_ecef_m=mean.position_ecef_m, accuracy_m=mean.accuracy_m)
            self._publish(mean.position_ecef_m, "average", self.table.datum)
            self._compare_or_save(found)

    def _look_at_check(self, mean: Mean | None, now_s: float) -> None:
        """Tell the receiver its saved position when its own fixes agree, or when it has none."""
        target = self._target
        assert target is not None, "a check is of a position"
        if mean is None and now_s - self._state_s >= CHECK_PATIENCE_S:
            self._event(Level.WARNING, "base_unchecked", f"no fixes to compare {since(target)} with: it is used unchecked")
            self._tell(target, now_s)
        elif mean is not None and mean.duration_s >= self.table.check_s:
            limit_m = code_limit_m(target.accuracy_m, mean.accuracy_m, self.table.moved_limit_m)
            made = move("fix", since(target), target.position_ecef_m, mean.position_ecef_m, limit_m)
            if made.too_far:
                self.state, self.watch.moved = "failed", made
                self._tell_move(made)
            else:
                self._event(Level.INFO, "base_consistent", f"the receiver's fixes are {made}")
                self._tell(target, now_s)

    def _compare_or_save(self, found: Found) -> None:
        """Compare what was found with what is saved under the name, and with where the station stood before; save it where nothing is."""
        saved = self._saved()
        if saved is not None:
            limit_m = code_limit_m(saved.accuracy_m, found.accuracy_m, self.table.moved_limit_m)
            made = move("survey", since(saved), saved.position_ecef_m, found.position_ecef_m, limit_m)
            if made.too_far:
                self.watch.believe(saved.position_ecef_m, since(saved))
                self.watch.moved = made
                self._tell_move(made)
                return
            self._event(Level.INFO, "base_consistent", f"the new position is {made}; the saved one stays as it is")
        if self.watch.believed is not None:  # rovers have been told another one
            self._tell_move(self.watch.sent(found.position_ecef_m))
            return
        self.watch.believe(found.position_ecef_m, f"the {found.source} position")
        if saved is None and self.name:
            self._save(self.as_saved(self.name, found, "automatic"))

    def as_saved(self, name: str, found: Found, by: str, *, antenna: str = "", height_m: float | None = None) -> BasePosition:
        """Return a position as it is to be saved."""
        now_ns = self._context.clock.utc_ns()
        return found.saved_as(name, now_ns, by, self.sender, datum=self.table.datum, antenna=antenna, height_m=height_m)

    def _save(self, position: BasePosition) -> None:
        try:
            self.store.save(position)
        except ServiceError as error:
            self._event(Level.ERROR, "base_not_saved", str(error))
        else:
            self._event(Level.INFO, "base_saved", f"position saved as {position.name!r}", **msgspec.to_builtins(position))

    def _stand(self, position: BasePosition) -> None:
        """The station is at a known position, and says so."""
        self.state, self.failure, self.found = "fixed", "", found_of(position)
        self.watch.believe(position.position_ecef_m, since(position))
        self._publish(position.position_ecef_m, "preset" if position.name else "configuration", position.datum)
        self._event(Level.INFO, "base_fixed", f"the station stands at {since(position)}")

    def _configured(self) -> BasePosition:
        position = ecef_of(self.table.position_ecef_m, self.table.position_llh_deg)
        assert position is not None, "the configuration was checked"
        return self.as_saved("", Found(position, self.table.accuracy_m, "configuration"), "configuration")

    def _saved(self) -> BasePosition | None:
        try:
            return self.store.get(self.name) if self.name else None
        except ServiceError as error:
            if self._unsaid != str(error):
                self._unsaid = str(error)
                self._event(Level.ERROR, "base_not_read", str(error))
            return None

    def _forget_found(self) -> None:
        self.found, self.progress, self.mean, self.failure, self._retry_at_s = None, None, None, "", None
        self._conversation, self._retry_s, self._freed = None, FIRST_RETRY_S, False

    def _tell_move(self, made: Move | None) -> None:
        if made is None:
            return
        data: dict[str, Any] = {"kind": made.kind, "enu_m": made.enu_m, "distance_m": made.distance_m, "limit_m": made.limit_m}
        if made.too_far:
            self._event(Level.ERROR, "base_moved", f"the base has moved: {made}", **data)
        else:
            self._event(Level.INFO, "base_back", f"the base is back: {made}", **data)

    def _event(self, level: Level, code: str, text: str, *, logged: bool = True, **data: Any) -> None:
        self._context.event(level, code, text, logged=logged, **data)
