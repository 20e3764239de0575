"""The answers to Flockwave messages: a body in, a body out. Knows no transport; belongs to control's work loop.

Every message has its X- form, which is answered alike and whose body nobody checks against the schema first.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

import msgspec

import rtkmesh
from rtkmesh_schemas.flockwave import (
    ELSEWHERE,
    NO_HANDLER,
    NO_PRESET,
    NO_SCHEMA,
    REQUESTS,
    Authentication,
    BeaconBasicProperties,
    Body,
    IdList,
    NewPreset,
    PresetInformation,
    Results,
    RTKConfigurationPreset,
    ServerVersion,
    Source,
    Statistics,
    Statuses,
    Survey,
    User,
    request_of,
)
from rtkmesh_schemas.presets import Preset
from rtkmesh_services.control.flockwave.envelope import acknowledged, refused
from rtkmesh_services.control.flockwave.survey import SETTINGS_INVALID, SurveyError, SurveySettings, is_list, is_map
from rtkmesh_services.errors import ServiceError
from rtkmesh_services.runtime.logs import clean

PRESET_MISMATCH: Final = "Preset does not match expected schema"
EXTENDED: Final = "X-"
Respond = Callable[[Body], None]


class Presets(Protocol):
    """The presets and which one is selected, as ``control.presets.PresetBook`` has them; ServiceError says why something cannot be done."""

    def ids(self) -> list[str]:
        """Return the ids in the order in which they came."""
        ...

    def get(self, id: str) -> Preset | None:  # noqa: A002
        """Return a preset, or None."""
        ...

    def new(self, fields: Mapping[str, Any]) -> str:
        """Make a user's preset; return its id."""
        ...

    def update(self, id: str, fields: Mapping[str, Any]) -> None:  # noqa: A002
        """Change fields of a user's preset."""
        ...

    def delete(self, id: str) -> None:  # noqa: A002
        """Forget a user's preset."""
        ...

    def save(self) -> None:
        """Keep the users' presets."""
        ...

    def selected(self) -> str | None:
        """Return the preset that is selected."""
        ...

    def select(self, id: str | None) -> None:  # noqa: A002
        """Select a preset, or none."""
        ...


class Surroundings(Protocol):
    """What the desk tells of and acts on beside the presets: the selected base."""

    def statistics(self, kind: str) -> Statistics:
        """Return the answer to RTK-STAT."""
        ...

    def settings(self) -> SurveySettings:
        """Return the present survey settings."""
        ...

    def selected_anew(self) -> None:
        """Somebody has chosen the source: what a client had set for its position counts no more."""
        ...

    def survey(self, settings: SurveySettings, respond: Respond) -> None:
        """Let the base follow settings, and respond when it does; SurveyError where it is known at once that it will not."""
        ...

    def connections(self) -> dict[str, dict[str, Any]]:
        """Return ConnectionInfo by id."""
        ...

    def beacons(self) -> dict[str, dict[str, Any]]:
        """Return BeaconStatusInfo by id."""
        ...

    def beacon_names(self) -> dict[str, BeaconBasicProperties]:
        """Return BeaconBasicProperties by id."""
        ...


