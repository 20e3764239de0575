"""Faults between the tables of a deployment: ids, references, options that exclude or need each other, where the hub listens."""

import re
from collections.abc import Mapping
from typing import Final

from rtkmesh.errors import OptionError
from rtkmesh.gnss.receiver_options import parse_receiver_options
from rtkmesh_schemas.config import LEAST_AMBIGUITIES, Deployment, IngestTable, SolverTable
from rtkmesh_schemas.config_attitude import AttitudeTable
from rtkmesh_schemas.errors import BadKeyError
from rtkmesh_schemas.keys import CONTROL_ID, HUB_ID, check_id
from rtkmesh_services.runtime.addresses import address_of, is_loopback
from rtkmesh_services.runtime.attitude_checks import check_attitude
from rtkmesh_services.runtime.file_faults import Faults
from rtkmesh_services.runtime.output_checks import check_output_table, check_ports
from rtkmesh_services.runtime.preset_checks import check_presets
from rtkmesh_services.runtime.rule_words import RuleError, parse_rule
from rtkmesh_services.runtime.telnet_checks import check_telnet
from rtkmesh_services.runtime.words import clip, nearest

MULTIPLE: Final = ("ingest", "solver", "attitude", "output", "recorder", "ros2", "monitor")
NAMED: Final = (*MULTIPLE, "preset", "rule", "telnet")  # all that are written [TABLE.NAME]
_SATELLITE: Final = re.compile(r"[GRECJSI]\d\d")
_LOOPBACK: Final = re.compile(r"(?:tcp|udp|quic|tls|ws)/(?:127\.\d+\.\d+\.\d+|localhost|\[::1\]):\d+|unixsock-stream/.+")


def check_deployment(reader: Faults, deployment: Deployment) -> None:
    """Gather the faults between tables: ids, references, where the hub listens."""
    owners: dict[str, str] = {HUB_ID: "hub", CONTROL_ID: "control"}
    for role in MULTIPLE:
        for id in getattr(deployment, role):  # noqa: A001  the word of the design
            _check_id(reader, owners, role, id)
    for id in deployment.ingest:  # noqa: A001
        _check_ingest(reader, id, deployment.ingest)
    for id, solver in deployment.solver.items():  # noqa: A001
        _check_reference(reader, "ingest", solver.rover, ("solver", id, "rover"))
        if solver.base:
            _check_reference(reader, "ingest", solver.base, ("solver", id, "base"))
        elif solver.mode != "single" and not solver.presets and not deployment.preset:
            reader.fault(("solver", id), f"[solver.{id}] has no 'base', which mode {solver.mode!r} needs")
        for index, navigation in enumerate(solver.navigation):
            _check_reference(reader, "ingest", navigation, ("solver", id, "navigation", str(index)))
        _check_solver(reader, id, solver)
        _check_interpolation(reader, id, solver, deployment.ingest)
    for id, table in deployment.attitude.items():  # noqa: A001
        _check_sources(reader, id, table)
        check_attitude(reader, id, table, deployment)
    for id in deployment.output:  # noqa: A001
        _check_output(reader, id, deployment)
    _check_lists(reader, deployment)
    _check_flockwave(reader, deployment)
    check_presets(reader, deployment)
    check_telnet(reader, deployment)
    _check_rules(reader, deployment)
    for index, address in enumerate(deployment.hub.listen):
        if not deployment.hub.insecure and not _LOOPBACK.fullmatch(address):
            reader.fault(
                ("hub", "listen", str(index)),
                f"[hub] listen: {address!r} is no loopback address; others could command your receivers: say insecure = true to allow it",
            )


def _check_flockwave(reader: Faults, deployment: Deployment) -> None:
    """Gather addresses that are none, and those that others reach though nobody said so."""
    for name in ("tcp", "udp"):
        text: str = getattr(deployment.flockwave, name)
        try:
            host = address_of(text)[0] if text else "localhost"
        except ValueError as error:
            reader.fault(("flockwave", name), f"[flockwave] {name}: {clip(text)!r} {error}")
            continue
        if not deployment.flockwave.insecure and not is_loopback(host):
            why = "is no loopback address; others could command your bases: say insecure = true to allow it"
            reader.fault(("flockwave", name), f"[flockwave] {name}: {clip(text)!r} {why}")


def _check_options(reader: Faults, id: str, text: str) -> None:  # noqa: A002
    try:
        parse_receiver_options(text)
    except OptionError as error:
        reader.fault(("ingest", id, "options"), f"[ingest.{id}] options: {error}")


