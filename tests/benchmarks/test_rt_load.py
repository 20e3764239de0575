"""The real-time driver: every epoch that is sent and answered is counted, once, with what its answer says."""

import json
import os
import socket
import struct
import threading
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rtkmesh.gnss.time import GpsTime
from rtkmesh.simulation.scenario import open_stream

NAMES = ("rt_load", "rt_logs", "rt_targets", "rt_judgement")
EPOCHS, WARM, INTERVAL_S = 40, 10, 0.02
FIRST_S = 2200 * 604800.0 + 3600.0
PLACE_M = (4000000.0, 300000.0, 4900000.0)


def server(rover: int, base: int, out: socket.socket, lost: int) -> None:
    """Answer each rover epoch, whose bytes are its time of week, with a solution; not that of this number, and the next one twice."""
    bases, feed = socket.create_connection(("127.0.0.1", base)), socket.create_connection(("127.0.0.1", rover))
    with bases, feed, out.accept()[0] as answer:
        for k in range(EPOCHS):
            [tow] = struct.unpack("<d", feed.recv(8, socket.MSG_WAITALL))
            line = json.dumps({"tow": tow, "q": 1 if k % 2 else 2, "age": 0.0, "xyz": [PLACE_M[0] + 0.1, *PLACE_M[1:]]}) + "\n"
            answer.sendall(line.encode() * (0 if k == lost else 2 if k == lost + 1 else 1))
        feed.recv(1)  # until the driver closes


def test_what_is_sent_and_answered_is_counted(benchmarks: SimpleNamespace):
    load, lost = benchmarks.rt_load, 20
    times = FIRST_S + np.arange(EPOCHS) * 1.0
    log = benchmarks.rt_logs.Log("rtcm3", times, [struct.pack("<d", t % benchmarks.rt_judgement.WEEK) for t in times], b"")
    rover, base = benchmarks.rt_targets.free_ports(2)
    with socket.create_server(("127.0.0.1", 0)) as out:
        answering = threading.Thread(target=server, args=(rover, base, out, lost), daemon=True)
        target = benchmarks.rt_targets.External([os.getpid()], [f"connect:{out.getsockname()[1]}"])
        target.start = lambda: (benchmarks.rt_targets.External.start(target), answering.start())
        report = load.run(
            log, log, target, f"listen:{rover}", f"listen:{base}", interval=INTERVAL_S, seconds=(EPOCHS - WARM) * INTERVAL_S, warm=WARM,
            truth=PLACE_M, drain=1.0,
        )  # fmt: skip
        answering.join()
    [entry] = report["targets"]
    assert (report["epochs_sent"], report["rover_bytes_per_epoch"], report["connected"]) == (EPOCHS, 8, {"rover": 1, "base": 1})
    assert (entry["epochs"], entry["missing_first"]) == (EPOCHS - WARM, [lost])
    assert entry["solved_pct"] == pytest.approx(100 * 29 / 30, abs=0.01)
    assert (entry["duplicates"], entry["unmatched"], entry["out_of_order"]) == (1, 0, 0)
    assert entry["q_pct"] == {"1": pytest.approx(100 * 15 / 29, abs=0.1), "2": pytest.approx(100 * 14 / 29, abs=0.1)}
    assert entry["age_hist"] == {"0": 29}
    assert entry["fixed_error_m"]["p50"] == pytest.approx(0.1, abs=1e-6)
    assert entry["latency_ms"]["max"] >= entry["latency_ms"]["p50"] > 0.0
    assert (entry["processes"], entry["exit_codes"]) == (1, [None])
    assert entry["cpu_s"] > 0.0


@pytest.mark.parametrize(("antenna", "fmt", "last"), [("rover", "ubx", 0x0215), ("base", "rtcm3", 1127)])
def test_a_log_is_cut_behind_its_observations(benchmarks: SimpleNamespace, tmp_path: Path, antenna: str, fmt: str, last: int):
    """Nothing in between is lost, and a torn frame at its end belongs to no epoch; ephemerides of RTCM are known at once."""
    start = GpsTime(2400, 604797.0)  # the week ends in between
    stream = open_stream("demo", antenna, seed=1, rate_hz=1.0, start=start)
    epochs = list(islice(stream.epochs(), 6))
    path = tmp_path / "log"
    path.write_bytes(b"".join(epoch.data for epoch in epochs) + epochs[0].data[:20])
    log = benchmarks.rt_logs.load_log(str(path))
    assert log.format == fmt
    assert np.diff(log.times) == pytest.approx(np.ones(5), abs=1e-3)
    assert log.times[0] % benchmarks.rt_judgement.WEEK == pytest.approx(start.tow_s, abs=1e-3)
    assert path.read_bytes().startswith(b"".join(log.chunks))
    assert bool(log.prime) == (fmt == "rtcm3")
    frames = benchmarks.rt_logs.ubx_frames if fmt == "ubx" else benchmarks.rt_logs.rtcm_frames
    assert [[kind for _, _, kind in frames(chunk)][-1] for chunk in log.chunks] == [last] * 6


def record(judgement, tow, moment, age_s=0.0):
    return judgement.Record(0, 0, tow, 1, age_s, None, moment)


def tally_of(judgement, records, sent_s):
    """What these records come to of epochs a second apart at the end of a week, sent at these moments."""
    tow, count = (judgement.WEEK - 2.0 + np.arange(len(sent_s))) % judgement.WEEK, len(sent_s)
    sent, index = judgement.Sent(count), np.arange(count)
    sent.rover[:] = sent_s
    tally = judgement.Tally(judgement.Plan(0.1, 1.0, count, index, index, []), sent, np.full(count, np.nan))
    tally.add_instance(records, tow, range(count))
    return tally


def test_solutions_belong_to_the_epoch_of_their_time_over_the_end_of_a_week(benchmarks: SimpleNamespace):
    """By the time of week or of day; late ones, those that come before others, and those of no epoch are told apart."""
    judgement = benchmarks.rt_judgement
    records = [
        record(judgement, ("tod", 86398.0), 10.02), record(judgement, ("tod", 0.0), 10.21), record(judgement, 604799.1, 10.35, 1.0),
        record(judgement, 30.0, 10.4),
    ]  # fmt: skip
    tally = tally_of(judgement, records, np.array([10.0, 10.1, 10.2, np.nan]))
    assert (tally.solved, tally.strangers, tally.duplicates, tally.unordered, tally.in_time) == (3, 1, 0, 1, 2)
    assert tally.latency == pytest.approx([20.0, 250.0, 10.0])
    assert (tally.age0, tally.missing, tally.shares) == (2, [3], [0.75])


def test_what_comes_back_after_an_outage_is_timed_from_its_end(benchmarks: SimpleNamespace):
    judgement = benchmarks.rt_judgement
    sent = judgement.Sent(0)
    sent.ups.append(("base", 100.0))
    records = [record(judgement, 1.0, 99.9), record(judgement, 2.0, 100.3, 4.0), record(judgement, 3.0, 101.0)]
    [told] = judgement.after_outages({"base": [90.0, 100.2]}, records, sent, 1.0)
    assert told == {"feed": "base", "reconnects_s": [0.2], "next_solution_s": 0.3, "next_age0_s": 1.0}
