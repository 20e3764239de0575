"""From a table to what takes its frames or texts."""

from functools import partial

from rtkmesh_schemas.config import OutputTable
from rtkmesh_schemas.keys import TEXT, WRITE
from rtkmesh_schemas.status import Level
from rtkmesh_services.output.caster_sink import CasterSink
from rtkmesh_services.output.files import FileSink
from rtkmesh_services.output.sender import Preface
from rtkmesh_services.output.sinks import BusSink, Sink, sender_sink
from rtkmesh_services.output.targets import CASTER_SCHEME, TargetUrl, parse_target, text_stream
from rtkmesh_services.runtime.port_owners import ingest_of_port
from rtkmesh_services.runtime.service import Context


def open_sink(context: Context, table: OutputTable, preface: Preface) -> Sink:
    """Return what takes one solver's texts or one receiver's frames; SourceError for a wrong target."""
    url = parse_target(table.target)
    if url.scheme == "file":
        return FileSink(url, preface, context.clock, partial(_say_file, context))
    if url.scheme == "zenoh":
        return BusSink(context.bus, context.id, text_stream(url) if url.path else TEXT, preface, attached=True)
    if receiver := _receiver_of(context, url, table):
        return BusSink(context.bus, receiver, WRITE, preface, attached=False)
    return sender_sink(url, preface, table)


def open_caster(context: Context, table: OutputTable, form: str = "", header: bytes = b"") -> CasterSink | None:
    """Return our own caster where a table wants one. Without ``mounts`` its URL names the mount point of the one solver or receiver."""
    url = parse_target(table.target)
    if url.scheme != CASTER_SCHEME:
        return None
    feeders = dict(table.mounts) or {url.path: table.solver or table.receiver}
    return CasterSink(url, feeders, table, context.clock, form, header)


def _say_file(context: Context, path: str) -> None:
    context.event(Level.INFO, "writing", f"writing to {path}")


def _receiver_of(context: Context, url: TargetUrl, table: OutputTable) -> str:
    """Return the ingest over whose port it goes: a port has one owner."""
    if url.scheme == "ingest":
        return url.path
    return ingest_of_port(context.deployment, table.target) if url.scheme == "serial" else ""