def _check_ingest(reader: Faults, id: str, ingests: Mapping[str, IngestTable]) -> None:  # noqa: A002
    table = ingests[id]
    _check_options(reader, id, table.options)
    _check_corrections(reader, id, table)
    _check_base_station(reader, id, table)
    _check_followed(reader, id, ingests)


def _check_corrections(reader: Faults, id: str, table: IngestTable) -> None:  # noqa: A002
    for index, base in enumerate(table.corrections.bases if table.corrections else ()):
        path = ("ingest", id, "corrections", "from", str(index))
        if base == id:
            reader.fault(path, f"[ingest.{id}.corrections] from: a receiver does not correct itself")
        else:
            _check_reference(reader, "ingest", base, path)
    if table.corrections is not None and not table.corrections.bases:
        reader.fault(("ingest", id, "corrections", "from"), f"[ingest.{id}.corrections] from: names no base")


def _check_base_station(reader: Faults, id: str, table: IngestTable) -> None:  # noqa: A002
    station = table.base_station
    if station is None:
        return
    positions = [name for name in ("position_ecef_m", "position_llh_deg") if getattr(station, name) is not None]
    where = ("ingest", id, "base_station")
    if station.mode == "fixed" and len(positions) != 1:
        reader.fault(where, f"[ingest.{id}.base_station] mode 'fixed' needs either 'position_ecef_m' or 'position_llh_deg'")
    elif station.mode != "fixed" and positions:
        reader.fault((*where, positions[0]), f"[ingest.{id}.base_station] {positions[0]} is of mode 'fixed', not of {station.mode!r}")
    if station.mode == "preset" and not station.preset:
        reader.fault(where, f"[ingest.{id}.base_station] mode 'preset' needs 'preset', the name of a saved position")
    if station.mode in ("survey-in", "preset") and station.receiver == "other":
        text = f"mode {station.mode!r} needs 'receiver', whose language we speak: ublox, ublox-legacy, unicore, septentrio"
        reader.fault(where, f"[ingest.{id}.base_station] {text}; for other receivers there is mode 'average'")
    if table.position_ecef_m is not None or table.position_llh_deg is not None:
        reader.fault(where, f"[ingest.{id}.base_station] and a position of [ingest.{id}] itself: say it once, here")


def _check_solver(reader: Faults, id: str, solver: SolverTable) -> None:  # noqa: A002
    if solver.mode == "fixed" and solver.fixed_position_ecef_m is None:
        reader.fault(("solver", id, "mode"), f"[solver.{id}] mode 'fixed' needs 'fixed_position_ecef_m', where the rover is")
    if (solver.ambiguity.failure_rate or 1.0) < 1.0 and solver.integrity.enabled is False:
        text = "failure_rate needs [integrity] enabled: nothing else says how probably a fix is wrong"
        reader.fault(("solver", id, "ambiguity", "failure_rate"), f"[solver.{id}.ambiguity] {text}")
    if (solver.ambiguity.minimum_ambiguities or LEAST_AMBIGUITIES) < LEAST_AMBIGUITIES and solver.baseline_length_m is None:
        text = f"minimum_ambiguities: fewer than {LEAST_AMBIGUITIES} are believed only with 'baseline_length_m'"
        reader.fault(("solver", id, "ambiguity", "minimum_ambiguities"), f"[solver.{id}.ambiguity] {text}")
    for index, name in enumerate(solver.excluded):
        if not _SATELLITE.fullmatch(name):
            reader.fault(("solver", id, "excluded", str(index)), f"[solver.{id}] excluded: {clip(name)!r} is no satellite such as G05")


def _check_interpolation(reader: Faults, id: str, solver: SolverTable, ingests: Mapping[str, IngestTable]) -> None:  # noqa: A002
    """Base epochs are interpolated where the later one is known, and where the base stands."""
    live = [name for name in (solver.rover, solver.base, *solver.navigation) if name in ingests and not ingests[name].replay]
    reason = f"[ingest.{live[0]}] is live, and the next base epoch is not known yet: of recordings alone" if live else ""
    reason = "a moving base is not where it was" if solver.mode == "moving-base" else reason
    if solver.sync.interpolate and reason:
        reader.fault(("solver", id, "sync", "interpolate"), f"[solver.{id}.sync] interpolate: {reason}")


