"""Flockwave in control: questions from Zenoh, TCP and UDP to the desk, answers back, notifications to all who listen.

All of it happens in control's work loop but what waits: sockets (``server``) and orders to a base's ingest (``orders``).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from rtkmesh_schemas.errors import SchemaError
from rtkmesh_schemas.flockwave import NO_SCHEMA, BeaconBasicProperties, Body, Statistics
from rtkmesh_schemas.keys import CONTROL_ID, FLOCKWAVE
from rtkmesh_schemas.presets import Preset, ingest_id
from rtkmesh_schemas.status import ServiceStatus
from rtkmesh_schemas.wire import JSON
from rtkmesh_services.control.flockwave.desk import Desk, Presets, Respond
from rtkmesh_services.control.flockwave.envelope import (
    Question,
    Refusal,
    acknowledged,
    answered,
    bare,
    read_any,
    read_message,
    refused,
    written,
)
from rtkmesh_services.control.flockwave.orders import Order, Orders, Outcome
from rtkmesh_services.control.flockwave.selected import SelectedBase
from rtkmesh_services.control.flockwave.server import FlockwaveServer, Peer
from rtkmesh_services.control.flockwave.statistics import empty
from rtkmesh_services.control.flockwave.survey import SurveyError, SurveySettings
from rtkmesh_services.errors import BusError
from rtkmesh_services.runtime.addresses import address_of
from rtkmesh_services.runtime.bus import Query, Sample
from rtkmesh_services.runtime.service import Context

SURVEYED: Final = ("auto", "ubx")  # formats of sources that have a receiver behind them which takes orders
_REQUESTS: Final = "flockwave"
_CAPACITY: Final = 256
_PATIENCE_S: Final = 0.2


@dataclass(frozen=True, slots=True)
class Received:
    """A message from a socket."""

    data: bytes
    peer: Peer


@dataclass(frozen=True, slots=True)
class Asked:
    """A question from Zenoh (as it is, the loop would take it for a command)."""

    query: Query


class Flockwave:
    """``ingest_of`` says which process receives a preset, or nothing."""

    def __init__(self, context: Context, presets: Presets, ingest_of: Callable[[Preset], str] | None = None) -> None:
        self._context, self._presets, self._ingest_of = context, presets, ingest_of or receiving
        self._table = context.deployment.flockwave
        self._desk = Desk(presets, self)
        self._selected: SelectedBase | None = None
        self._settings = SurveySettings()
        self._statuses: dict[str, tuple[ServiceStatus, int]] = {}
        self._orders = Orders(context.bus, lambda outcome: context.inbox.put(outcome, lane=_REQUESTS))
        self.server: FlockwaveServer | None = None
        self._counters = {"flockwave_messages": 0, "flockwave_refused": 0, "flockwave_skipped": 0}

    def open(self) -> None:
        """Begin to listen; BusError for an address that cannot be had."""
        inbox = self._context.inbox
        inbox.lane(_REQUESTS, capacity=_CAPACITY, on_drop=_say_busy)
        self._context.bus.queryable(FLOCKWAVE.key(CONTROL_ID), lambda query: inbox.put(Asked(query), lane=_REQUESTS))
        self._orders.start()
        if self._table.tcp or self._table.udp:
            self.server = self._serve()
            self.server.start()

    def handle(self, item: Any) -> bool:
        """Take an item of the inbox; return whether it was for Flockwave."""
        if isinstance(item, Received):
            self._received(item)
        elif isinstance(item, Asked):
            self._asked(item.query)
        elif isinstance(item, Outcome):
            self._followed(item)
        elif not isinstance(item, Sample) or self._selected is None or not self._is_of_base(item, self._selected):
            return False
        self._follow_selection()
        return True

    def status(self, status: ServiceStatus, now_ns: int) -> None:
        """Take the status of any process."""
        if status.role == "ingest":
            self._statuses[status.id] = status, now_ns
        if self._selected is not None and status.id == self._selected.ingest:
            self._selected.status(status, now_ns)

    def tick(self, now_ns: int) -> None:
        """Follow the selection, and tell of what has changed."""
        self._follow_selection()
        if self._selected is not None:
            self._selected.tick(now_ns)

    def counters(self) -> dict[str, int]:
        """Return what was counted."""
        served = {} if self.server is None else {f"flockwave_{name}": count for name, count in self.server.counters.items()}
        return {**self._counters, **served}

    def close(self) -> None:
        """Stop listening."""
        self._orders.close()
        if self.server is not None:
            self.server.close()

    # What the desk tells of

    def statistics(self, kind: str) -> Statistics:
        """Return the answer to RTK-STAT."""
        return empty(kind) if self._selected is None else self._selected.statistics.answer(kind, self._context.clock.mono_ns())

    def settings(self) -> SurveySettings:
        """Return the present survey settings."""
        return self._settings

    def selected_anew(self) -> None:
        """Forget a position that a client had set."""
        self._settings = self._settings.without_position()

    def survey(self, settings: SurveySettings, respond: Respond) -> None:
        """Let the base follow settings, and respond when it does; SurveyError where it is known at once that it will not."""
        self._follow_selection()
        if self._selected is None:
            raise SurveyError("no RTK source is selected: nothing to survey with")
        preset, ingest = self._selected.preset, self._selected.ingest
        if preset.format not in SURVEYED:
            raise SurveyError(f"a source of format {preset.format} takes no orders: {preset.id} cannot be surveyed (auto and ubx can)")
        if not ingest:
            raise SurveyError(f"{preset.id} is not received yet")
        self._orders.put(Order(preset.id, ingest, settings, respond))

    def connections(self) -> dict[str, dict[str, Any]]:
        """Return ConnectionInfo by id."""
        return {} if self._selected is None else self._selected.connections()

    def beacons(self) -> dict[str, dict[str, Any]]:
        """Return BeaconStatusInfo by id."""
        return {} if self._selected is None else self._selected.beacons()

    def beacon_names(self) -> dict[str, BeaconBasicProperties]:
        """Return BeaconBasicProperties by id."""
        return {} if self._selected is None else self._selected.beacon_names()

    # Inner

    def _serve(self) -> FlockwaveServer:
        tcp, udp = (address_of(text) if text else None for text in (self._table.tcp, self._table.udp))
        try:
            return FlockwaveServer(tcp, udp, self._hand_over, self._table.maximum_clients)
        except OSError as error:
            raise BusError(f"[flockwave] {self._table.tcp or self._table.udp}: {error.strerror or error}") from error

    def _hand_over(self, data: bytes, peer: Peer) -> bool:
        """Give a message to the work loop (in the server's thread, which may wait)."""
        return self._context.inbox.put_wait(Received(data, peer), lane=_REQUESTS, timeout_s=_PATIENCE_S)

    def _received(self, item: Received) -> None:
        found = read_message(item.data)
        if found is None:
            self._counters["flockwave_skipped"] += 1
            return
        self._answer(found, lambda message: self._send(item.peer, message))

    def _asked(self, query: Query) -> None:
        found = _question_of(query)
        if found is None:  # a question has an answer, whatever it is
            query.reply(bare(refused(NO_SCHEMA)), JSON)
            return
        self._answer(found, lambda message: query.reply(message, JSON))

    def _answer(self, found: Question | Refusal, send: Callable[[bytes], None]) -> None:
        self._counters["flockwave_messages"] += 1

        def respond(body: Body) -> None:
            self._counters["flockwave_refused"] += body.type == "ACK-NAK"
            send(answered(found, body))

        if isinstance(found, Refusal):
            respond(refused(found.reason))
        else:
            self._desk.answer(found.body, respond)

    def _send(self, peer: Peer, message: bytes) -> None:
        if self.server is not None:
            self.server.send(peer, message)

    def _tell(self, body: Body) -> None:
        """Tell all clients."""
        if self.server is not None:
            self.server.tell_all(written(body))

    def _followed(self, outcome: Outcome) -> None:
        """Answer who has set the survey, when the base's ingest has taken it or refused."""
        order, reply = outcome.order, outcome.reply
        if not reply.ok:
            order.respond(refused(reply.message))
        elif self._selected is None or self._selected.preset.id != order.preset:
            order.respond(refused("another RTK source was selected meanwhile"))
        else:
            self._settings = order.settings
            if order.settings.position_ecef_m is not None:
                self._selected.statistics.tell_position(order.settings.position_ecef_m, self._context.clock.mono_ns())
            order.respond(acknowledged())

    def _is_of_base(self, sample: Sample, selected: SelectedBase) -> bool:
        try:
            return selected.takes(sample)
        except SchemaError as error:
            self._context.log.warning("a message of the selected base is none: %s", error)
            return True

    def _follow_selection(self) -> None:
        """Go over to the preset that is selected now, whoever has selected it."""
        id_ = self._presets.selected()
        preset = None if id_ is None else self._presets.get(id_)
        ingest = "" if preset is None else self._ingest_of(preset)
        old = self._selected
        if (preset, ingest) == (None, "") and old is None:
            return
        if old is not None and (old.preset, old.ingest) == (preset, ingest):
            return
        if old is not None:
            old.leave()
        if old is None or preset is None or old.preset.id != preset.id:
            self.selected_anew()
        self._selected = None if preset is None else self._entered(SelectedBase(
            self._context, preset, ingest, self._tell, basic=self._table.set == "basic"
        ))  # fmt: skip

    def _entered(self, base: SelectedBase) -> SelectedBase:
        base.enter()
        if (known := self._statuses.get(base.ingest)) is not None:
            base.status(*known)
        return base


def receiving(preset: Preset) -> str:
    """Return the ingest that receives a preset: one of the file that it names, or its own."""
    source = preset.sources[0]
    return source.removeprefix("ingest://").partition("?")[0] if source.startswith("ingest://") else ingest_id(preset.id)


def _question_of(query: Query) -> Question | Refusal | None:
    """Return the question in a query: a body or an envelope as its payload, or a bare ``?type=RTK-LIST``."""
    if query.payload:
        return read_any(query.payload)
    named = [part.removeprefix("type=") for part in query.parameters.replace("&", ";").split(";") if part.startswith("type=")]
    return Question({"type": named[0]}) if named else None


def _say_busy(item: Any) -> None:
    if isinstance(item, Asked):
        item.query.reply(bare(refused("too many messages wait")), JSON)
