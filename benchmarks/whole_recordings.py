"""Whole recordings through our decoders, the Python parsers and RTKLIB's convbin: bytes a second each, on the same bytes.

Ours is the ingest's path: pieces of 64 KiB through ``StreamDecoder`` with all its protocols. The Python parsers get the first part of a
recording (they take milliseconds a message), and ours is timed on that part again for the ratio; they give values of fields, not
epochs. convbin is a process that also starts, reads and writes files, and that passes over NMEA; all is processor time. Septentrio's and
Unicore's streams are encoded from the epochs of an RTCM 3 recording: there is no recording of theirs.
"""

import gzip
import io
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pynmeagps import NMEAReader
from pyrtcm import RTCMReader
from pysbf2 import SBFReader
from pyubx2 import ERR_IGNORE, NMEA_PROTOCOL, RTCM3_PROTOCOL, UBX_PROTOCOL, UBXReader

from load_streams import RTCM3_DATE, RTCM3_FILE, UBX_FILE, decoded, septentrio, unicore
from rtklib import run
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.gnss.epoch import Epoch
from rtkmesh_services.ingest.replay import date_of

PIECE: Final = 1 << 16  # what the ingest reads at once
MIXED: Final = UBX_PROTOCOL | NMEA_PROTOCOL | RTCM3_PROTOCOL
MADE_EPOCHS: Final = 300
EPOCHS_FOR_MEAN: Final = 100

Peer = Callable[[bytes], int]


@dataclass(frozen=True)
class Effort:
    """How often a figure is taken (the best counts), and how much of a recording the Python parsers get."""

    repeats: int = 7
    peer_bytes: int = 300_000


@dataclass(frozen=True)
class Recording:
    """One line. ``make`` makes the stream of the file's bytes; ``convbin`` is the format's name there, empty: it is not run."""

    name: str
    file: str
    peer_name: str
    peer: Peer | None
    convbin: str = ""
    date: str = ""
    make: Callable[[bytes], bytes] = bytes


def count_of(messages: Iterable[Any]) -> int:
    """Read a reader to its end; return the number of messages."""
    return sum(1 for _ in messages)


def pyubx2(data: bytes) -> int:
    return count_of(UBXReader(io.BytesIO(data), protfilter=MIXED, quitonerror=ERR_IGNORE))


def pyrtcm(data: bytes) -> int:
    return count_of(RTCMReader(io.BytesIO(data), quitonerror=ERR_IGNORE))


def pynmeagps(data: bytes) -> int:
    return count_of(NMEAReader(io.BytesIO(data), nmeaonly=False, quitonerror=ERR_IGNORE))


def pysbf2(data: bytes) -> int:
    return count_of(SBFReader(io.BytesIO(data), quitonerror=ERR_IGNORE))


def as_septentrio(data: bytes) -> bytes:
    """Return the epochs of an RTCM 3 recording as MeasEpoch, MeasExtra and PVTGeodetic."""
    return b"".join(septentrio(epoch) for epoch in decoded(data)[0][:MADE_EPOCHS])


def as_unicore(data: bytes) -> bytes:
    """Return the epochs of an RTCM 3 recording as OBSVM and BESTNAV."""
    return b"".join(unicore(epoch) for epoch in decoded(data)[0][:MADE_EPOCHS])


GALWAY, HPG = "galway_m8p/base-20181015-1654.ubx.gz", "dec_gpsd/ublox-zed-f9p_hpg1.11.log"
RECORDINGS: Final = (
    Recording("UBX RAWX", "umea_f9p/R001.ubx", "pyubx2", pyubx2, "ubx"),
    Recording("UBX RAWX, SFRBX", "umea_f9p/B001.ubx", "pyubx2", pyubx2, "ubx"),
    Recording("UBX RAWX, SFRBX, PVT, NMEA", UBX_FILE, "pyubx2", pyubx2, "ubx"),
    Recording("UBX RAWX, NMEA", HPG, "pyubx2", pyubx2, "ubx"),
    Recording("NMEA 10 Hz, UBX SFRBX", "galway_m8p/rover-20190416-1617.ubx.gz", "pyubx2", pyubx2, "ubx"),
    Recording("UBX, RTCM 3, NMEA, damaged", GALWAY, "pyubx2", pyubx2, "ubx", "2018-10-15"),
    Recording("RTCM 3 MSM7, ephemerides", RTCM3_FILE, "pyrtcm", pyrtcm, "rtcm3", RTCM3_DATE),
    Recording("RTCM 3 MSM4, ephemerides", "stromlo_rtcm/week-rollover-STR24.rtcm3", "pyrtcm", pyrtcm, "rtcm3", RTCM3_DATE),
    Recording("RTCM 3 ephemerides", "dec_rtcm3/eph.rtcm", "pyrtcm", pyrtcm, "rtcm3", "2018-07-11"),
    Recording("NMEA", "dec_gpsd/ublox-neo-m9n-nmea.log", "pynmeagps", pynmeagps),
    Recording("SBF measurements (encoded)", RTCM3_FILE, "pysbf2", pysbf2, "sbf", RTCM3_DATE, as_septentrio),
    Recording("Unicore OBSVM (encoded)", RTCM3_FILE, "", None, "", RTCM3_DATE, as_unicore),
)


