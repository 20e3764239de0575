"""How fast the decoders are, beside pyubx2 and pyrtcm on the same bytes.

Usage: python benchmarks/decode_speed.py [--data FOLDER]   (default: RTKMESH_DATA or ../shared/data)

Times are processor time of this process. Each case runs our code several times and takes the best (the machine may be shared); the
Python oracle runs once on the first part of the file, because it takes milliseconds per message. A table goes to standard output.
"""

import argparse
import gzip
import io
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pyrtcm import RTCMReader
from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import encode_epoch
from rtkmesh.codecs.stream import StreamDecoder
from rtkmesh.codecs.ubx import RAWX, SFRBX, UbxDecoder
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime

REPEATS = 7
ORACLE_BYTES = 300_000  # so much of a file is enough for a figure of the oracle


@dataclass(frozen=True)
class Case:
    """One line of the table: ``run`` decodes ``data`` and returns the number of messages; ``oracle`` does the same elsewhere."""

    name: str
    file: str
    run: Callable[[bytes], Callable[[], int]]
    oracle: Callable[[bytes], int] | None = None


def framing(data: bytes) -> Callable[[], int]:
    return lambda: len(Framer().feed(data))


def stream(data: bytes) -> Callable[[], int]:
    return lambda: len(StreamDecoder().feed(data))


def ubx_messages(kind: str) -> Callable[[bytes], Callable[[], int]]:
    def prepare(data: bytes) -> Callable[[], int]:
        frames: list[Frame] = [frame for frame in Framer([Protocol.UBX]).feed(data) if frame.kind == kind]

        def run() -> int:
            decoder = UbxDecoder()
            for frame in frames:
                decoder.decode(frame)
            return len(frames)

        return run

    return prepare


RTCM_DATE = GpsTime.from_calendar(2018, 7, 14, 12)


def rtcm_messages(*kinds: str) -> Callable[[bytes], Callable[[], int]]:
    """Decode the messages of these kinds with what belongs to them: gathering of epochs, slips, sorting."""

    def prepare(data: bytes) -> Callable[[], int]:
        frames = [frame for frame in Framer([Protocol.RTCM3]).feed(data) if frame.kind in kinds]

        def run() -> int:
            decoder = Rtcm3Decoder(RTCM_DATE)
            for frame in frames:
                decoder.decode(frame)
            return len(frames)

        return run

    return prepare


def rtcm_encoding(data: bytes) -> Callable[[], int]:
    decoder = Rtcm3Decoder(RTCM_DATE)
    messages = [message for frame in Framer([Protocol.RTCM3]).feed(data) for message in decoder.decode(frame)]
    epochs = [message for message in messages if isinstance(message, Epoch)][:200]
    return lambda: sum(len(encode_epoch(epoch, 0)) for epoch in epochs)


def pyrtcm_messages(*kinds: str) -> Callable[[bytes], int]:
    def run(data: bytes) -> int:
        frames = [frame.data for frame in Framer([Protocol.RTCM3]).feed(data) if frame.kind in kinds]
        for frame in frames:
            RTCMReader.parse(frame)
        return len(frames)

    return run


def pyubx2_reader(data: bytes) -> int:
    reader = UBXReader(io.BytesIO(data), protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE)
    return sum(1 for _ in reader)


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
EPHEMERIDES = ("1019", "1020", "1042", "1044", "1045", "1046")
CASES = [
    Case("RXM-RAWX, 71 signals", WALK, ubx_messages(RAWX), pyubx2_messages(RAWX)),
    Case("RXM-RAWX, 53 signals", ROVER, ubx_messages(RAWX), pyubx2_messages(RAWX)),
    Case("RXM-SFRBX", BASE, ubx_messages(SFRBX), pyubx2_messages(SFRBX)),
    Case("framing, UBX", ROVER, framing),
    Case("framing, UBX with 91 % SFRBX", BASE, framing),
    Case("framing, UBX + NMEA", "dec_gpsd/ublox-zed-f9p_hpg1.11.log", framing),
    Case("framing, UBX + RTCM 3 damaged", "galway_m8p/base-20181004-1452.ubx.gz", framing),
    Case("stream, UBX RAWX", ROVER, stream, pyubx2_reader),
    Case("stream, UBX RAWX + SFRBX", BASE, stream, pyubx2_reader),
    Case("stream, UBX + NMEA", WALK, stream, pyubx2_reader),
    Case("MSM7, GPS alone", MSM7_FILE, rtcm_messages("1077"), pyrtcm_messages("1077")),
    Case("MSM7, 5 systems", MSM7_FILE, rtcm_messages(*MSM7), pyrtcm_messages(*MSM7)),
    Case("MSM4, 5 systems", MSM4_FILE, rtcm_messages(*MSM4), pyrtcm_messages(*MSM4)),
    Case("1004 and 1012", "dec_rtcm3/1012_first.rtcm", rtcm_messages("1004", "1012"), pyrtcm_messages("1004", "1012")),
    Case("RTCM ephemerides", "dec_rtcm3/eph.rtcm", rtcm_messages(*EPHEMERIDES), pyrtcm_messages(*EPHEMERIDES)),
    Case("framing, RTCM 3", MSM7_FILE, framing),
    Case("encoding MSM7", MSM7_FILE, rtcm_encoding),
]


def contents(path: Path) -> bytes:
    return gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()


def best_s(run: Callable[[], int]) -> tuple[float, int]:
    run()  # compiled and warm
    best, count = float("inf"), 0
    for _ in range(REPEATS):
        start = time.process_time()
        count = run()
        best = min(best, time.process_time() - start)
    return best, count


def line(case: Case, folder: Path) -> str:
    data = contents(folder / case.file)
    seconds, count = best_s(case.run(data))
    ours_us = seconds / count * 1e6
    text = f"{case.name:32} {count:7d} {ours_us:10.2f} {len(data) / seconds / 1e6:9.1f}"
    if case.oracle is None:
        return text
    part = data[:ORACLE_BYTES]
    start = time.process_time()
    oracle_count = case.oracle(part)
    oracle_us = (time.process_time() - start) / oracle_count * 1e6
    return f"{text} {oracle_us:10.1f} {oracle_us / ours_us:8.0f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    default = os.environ.get("RTKMESH_DATA") or str(Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(default))
    folder: Path = parser.parse_args().data
    if not folder.is_dir():
        print(f"{folder}: no such folder; give --data or set RTKMESH_DATA", file=sys.stderr)
        return 2
    print(f"{'case':32} {'msgs':>7} {'us/msg':>10} {'MB/s':>9} {'oracle us':>10} {'factor':>8}")
    for case in CASES:
        print(line(case, folder), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
