"""The arithmetic of benchmarks/ingest_load.py, load_streams.py and whole_recordings.py: what comes at which rate, what is counted."""

import os
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
from pyubx2 import UBXReader

from rtkmesh.codecs.framing import Framer
from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.ubx import RAWX
from rtkmesh.codecs.ubx_encode import encode_rawx, encode_sfrbx
from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime

NAMES = ("load_streams", "ingest_load", "whole_recordings")


def rawx(tow_s: float) -> bytes:
    signals = [("G05", "1C"), ("G05", "2L"), ("E11", "1C")]
    return encode_rawx(
        make_epoch(
            GpsTime(2300, tow_s), satellite=[satellite_number(name) for name, _ in signals],
            signal=[signal_number(code) for _, code in signals], channel=[NO_CHANNEL] * 3, pseudorange_m=[2.2e7] * 3, phase_cyc=[1.1e8] * 3,
            doppler_hz=[1.0] * 3, cn0_dbhz=[41.0, 45.0, 38.0], lock_s=[9.0] * 3,
        )
    )  # fmt: skip


def test_what_is_broadcast_slowly_keeps_its_pace(benchmarks: SimpleNamespace):
    """Four slots a second: a second's frames are spread over them in order, and come before the epoch; then the seconds begin again."""
    epochs = [(float(k), b"E%d" % k) for k in range(12)]
    parts = benchmarks.load_streams.Parts(epochs, [[b"a", b"b", b"c", b"d", b"e"], [b"x"]])
    slots = benchmarks.load_streams.spread(parts, 4, 10)
    assert [data for _, data in slots] == [b"aE0", b"bE1", b"cE2", b"deE3", b"E4", b"E5", b"E6", b"xE7", b"aE8", b"bE9"]
    assert [tow_s for tow_s, _ in slots] == [float(k) for k in range(10)]


def test_a_recording_is_cut_behind_its_epochs(benchmarks: SimpleNamespace):
    """Two epochs a second: frames go with the epoch that they precede, slow ones with their second; seconds at the ends are cut off."""
    names = ["f0.0", "s", "f0.5", "s", "s", "f1.0", "f1.5", "s", "f2.0", "s", "f2.5", "x"]
    frames = [Frame(Protocol.UBX, name[0], name.encode()) for name in ["h", *names]]
    parts = benchmarks.load_streams.parts_of(
        frames, lambda one: one.kind == "s", lambda one: float(one.data[1:]) if one.kind == "f" else None
    )
    assert [tow_s for tow_s, _ in parts.epochs] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert parts.epochs[0][1] == b"hf0.0"
    assert parts.seconds == [[b"s"]]  # second 1: those of 0 and 2 may be incomplete


def test_u_blox_stream_goes_on_with_whole_frames_and_rising_times(benchmarks: SimpleNamespace):
    """A recording of three epochs is played again with later times; every RXM-RAWX has its NAV-SAT, which pyubx2 reads."""
    data = b"".join(encode_sfrbx(5, [0] * 10) + rawx(100.0 + k) for k in range(3))
    parts = benchmarks.load_streams.ubx_parts(data, 8)
    assert [tow_s for tow_s, _ in parts.epochs] == [100.0, 101.0, 102.0, 103.0, 104.0, 105.0, 106.0, 107.0]
    framer = Framer()
    frames = [one for _, epoch in parts.epochs for one in framer.feed(epoch)]
    assert framer.counters.bytes_skipped == framer.pending == 0
    assert [benchmarks.load_streams.rawx_tow_s(one.data) for one in frames if one.kind == RAWX] == [tow_s for tow_s, _ in parts.epochs]
    sat = UBXReader.parse(frames[1].data)
    assert (sat.identity, sat.numSvs, sat.iTOW) == ("NAV-SAT", 2, 100000)
    assert [(sat.gnssId_01, sat.svId_01, sat.cno_01), (sat.gnssId_02, sat.svId_02, sat.cno_02)] == [(0, 5, 45), (2, 11, 38)]


def test_latencies_are_of_counted_epochs_that_came(benchmarks: SimpleNamespace):
    """A lost epoch has none, and one before those that count is left out."""
    sent = {1.0: 1_000_000, 2.0: 2_000_000, 3.0: 3_000_000}
    assert benchmarks.ingest_load.latencies_ms(sent, {1.0: 9_000_000, 3.0: 5_500_000}, [2.0, 3.0]) == [2.5]
    assert np.isnan(benchmarks.ingest_load.quantile([], 50))


def test_processes_of_one_name_are_one_row(benchmarks: SimpleNamespace):
    """Two helpers that the system calls the same are summed up."""
    assert benchmarks.ingest_load.by_name({1: "hub", 2: "x", 3: "x"}, {1: 1.0, 2: 2.0, 3: 0.5}) == {"hub": 1.0, "x": 2.5}


def test_figures_of_a_process_are_the_systems(benchmarks: SimpleNamespace):
    """This process: its time is what it is told otherwise, within the clock's ticks, and it has some memory of its own."""
    times = os.times()
    assert benchmarks.ingest_load.cpu_s(os.getpid()) == pytest.approx(times.user + times.system, abs=0.1)
    assert benchmarks.ingest_load.pss_mib(os.getpid()) > 10.0
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE) as child:
        assert {os.getpid(), child.pid} <= benchmarks.ingest_load.family(os.getpid())


def test_a_recordings_line_counts_what_is_in_it(benchmarks: SimpleNamespace):
    """Five epochs: too few for a mean; the Python parser gets whole frames of the part; convbin is not asked."""
    whole = benchmarks.whole_recordings
    data = b"".join(rawx(100.0 + k) for k in range(5))
    got: list[int] = []

    def peer(part: bytes) -> int:
        got.append(whole.pyubx2(part))
        return got[-1]

    cells = whole.row(whole.Recording("five", "", "pyubx2", peer), data, whole.Effort(repeats=1, peer_bytes=3 * len(rawx(0.0))))
    assert cells[:3] == ("five", f"{len(data) / 1e6:.2f}", "5")
    assert (cells[4], cells[7], got) == ("", "", [3])
    assert cells[5].startswith("pyubx2 ")


def test_lines_of_the_recordings_are_aligned(benchmarks: SimpleNamespace):
    """Columns begin and end where those of the head do; ratios have a decimal where it counts."""
    whole = benchmarks.whole_recordings
    head, row = whole.aligned(whole.COLUMNS), whole.aligned(("a", "1.00", "3", "2.0", "", "pyubx2 0.55", "38", "8.2 (16)"))
    assert head.index(" epochs") + 7 == row.index("3 ") + 1
    assert len(head) == len(row)
    assert (whole.times(0.84), whole.times(9.94), whole.times(111.2)) == ("0.8", "9.9", "111")