def contents(path: Path) -> bytes:
    """Return a recording's bytes, uncompressed."""
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def pieces(data: bytes) -> list[bytes]:
    """Cut a stream into what the ingest reads at once."""
    return [data[at : at + PIECE] for at in range(0, len(data), PIECE)]


def decode(parts: list[bytes], date: str) -> int:
    """Decode a stream as the ingest does; return the number of epochs."""
    decoder = StreamDecoder(StreamOptions(approximate_time=date_of(date)))
    return sum(isinstance(message, Epoch) for part in parts for _, messages in decoder.feed(part) for message in messages)


def best_s(work: Callable[[], int], repeats: int) -> tuple[float, int]:
    """Return the processor time of the best of some runs, and what it counted; one run before is not counted."""
    count, best = work(), float("inf")
    for _ in range(repeats):
        begun_s = time.process_time()
        count = work()
        best = min(best, time.process_time() - begun_s)
    return best, count


def convbin_s(data: bytes, recording: Recording) -> float:
    """Return the processor time of convbin on a stream."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stream"
        file.write_bytes(data)
        argv = ["convbin", "-r", recording.convbin, "-v", "3.04", "-od", "-os", "-o", f"{folder}/a.obs", "-n", f"{folder}/a.nav"]
        when = ["-tr", recording.date.replace("-", "/"), "12:00:00"] if recording.date else []
        return run([*argv, *when, str(file)]).cpu_s


def per_s(size: int, seconds: float) -> float:
    """Return MB/s."""
    return size / max(seconds, 1e-9) / 1e6


def times(ratio: float) -> str:
    """Return how many times faster."""
    return f"{ratio:.1f}" if ratio < 10.0 else f"{ratio:.0f}"


def row(recording: Recording, data: bytes, effort: Effort) -> tuple[str, ...]:
    """Return the cells of a recording's line."""
    parts, part = pieces(data), data[: effort.peer_bytes]
    seconds, epochs = best_s(lambda: decode(parts, recording.date), effort.repeats)
    peer, theirs, ratio = "", "", ""
    if recording.peer is not None:
        ours_s, _ = best_s(lambda: decode([part], recording.date), effort.repeats)
        begun_s = time.process_time()
        recording.peer(part)
        peer_s = time.process_time() - begun_s
        peer, ratio = f"{recording.peer_name} {per_s(len(part), peer_s):.2f}", times(peer_s / ours_s)
    if recording.convbin and shutil.which("convbin"):
        convbin = convbin_s(data, recording)
        theirs = f"{per_s(len(data), convbin):.1f} ({times(convbin / seconds)})"
    each = f"{seconds / epochs * 1e6:.1f}" if epochs >= EPOCHS_FOR_MEAN else ""
    return recording.name, f"{len(data) / 1e6:.2f}", str(epochs), f"{per_s(len(data), seconds):.1f}", each, peer, ratio, theirs


NAME_WIDTH: Final = 28
WIDTHS: Final = (6, 6, 7, 9, 16, 6, 21)
COLUMNS: Final = ("whole recordings", "MB", "epochs", "MB/s", "us/epoch", "peer MB/s", "ratio", "convbin MB/s (ratio)")


def aligned(cells: tuple[str, ...]) -> str:
    """Return cells as a line of the table."""
    name, *figures = cells
    return f"{name:<{NAME_WIDTH}} " + " ".join(f"{cell:>{width}}" for cell, width in zip(figures, WIDTHS, strict=True)).rstrip()


def line(recording: Recording, folder: Path, effort: Effort) -> str:
    """Return a recording's line of the table."""
    return aligned(row(recording, recording.make(contents(folder / recording.file)), effort))