def _check_output(reader: Faults, id: str, deployment: Deployment) -> None:  # noqa: A002
    output = deployment.output[id]

    def fault(key: str, text: str) -> None:
        reader.fault(("output", id, *filter(None, key.split(".", 1))), f"[output.{id}] {text}")

    if not check_output_table(output, fault):
        return
    check_ports(deployment, id, fault)
    if output.solver:
        _check_reference(reader, "solver", output.solver, ("output", id, "solver"))
    if output.receiver:
        _check_reference(reader, "ingest", output.receiver, ("output", id, "receiver"))
    if output.scheme == "ingest":
        _check_reference(reader, "ingest", output.target.partition("://")[2], ("output", id, "target"))
    for mount, receiver in output.mounts.items():
        _check_reference(reader, "ingest", receiver, ("output", id, "mounts", mount))


def _check_sources(reader: Faults, id: str, table: AttitudeTable) -> None:  # noqa: A002
    if table.solver:
        _check_reference(reader, "solver", table.solver, ("attitude", id, "solver"))
    for key in ("solvers", "positions"):
        for index, name in enumerate(getattr(table, key)):
            _check_reference(reader, "solver", name, ("attitude", id, key, str(index)))
    for name in table.headings:
        _check_reference(reader, "ingest", name, ("attitude", id, "headings", name))


def _check_followed(reader: Faults, id: str, ingests: Mapping[str, IngestTable]) -> None:  # noqa: A002
    """An ingest that takes another one's frames needs one that publishes them, live."""
    for followed in ingests[id].follows:
        path, table = ("ingest", id, "source"), ingests.get(followed)
        if table is None:
            _check_reference(reader, "ingest", followed, path)
            continue
        reason = "publishes no frames: raw = false" if not table.raw else ""
        reason = "takes its frames from an ingest itself" if table.follows else reason
        reason = "is a recording: play it twice, the second time with ?antenna=2" if table.replay else reason
        if reason:
            reader.fault(path, f"[ingest.{id}] source: [ingest.{followed}] {reason}")


def _check_id(reader: Faults, owners: dict[str, str], role: str, id: str) -> None:  # noqa: A002
    try:
        check_id(id)
    except BadKeyError as error:
        reader.fault((role, id), f"[{role}.{id}] {error}")
    if id == "*":
        reader.fault((role, id), f"[{role}.{id}] '*' is no id")
    if id in owners:
        reader.fault((role, id), f"[{role}.{id}] the id {id!r} is taken by {owners[id]}: ids are unique over all roles")
    owners[id] = f"[{role}.{id}]"


def _check_lists(reader: Faults, deployment: Deployment) -> None:
    for id, table in deployment.recorder.items():  # noqa: A001
        for index, receiver in enumerate(table.receivers):
            _check_reference(reader, "ingest", receiver, ("recorder", id, "receivers", str(index)))
    for id, table in deployment.ros2.items():  # noqa: A001
        for index, solver in enumerate(table.solvers):
            _check_reference(reader, "solver", solver, ("ros2", id, "solvers", str(index)))
        for index, attitude in enumerate(table.attitudes):
            _check_reference(reader, "attitude", attitude, ("ros2", id, "attitudes", str(index)))
        for attitude, point in table.poses.items():
            _check_pose(reader, deployment, id, attitude, point)


def _check_pose(reader: Faults, deployment: Deployment, id: str, attitude: str, point: str) -> None:  # noqa: A002
    _check_reference(reader, "attitude", attitude, ("ros2", id, "poses", attitude))
    if attitude in deployment.attitude and point not in (points := deployment.attitude[attitude].points):
        there = nearest(point, list(points)) or f": write [attitude.{attitude}.points.{point}]"
        reader.fault(("ros2", id, "poses", attitude), f"[ros2.{id}] poses: [attitude.{attitude}] has no point {point!r}{there}")


def _check_rules(reader: Faults, deployment: Deployment) -> None:
    for name, table in deployment.rule.items():
        try:
            parse_rule(name, table)
        except RuleError as error:
            reader.fault(("rule", name, error.field), f"[rule.{name}] {error.field}: {error}")
    if deployment.rule and not deployment.control.enabled:
        reader.fault(("rule",), "[rule] needs [control] enabled: control is who acts on rules")


def _check_reference(reader: Faults, role: str, id: str, path: tuple[str, ...]) -> None:  # noqa: A002
    known = reader.names_of(role)
    if id not in known:
        there = nearest(id, known) or f"; there {'are' if len(known) != 1 else 'is'} {', '.join(known) or 'none'}"
        reader.fault(path, f"[{path[0]}.{path[1]}] {path[2]}: no [{role}.{id}]{there}")