class Desk:
    """Answers bodies."""

    def __init__(self, presets: Presets, surroundings: Surroundings) -> None:
        self._presets, self._around = presets, surroundings
        self._handlers: dict[str, Callable[[str, Mapping[str, Any]], Body]] = {
            "RTK-LIST": lambda kind, _: IdList(type=kind, ids=presets.ids()),
            "RTK-INF": self._information,
            "RTK-STAT": lambda kind, _: surroundings.statistics(kind),
            "RTK-SOURCE": self._source,
            "X-RTK-NEW": self._new,
            "X-RTK-UPDATE": self._update,
            "X-RTK-DEL": self._delete,
            "X-RTK-SAVE": self._save,
            "SYS-VER": lambda kind, _: ServerVersion(type=kind, software="rtkmesh", version=rtkmesh.__version__),
            "SYS-PING": lambda _, __: acknowledged(),
            "CONN-LIST": lambda kind, _: IdList(type=kind, ids=list(surroundings.connections())),
            "CONN-INF": lambda kind, body: _statuses(kind, body, surroundings.connections(), "No such connection"),
            "OBJ-LIST": self._objects,
            "BCN-INF": lambda kind, body: _statuses(kind, body, surroundings.beacons(), "No such beacon"),
            "BCN-PROPS": self._properties,
            "CLK-LIST": lambda kind, _: IdList(type=kind, ids=[]),
            "CLK-INF": lambda kind, body: _statuses(kind, body, {}, "No such clock"),
            "AUTH-INF": lambda kind, _: Authentication(type=kind, methods=[], required=False),
            "AUTH-WHOAMI": lambda kind, _: User(type=kind, user=""),
        }

    def answer(self, body: Mapping[str, Any], respond: Respond) -> None:
        """Answer a body, at once or, where a base has to be asked first, a moment later."""
        try:
            kind = _checked(body)
            if kind.removeprefix(EXTENDED) == "RTK-SURVEY":
                self._survey(kind, body, respond)
            else:
                respond(self._handler(kind)(kind, body))
        except ServiceError as error:
            respond(refused(str(error)))

    def _handler(self, kind: str) -> Callable[[str, Mapping[str, Any]], Body]:
        found = self._handlers.get(kind) or self._handlers.get(kind.removeprefix(EXTENDED))
        if found is None:
            raise SurveyError(NO_HANDLER)
        return found

    def _information(self, kind: str, body: Mapping[str, Any]) -> Body:
        ids = _ids(body)
        found = {id_: preset for id_ in ids if (preset := self._presets.get(id_)) is not None}
        told = {id_: _told(preset) for id_, preset in found.items()}
        return PresetInformation(type=kind, preset=told, error={id_: NO_PRESET for id_ in ids if id_ not in found})

    def _source(self, kind: str, body: Mapping[str, Any]) -> Body:
        if "id" not in body:
            return Source(type=kind, id=self._presets.selected())
        id_ = body["id"]
        if id_ is not None and (not isinstance(id_, str) or self._presets.get(id_) is None):
            raise SurveyError(NO_PRESET)
        if id_ != self._presets.selected():
            self._presets.select(id_)
        self._around.selected_anew()
        return acknowledged()

    def _survey(self, kind: str, body: Mapping[str, Any], respond: Respond) -> None:
        if "settings" not in body:
            respond(Survey(type=kind, settings=self._around.settings().told()))
            return
        settings = body["settings"]
        if settings is None:
            raise SurveyError(SETTINGS_INVALID)
        self._around.survey(self._around.settings().changed(settings), respond)

    def _new(self, kind: str, body: Mapping[str, Any]) -> Body:
        return NewPreset(type=kind, id=self._presets.new(_fields(body.get("preset"))))

    def _update(self, kind: str, body: Mapping[str, Any]) -> Body:
        updates = body.get("updates")
        changes: Mapping[str, Any] = updates if is_map(updates) else {}
        return _each(kind, _ids(body), lambda id_: self._change(id_, _fields(changes.get(id_))))

    def _change(self, id_: str, fields: Mapping[str, Any]) -> None:
        """Change a preset; a source that comes back as it was shown, without its password, is the one that it was."""
        preset = self._presets.get(id_)
        given = fields.get("sources")
        if preset is not None and is_list(given):
            shown = {clean(source): source for source in preset.sources}
            fields = {**fields, "sources": [shown.get(source, source) if isinstance(source, str) else source for source in given]}
        self._presets.update(id_, fields)

    def _delete(self, kind: str, body: Mapping[str, Any]) -> Body:
        return _each(kind, _ids(body), self._presets.delete)

    def _save(self, kind: str, body: Mapping[str, Any]) -> Body:
        del kind, body
        self._presets.save()
        return acknowledged()

    def _objects(self, kind: str, body: Mapping[str, Any]) -> Body:
        wanted = body.get("filter")
        return IdList(type=kind, ids=[] if isinstance(wanted, list) and "beacon" not in wanted else list(self._around.beacons()))

    def _properties(self, kind: str, body: Mapping[str, Any]) -> Body:
        names = self._around.beacon_names()
        ids = _ids(body)
        error = {id_: "No such beacon" for id_ in ids if id_ not in names}
        return Results(type=kind, result={id_: names[id_] for id_ in ids if id_ in names}, error=error)


def _checked(body: Mapping[str, Any]) -> str:
    """Return the type of a body that keeps to the schema; SurveyError else."""
    kind = body.get("type")
    if not isinstance(kind, str):
        raise SurveyError(NO_SCHEMA)
    if kind.startswith(EXTENDED):
        return kind
    try:
        if kind not in REQUESTS:
            raise SurveyError(NO_HANDLER if kind in ELSEWHERE else NO_SCHEMA)
        request_of(dict(body))
    except msgspec.ValidationError:
        raise SurveyError(NO_SCHEMA) from None
    return kind


def _ids(body: Mapping[str, Any]) -> list[str]:
    """Return the ids that are asked about, each once."""
    given = body.get("ids")
    return list(dict.fromkeys(name for name in given if isinstance(name, str))) if is_list(given) else []


def _fields(value: Any) -> Mapping[str, Any]:
    if not is_map(value):
        raise SurveyError(PRESET_MISMATCH)
    return value


def _told(preset: Preset) -> RTKConfigurationPreset:
    """Return a preset as it is shown: sources without their passwords."""
    sources = [clean(source) for source in preset.sources]
    values = {"id": preset.id, "title": preset.title, "format": preset.format, "sources": sources, "type": str(preset.type)}
    return msgspec.convert(values, RTKConfigurationPreset)


def _each(kind: str, ids: list[str], act: Callable[[str], None]) -> Body:
    """Do something with each preset; return of which it is done, and why not of the others."""
    result: dict[str, Any] = {}
    error: dict[str, str] = {}
    for id_ in ids:
        try:
            act(id_)
            result[id_] = True
        except ServiceError as fault:
            error[id_] = str(fault)
    return Results(type=kind, result=result, error=error)


def _statuses(kind: str, body: Mapping[str, Any], known: Mapping[str, dict[str, Any]], absent: str) -> Body:
    ids = _ids(body)
    error = {id_: absent for id_ in ids if id_ not in known}
    return Statuses(type=kind, status={id_: known[id_] for id_ in ids if id_ in known}, error=error)
