"""Recordings on disk: the kind is found from the content, faults are named."""

import gzip
from pathlib import Path

import hatanaka
import pytest

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.sbf_encode import encode_meas_epoch
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, ReferenceStation
from rtkmesh.gnss.epoch import Epoch, make_epoch
from rtkmesh.gnss.signals import signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.config import IngestTable
from rtkmesh_services.errors import SourceError
from rtkmesh_services.ingest.recording import RawRecording, Recording, RecordingKind, open_recording
from rtkmesh_services.ingest.replay import recording_of
from rtkmesh_services.ingest.urls import parse_source


def line(content: str, label: str) -> str:
    return f"{content:<60}{label:<20}\n"


OBSERVATIONS = (
    line(f"{'3.04':>9}{'':11}{'OBSERVATION DATA':<20}{'M':<20}", "RINEX VERSION / TYPE")
    + line(f"{'test':<20}{'':20}{'20240624 104145 UTC':<20}", "PGM / RUN BY / DATE")
    + line(" -3817680.7270  3562839.5216  3650159.2407", "APPROX POSITION XYZ")
    + line("G    2 C1C L1C", "SYS / # / OBS TYPES")
    + line("  2024    06    24    08    20   00.0000000     GPS", "TIME OF FIRST OBS")
    + line("", "END OF HEADER")
    + "".join(
        f"> 2024 06 24 08 20 {second:02d}.0000000  0  2\nG05  20590792.555 7 108205345.409 7\nG07  26127502.600 4 137300927.448 4\n"
        for second in range(20)
    )
).encode()


def written(folder: Path, data: bytes, name: str = "recording") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def epochs(recording: Recording) -> list[tuple[GpsTime, list[float]]]:
    return [(m.time, m.phase_cyc.tolist()) for m in recording.messages() if isinstance(m, Epoch)]


def test_rinex_observations(tmp_path: Path) -> None:
    """The station comes first, then the epochs; the position reaches the size."""
    recording = open_recording(written(tmp_path, OBSERVATIONS))
    assert recording.kind is RecordingKind.OBSERVATIONS
    messages = list(recording.messages())
    assert isinstance(messages[0], ReferenceStation)
    assert messages[0].position_ecef_m == (-3817680.7270, 3562839.5216, 3650159.2407)
    assert len(messages) == 21
    assert recording.position == recording.size == len(OBSERVATIONS)


@pytest.mark.parametrize("pack", [gzip.compress, hatanaka.rnx2crx, lambda text: gzip.compress(hatanaka.rnx2crx(text))])
def test_compressed_forms_give_the_same(pack, tmp_path: Path) -> None:
    """Gzip, Hatanaka, and Hatanaka in gzip hold the same epochs, whatever the file is called."""
    packed = pack(OBSERVATIONS)
    assert epochs(open_recording(written(tmp_path, packed, "anything.xyz"))) == epochs(open_recording(written(tmp_path, OBSERVATIONS)))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"no recording at all\n" * 1000, "no recording of a known kind"),
        (bytes(range(256)) * 100, "no recording of a known kind"),
        (gzip.compress(b""), "is empty"),
        (gzip.compress(OBSERVATIONS)[:12], "compression cut short"),
        (gzip.compress(OBSERVATIONS)[:12] + b"x" * 100, "damaged compression"),
        (OBSERVATIONS[:200], "END OF HEADER"),
        (OBSERVATIONS.replace(b"3.04", b"9.04"), "RINEX version"),
        (b"\x1f\x9d" + b"x" * 100, "recording"),
        (OBSERVATIONS.replace(b"OBSERVATION DATA", b"CLOCK DATA      "), "navigation"),
    ],
)
def test_faults_are_named(data: bytes, words: str, tmp_path: Path) -> None:
    """A file that cannot be used is a SourceError that names it and says why."""
    path = written(tmp_path, data)
    with pytest.raises(SourceError, match=words) as caught:
        open_recording(path)
    assert str(path) in str(caught.value)


def test_cut_gzip_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    """A compressed file that was cut short gives what it holds, and says so in its counters."""
    text = OBSERVATIONS + OBSERVATIONS[OBSERVATIONS.index(b"> 2024") :].replace(b" 08 20 ", b" 08 21 ")
    packed = gzip.compress(text)
    recording = open_recording(written(tmp_path, packed[: len(packed) - 60]))
    whole, cut = epochs(open_recording(written(tmp_path, text, "whole"))), epochs(recording)
    assert 0 < len(cut) < len(whole)
    assert cut == whole[: len(cut)]
    assert recording.decoding.rejected["file/compression cut short"] == 1


