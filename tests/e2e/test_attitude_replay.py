"""The attitude process over Zenoh: the same recording, played twice by real processes, gives the same attitudes to the last bit."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.e2e.test_replay_equality import REPOSITORY, running

from rtkmesh_schemas.attitude import AttitudeMessage
from rtkmesh_schemas.keys import ATT, ATT_FILTERED
from rtkmesh_schemas.wire import decode, encode
from rtkmesh_services.control.endpoints import free_port
from rtkmesh_services.runtime.zenoh_bus import open_bus

# A pair of receivers as one body: its position, its baseline and a filter.
BODY = """
[solver.vector]
rover = "rover"
base = "base"
navigation = ["base"]
mode = "moving-base"
systems = "GRE"
frequencies = 2

[attitude.body]
solvers = ["vector"]
positions = ["rtk"]
points = { middle = { position_m = [35.0, 0.0, 0.0] } }
filter = {}

[attitude.body.antennas]
base = { position_m = [0.0, 0.0, 0.0], sigma_m = 0.05 }
rover = { position_m = [70.3, 0.0, 0.0], sigma_m = 0.05 }
"""
BLANK = {"start_id": "", "received_mono_ns": 0, "published_mono_ns": 0, "waited_ms": 0.0}


def played(data: Path, folder: Path, speed: str) -> tuple[list[bytes], list[bytes]]:
    """Play the recording; return the wire's bytes of all attitudes and of all filtered ones, without what belongs to the run."""
    port = free_port()
    file = folder / f"replay_{speed}_{port}.toml"
    text = (REPOSITORY / "config" / "replay_rtcm3.toml").read_text().replace("tcp/127.0.0.1:7547", f"tcp/127.0.0.1:{port}")
    file.write_text(text + BODY)
    found: tuple[list[bytes], list[bytes]] = ([], [])
    with running(file, data, "--speed", speed, "--exit-at-end") as process, open_bus("test", (f"tcp/127.0.0.1:{port}",)) as bus:
        for stream, kept in zip((ATT, ATT_FILTERED), found, strict=True):

            def take(payload: bytes, encoding: str, kept: list[bytes] = kept) -> None:
                kept.append(encode(msgspec.structs.replace(decode(AttitudeMessage, payload, encoding), **BLANK)))

            bus.subscribe(stream.key("body"), lambda sample, take=take: take(sample.payload, sample.encoding))
        assert process.wait(240.0) == 0
    return found


@pytest.mark.e2e
@pytest.mark.data
@pytest.mark.slow
def test_two_replays_give_the_same_attitudes_bit_for_bit(data: Path, tmp_path: Path) -> None:
    """Over a week's end, at different speeds: what arrives in another order, and at other times, changes nothing."""
    first, second = played(data, tmp_path, "max"), played(data, tmp_path, "60")
    for one, other in zip(first, second, strict=True):
        assert len(one) == len(other) > 1000
        assert one == other
    filtered = [decode(AttitudeMessage, payload) for payload in first[1]]
    assert [m.sequence for m in filtered] == list(range(len(filtered)))
    good = [m for m in filtered if m.integrity == "ok"]
    assert len(good) > 0.9 * len(filtered)
    assert np.ptp([m.heading_rad for m in good[100:]]) < 0.002
