"""How fast the decoders are, beside pyubx2, pyrtcm, pysbf2, pynmeagps and convbin on the same bytes.

Usage: python benchmarks/decode_speed.py [--data FOLDER] [--quick]   (default: RTKMESH_DATA or ../shared/data)

Times are processor time of this process. Each case runs our code several times and takes the best (the machine may be shared); MB/s are
of the bytes of the frames decoded. Streams are fed in the pieces that the ingest reads. The Python oracle runs once on the first part of
the file, because it takes milliseconds per message. The second table is what a solver waits for: a decoder that has run from the
beginning of the recording gets one epoch's bytes at once, up to the message that ends the epoch, and the time from there to the epoch is
taken, for every epoch of the recording; of several runs each epoch's best counts. The third table is the ingest's path on whole
recordings (`whole_recordings.py`). Tables go to standard output.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from pyrtcm import RTCMReader
from pysbf2 import SBFReader
from pyubx2 import UBXReader

import kernel_cache  # noqa: F401  first of all
from load_streams import decoded
from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Decoder, Frame, Protocol
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_epoch
from rtkmesh.codecs.sbf import SbfDecoder
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx import RAWX, SFRBX, UbxDecoder
from rtkmesh.codecs.unicore import UnicoreDecoder
from rtkmesh.codecs.unicore_encode import encode_compressed, encode_observations, encode_observations_ascii
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime
from whole_recordings import COLUMNS, MADE_EPOCHS, RECORDINGS, Effort, aligned, as_septentrio, as_unicore, best_s, contents, pieces
from whole_recordings import line as recording_line

Run = tuple[Callable[[], int], int]  # returns the number of messages; the bytes that it decodes


@dataclass(frozen=True)
class Case:
    """One line of the first table: ``prepare`` returns what decodes the data; ``oracle`` does the same elsewhere."""

    name: str
    file: str
    prepare: Callable[[bytes], Run]
    oracle: Callable[[bytes], int] | None = None


@dataclass(frozen=True)
class LiveCase:
    """One line of the second table."""

    name: str
    file: str


def framing(data: bytes) -> Run:
    def run() -> int:
        framer = Framer()
        return sum(len(framer.feed(piece)) for piece in parts)

    parts = pieces(data)
    return run, len(data)


def decoding(frames: list[Frame], new_decoder: Callable[[], Decoder]) -> Run:
    """Decode these frames with what belongs to them: gathering of epochs, slips, sorting."""

    def run() -> int:
        decoder = new_decoder()
        for frame in frames:
            decoder.decode(frame)
        return len(frames)

    return run, sum(len(frame.data) for frame in frames)


def messages(protocol: Protocol, kinds: Collection[str], new_decoder: Callable[[], Decoder]) -> Callable[[bytes], Run]:
    """Decode the messages of these kinds."""
    return lambda data: decoding([frame for frame in Framer([protocol]).feed(data) if frame.kind in kinds], new_decoder)


RTCM_DATE = GpsTime.from_calendar(2018, 7, 14, 12)


def ubx_messages(kind: str) -> Callable[[bytes], Run]:
    return messages(Protocol.UBX, (kind,), UbxDecoder)


def rtcm_messages(*kinds: str) -> Callable[[bytes], Run]:
    return messages(Protocol.RTCM3, kinds, lambda: Rtcm3Decoder(RTCM_DATE))


def rtcm_encoding(data: bytes) -> Run:
    decoder = Rtcm3Decoder(RTCM_DATE)
    found = [message for frame in Framer([Protocol.RTCM3]).feed(data) for message in decoder.decode(frame)]
    epochs = [message for message in found if isinstance(message, Epoch)][:200]
    size = sum(len(frame) for epoch in epochs for frame in encode_epoch(epoch, 0))
    return lambda: sum(len(encode_epoch(epoch, 0)) for epoch in epochs), size


def sbf_blocks(data: bytes) -> list[Frame]:
    return [frame for frame in Framer([Protocol.SBF]).feed(as_septentrio(data)) if frame.kind in SBF_MEASUREMENTS]


def sbf_measurements(data: bytes) -> Run:
    """MeasEpoch with its MeasExtra, which together give an epoch."""
    return decoding(sbf_blocks(data), lambda: SbfDecoder(RTCM_DATE))


def pysbf2_measurements(data: bytes) -> int:
    frames = sbf_blocks(data)[:SBF_ORACLE]
    for frame in frames:
        SBFReader.parse(frame.data)
    return len(frames)


def unicore_logs(encode: Callable[[Epoch], bytes]) -> Callable[[bytes], Run]:
    """Decode a kind of observation log."""

    def prepare(data: bytes) -> Run:
        logs = b"".join(encode(epoch) for epoch in decoded(data)[0][:MADE_EPOCHS])
        return decoding(Framer([Protocol.UNICORE]).feed(logs), UnicoreDecoder)

    return prepare


def pyrtcm_messages(*kinds: str) -> Callable[[bytes], int]:
    def run(data: bytes) -> int:
        frames = [frame.data for frame in Framer([Protocol.RTCM3]).feed(data) if frame.kind in kinds]
        for frame in frames:
            RTCMReader.parse(frame)
        return len(frames)

    return run


def pyubx2_messages(kind: str) -> Callable[[bytes], int]:
    def run(data: bytes) -> int:
        frames = [frame.data for frame in Framer([Protocol.UBX]).feed(data) if frame.kind == kind]
        for frame in frames:
            UBXReader.parse(frame)
        return len(frames)

    return run


WALK, ROVER, BASE = "dec_ubx/gnss_imu_walk_1730.ubx", "umea_f9p/R001.ubx", "umea_f9p/B001.ubx"
MSM7_FILE, MSM4_FILE = "stromlo_rtcm/week-rollover-STR17.rtcm3", "stromlo_rtcm/week-rollover-STR24.rtcm3"
MSM7 = tuple(f"{group}7" for group in (107, 108, 109, 111, 112))
MSM4 = tuple(f"{group}4" for group in (107, 108, 109, 111, 112))
SBF_MEASUREMENTS = ("4027", "4000")
SBF_ORACLE = 60  # blocks
EPHEMERIDES = ("1019", "1020", "1042", "1044", "1045", "1046")
CASES = [
    Case("RXM-RAWX, 71 signals", WALK, ubx_messages(RAWX), pyubx2_messages(RAWX)),
    Case("RXM-RAWX, 53 signals", ROVER, ubx_messages(RAWX), pyubx2_messages(RAWX)),
    Case("RXM-SFRBX", BASE, ubx_messages(SFRBX), pyubx2_messages(SFRBX)),
    Case("framing, UBX", ROVER, framing),
    Case("framing, UBX with 91 % SFRBX", BASE, framing),
    Case("framing, UBX + NMEA", "dec_gpsd/ublox-zed-f9p_hpg1.11.log", framing),
    Case("framing, UBX + RTCM 3 damaged", "galway_m8p/base-20181004-1452.ubx.gz", framing),
    Case("MSM7, GPS alone", MSM7_FILE, rtcm_messages("1077"), pyrtcm_messages("1077")),
    Case("MSM7, 5 systems", MSM7_FILE, rtcm_messages(*MSM7), pyrtcm_messages(*MSM7)),
    Case("MSM4, 5 systems", MSM4_FILE, rtcm_messages(*MSM4), pyrtcm_messages(*MSM4)),
    Case("1004 and 1012", "dec_rtcm3/1012_first.rtcm", rtcm_messages("1004", "1012"), pyrtcm_messages("1004", "1012")),
    Case("RTCM ephemerides", "dec_rtcm3/eph.rtcm", rtcm_messages(*EPHEMERIDES), pyrtcm_messages(*EPHEMERIDES)),
    Case("SBF MeasEpoch and MeasExtra", MSM7_FILE, sbf_measurements, pysbf2_measurements),
    Case("Unicore OBSVMB", MSM7_FILE, unicore_logs(encode_observations)),
    Case("Unicore OBSVMCMPB", MSM7_FILE, unicore_logs(encode_compressed)),
    Case("Unicore OBSVMA", MSM7_FILE, unicore_logs(encode_observations_ascii)),
    Case("framing, RTCM 3", MSM7_FILE, framing),
    Case("framing, SBF", MSM7_FILE, lambda data: framing(as_septentrio(data))),
    Case("framing, Unicore", MSM7_FILE, lambda data: framing(as_unicore(data))),
    Case("encoding MSM7", MSM7_FILE, rtcm_encoding),
]
LIVE_CASES = [
    LiveCase("one live epoch, UBX, 53 signals", ROVER),
    LiveCase("one live epoch, UBX + SFRBX", BASE),
    LiveCase("one live epoch, UBX + NMEA", WALK),
    LiveCase("one live epoch, RTCM 3 MSM7, 5 systems", MSM7_FILE),
    LiveCase("one live epoch, RTCM 3 MSM4, 5 systems", MSM4_FILE),
]


def line(case: Case, folder: Path, effort: Effort) -> str:
    data = contents(folder / case.file)
    run, size = case.prepare(data)
    seconds, count = best_s(run, effort.repeats)
    ours_us = seconds / count * 1e6
    text = f"{case.name:32} {count:7d} {ours_us:10.2f} {size / seconds / 1e6:9.1f}"
    if case.oracle is None:
        return text
    part = data[: effort.peer_bytes]
    start = time.process_time()
    oracle_count = case.oracle(part)
    oracle_us = (time.process_time() - start) / oracle_count * 1e6
    return f"{text} {oracle_us:10.1f} {oracle_us / ours_us:8.0f}"


def epoch_pieces(data: bytes) -> list[bytes]:
    """Cut a stream behind each message that ends an epoch."""
    decoder, found, piece = StreamDecoder(StreamOptions(approximate_time=RTCM_DATE)), list[bytes](), b""
    for frame, messages in decoder.feed(data):
        piece += frame.data
        if any(isinstance(message, Epoch) for message in messages):
            found.append(piece)
            piece = b""
    return found


def live_line(case: LiveCase, folder: Path, effort: Effort) -> str:
    parts = epoch_pieces(contents(folder / case.file))
    best_ns = [2**62] * len(parts)
    for _ in range(effort.repeats):
        decoder = StreamDecoder(StreamOptions(approximate_time=RTCM_DATE))
        for k, piece in enumerate(parts):
            start = time.perf_counter_ns()
            found = decoder.feed(piece)
            best_ns[k] = min(best_ns[k], time.perf_counter_ns() - start)
            assert isinstance(found[-1][1][-1], Epoch)
    ordered, size = sorted(best_ns), sum(map(len, parts)) / len(parts)
    p50_us, p99_us = (ordered[round(share * (len(ordered) - 1))] / 1e3 for share in (0.5, 0.99))
    return f"{case.name:40} {len(parts):7d} {size:8.0f} {p50_us:10.1f} {p99_us:10.1f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = os.environ.get("RTKMESH_DATA") or str(Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--quick", action="store_true", help="less often, and less for the oracles")
    options = parser.parse_args()
    folder: Path = options.data
    effort = Effort(2, 60_000) if options.quick else Effort()
    if not folder.is_dir():
        print(f"{folder}: no such folder; give --data or set RTKMESH_DATA", file=sys.stderr)
        return 2
    print(f"{'case':32} {'msgs':>7} {'us/msg':>10} {'MB/s':>9} {'oracle us':>10} {'factor':>8}")
    for case in CASES:
        print(line(case, folder, effort), flush=True)
    print(f"\n{'bytes in to epoch out':40} {'epochs':>7} {'bytes':>8} {'p50 us':>10} {'p99 us':>10}")
    for live in LIVE_CASES:
        print(live_line(live, folder, effort), flush=True)
    print(f"\n{aligned(COLUMNS)}")
    for recording in RECORDINGS:
        print(recording_line(recording, folder, effort), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