@pytest.mark.data
def test_cut_raw_log_is_read_as_far_as_it_goes(data: Path, tmp_path: Path) -> None:
    """The same for a raw log; gzip members one behind the other are one file."""
    packed = (data / "galway_m8p/base-20181004-1236.ubx.gz").read_bytes()
    cut = open_recording(written(tmp_path, packed[: len(packed) // 2]))
    assert len(epochs(cut)) > 50
    assert cut.decoding.rejected["file/compression cut short"] == 1
    log = gzip.decompress(packed)
    parts = open_recording(written(tmp_path, gzip.compress(log[:100000]) + gzip.compress(log[100000:]), "parts"))
    assert isinstance(parts, RawRecording)
    assert b"".join(parts.chunks()) == log


def test_missing_file_and_folder(tmp_path: Path) -> None:
    """A missing file and a folder are SourceErrors."""
    with pytest.raises(SourceError, match="does not exist"):
        open_recording(tmp_path / "absent.obs")
    with pytest.raises(SourceError, match="is a folder"):
        open_recording(tmp_path)


def kinds(messages: list[Message]) -> set[type]:
    return {type(message) for message in messages}


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "kind", "count"),
    [
        ("umea_f9p/R001.ubx", RecordingKind.UBX, 408),
        ("galway_m8p/base-20181004-1236.ubx.gz", RecordingKind.MIXED, 283),
        ("stromlo_rtcm/week-rollover-STR24.rtcm3", RecordingKind.RTCM3, 1134),
        ("kanagawa_2021_078_60s/SEPT078M1.21O", RecordingKind.OBSERVATIONS, 60),
        ("yamatogawa_walk/yamatogawa_rover.obs", RecordingKind.OBSERVATIONS, 203),
    ],
)
def test_real_recordings(name: str, kind: RecordingKind, count: int, data: Path) -> None:
    """The kinds of the recordings are found, and all their epochs, in rising order (their number: data/README.md)."""
    date = GpsTime.from_calendar(2018, 7, 14, 12) if kind is RecordingKind.RTCM3 else None
    recording = open_recording(data / name, date)
    assert recording.kind is kind
    times = [time for time, _ in epochs(recording)]
    assert len(times) == count if kind is not RecordingKind.MIXED else len(times) >= count  # RTKLIB gets only part of a mixed log
    assert times == sorted(times)
    assert recording.position == recording.size


@pytest.mark.data
def test_real_navigation(data: Path) -> None:
    """A navigation file gives the ionosphere first, then ephemerides."""
    recording = open_recording(data / "tokyo_static/base.nav")
    messages = list(recording.messages())
    assert recording.kind is RecordingKind.NAVIGATION
    assert isinstance(messages[0], KlobucharParameters)
    assert kinds(messages) == {KlobucharParameters, KeplerEphemeris, GlonassEphemeris}


@pytest.mark.data
@pytest.mark.parametrize("size", [1000, 65536])
def test_chunks_are_the_bytes_of_the_log(size: int, data: Path) -> None:
    """A raw log can be replayed byte for byte, also when it is compressed."""
    path = data / "galway_m8p/base-20181004-1236.ubx.gz"
    recording = open_recording(path)
    assert isinstance(recording, RawRecording)
    chunks = list(recording.chunks(size))
    assert b"".join(chunks) == gzip.decompress(path.read_bytes())
    assert max(map(len, chunks)) <= size


def test_a_log_in_sbf_is_played_by_the_antenna_that_its_table_names(tmp_path: Path) -> None:
    """Two antennas in one stream: one file, two ingests with RTKLIB's options."""
    start = GpsTime(2350, 302_400.0)
    columns = {"signal": [signal_number("1C")], "pseudorange_m": [2.2e7]}
    main, other = ([make_epoch(start + k, satellite=[number], **columns) for k in range(3)] for number in (5, 7))
    data = b"".join(encode_meas_epoch(a, others=b) for a, b in zip(main, other, strict=True))
    url = parse_source(f"file://{written(tmp_path, data, 'rover.sbf')}")
    for options, number in (("", 5), ("-AUX1", 7)):
        recording = recording_of(url, IngestTable(source=f"file://{tmp_path}/rover.sbf", options=options))
        found = [message for message in recording.messages() if isinstance(message, Epoch)]
        assert recording.kind is RecordingKind.SBF
        assert [(epoch.time, epoch.satellite.tolist()) for epoch in found] == [(start + k, [number]) for k in range(3)]
