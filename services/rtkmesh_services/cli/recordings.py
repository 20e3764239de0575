"""Recordings that are read together: opened, dated, and what they held that could not be used."""

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

from rtkmesh.codecs.stream import StreamOptions
from rtkmesh.errors import OptionError
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.receiver_options import ReceiverOptions, parse_receiver_options
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.recording import Recording, RecordingKind, open_recording


def open_recordings(
    paths: list[Path], date: GpsTime | None, receiver_options: str = "", reject: frozenset[str] = frozenset()
) -> list[Recording]:
    """Return the opened recordings. An RTCM 3 log without ``date`` takes it from another of them, if one has it.

    ``receiver_options`` are RTKLIB's, for logs of receivers; SourceError for what they do not know. Frames in ``reject`` are not decoded.
    """
    receiver = _receiver(receiver_options)
    with ExitStack() as stack:
        recordings: list[Recording] = []
        for path in paths:
            recordings.append(open_recording(path, options=StreamOptions(approximate_time=date, receiver=receiver, reject=reject)))
            stack.callback(recordings[-1].close)
        undated = {recording.path for recording in recordings if recording.kind is RecordingKind.RTCM3}
        if date is None and undated:
            date = next((time for path in paths if path not in undated and (time := _first_epoch(path)) is not None), None)
            if date is None:
                raise SourceError(f"{min(undated)}: an RTCM 3 log carries no date, and nothing else here does: say --date YYYY-MM-DD")
            return open_recordings(paths, date, receiver_options, reject)
        stack.pop_all()
    return recordings


def _receiver(text: str) -> ReceiverOptions:
    try:
        return parse_receiver_options(text)
    except OptionError as error:
        raise SourceError(f"--receiver-options: {error}") from error


def faults(recordings: Iterable[Recording]) -> dict[str, dict[str, int]]:
    """Return per file what was rejected while reading it, by reason."""
    rejected = {recording.path.name: dict(recording.decoding.rejected) for recording in recordings}
    return {name: counts for name, counts in rejected.items() if counts}


def day_of(text: str) -> GpsTime:
    """Return noon of a day YYYY-MM-DD, the middle of what a log of that day can begin at; SourceError if it is none."""
    try:
        year, month, day = (int(part) for part in text.split("-"))
        return GpsTime.from_calendar(year, month, day, 12)
    except ValueError:
        raise SourceError(f"--date {text} is no day YYYY-MM-DD") from None


def _first_epoch(path: Path) -> GpsTime | None:
    return next((message.time for message in open_recording(path).messages() if isinstance(message, Epoch)), None)
