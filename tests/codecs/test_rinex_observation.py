"""RINEX observation text to epochs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.errors import FormatError
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_id, satellite_number, signal_code, signal_number
from rtkmesh.gnss.time import GpsTime


def header(*lines: tuple[str, str]) -> str:
    return "".join(f"{content:<60}{label}\n" for content, label in (*lines, ("", "END OF HEADER")))


def first_line(version: str, system: str = "M") -> tuple[str, str]:
    return f"{version:>9}{'':11}{'OBSERVATION DATA':<20}{system:<20}", "RINEX VERSION / TYPE"


V3 = header(
    first_line("3.04"),
    ("G    4 C1C L1C D1C S1C", "SYS / # / OBS TYPES"),
    ("R    2 C1C L1C", "SYS / # / OBS TYPES"),
    ("C    2 C2I L2I", "SYS / # / OBS TYPES"),
    ("  2024    06    24    08    20   00.0000000     GPS", "TIME OF FIRST OBS"),
    ("  2 R01  1 R21 -4", "GLONASS SLOT / FRQ #"),
    ("station one", "MARKER NAME"),
    (" -3817680.7270  3562839.5216  3650159.2407", "APPROX POSITION XYZ"),
    ("        0.1500        0.0100       -0.0200", "ANTENNA: DELTA H/E/N"),
)
V3_EPOCH = (
    "> 2024 06 24 08 20 30.5000000  0  4\n"
    "R21  19379441.36006 103448784.55539\n"
    "G05  20590792.55547 108205345.40907      -105.331          46.938\n"
    "C01  36842422.530 7 191848164.080 7\n"
    "G07         0.000 0 137300927.44815     -2796.587\n"
)


def read(text: str | bytes) -> list[Epoch]:
    return list(ObservationReader(text))


def row(epoch: Epoch, satellite: str, signal: str) -> int:
    (index,) = np.flatnonzero((epoch.satellite == satellite_number(satellite)) & (epoch.signal == signal_number(signal)))
    return int(index)


def test_version_3_epoch() -> None:
    """All fields of an epoch are read, blanks and zeros are NaN, rows are sorted."""
    (epoch,) = read(V3 + V3_EPOCH)
    assert epoch.time == GpsTime.from_calendar(2024, 6, 24, 8, 20, 30.5)
    assert [satellite_id(s) for s in epoch.satellite] == ["G05", "G07", "R21", "C01"]
    g05, g07, r21 = row(epoch, "G05", "1C"), row(epoch, "G07", "1C"), row(epoch, "R21", "1C")
    assert (epoch.pseudorange_m[g05], epoch.phase_cyc[g05], epoch.doppler_hz[g05], epoch.cn0_dbhz[g05]) == (
        20590792.555,
        108205345.409,
        -105.331,
        46.938,
    )
    assert np.isnan(epoch.pseudorange_m[g07])
    assert epoch.phase_cyc[g07] == 137300927.448
    assert epoch.flags.tolist() == [0, SLIP, SLIP | HALF_CYCLE, 0]
    assert epoch.channel.tolist() == [NO_CHANNEL, NO_CHANNEL, -4, NO_CHANNEL]
    assert epoch.cn0_dbhz[r21] == 6 * 6 + 2.5  # the digit of the code, as there is no S1C
    assert np.isnan(epoch.lock_s).all()


def test_header_and_station() -> None:
    """The station is the antenna reference point: the marker plus height, east and north."""
    reader = ObservationReader(V3)
    assert reader.header.marker == "station one"
    assert reader.header.position_ecef_m == (-3817680.7270, 3562839.5216, 3650159.2407)
    station = reader.header.station()
    assert station.position_ecef_m is not None
    offset = np.array(station.position_ecef_m) - np.array(reader.header.position_ecef_m)
    assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm([0.15, 0.01, 0.02]), abs=1e-9)
    assert station.antenna_height_m == 0.15


def test_types_over_several_lines() -> None:
    """A list of types continues on lines without a system letter."""
    types = [f"{kind}{code}" for code in ("1C", "2W", "2L", "5Q") for kind in "CLDS"]
    text = header(
        first_line("3.05"),
        (f"G   {len(types):2d} " + " ".join(types[:13]), "SYS / # / OBS TYPES"),
        ("       " + " ".join(types[13:]), "SYS / # / OBS TYPES"),
    )
    fields = "".join(f"{20e6 + k:14.3f}  " for k in range(len(types)))
    (epoch,) = read(f"{text}> 2024 01 01 00 00  0.0000000  0  1\nG01{fields}\n")
    assert [signal_code(s) for s in epoch.signal] == ["1C", "2L", "2W", "5Q"]
    assert epoch.pseudorange_m.tolist() == [20e6, 20e6 + 8, 20e6 + 4, 20e6 + 12]


@pytest.mark.parametrize(("scale", "offset_s"), [("GPS", 0.0), ("GAL", 0.0), ("QZS", 0.0), ("BDT", 14.0), ("GLO", 18.0)])
def test_time_systems(scale: str, offset_s: float) -> None:
    """Times in BeiDou time and UTC become GPST."""
    text = V3.replace("     GPS", f"     {scale}") + V3_EPOCH
    assert read(text)[0].time - GpsTime.from_calendar(2024, 6, 24, 8, 20, 30.5) == offset_s


def test_beidou_b1_of_version_302() -> None:
    """RINEX 3.02 called B1I 1I; since 3.03 it is 2I, and 1P is B1C."""
    text = header(first_line("3.02"), ("C    2 C1I L1I", "SYS / # / OBS TYPES"))
    (epoch,) = read(text + "> 2014 01 01 00 00  0.0000000  0  1\nC11  20000000.000   100000000.000  \n")
    assert signal_code(int(epoch.signal[0])) == "2I"


def test_scale_factor() -> None:
    """Stored values are divided by SYS / SCALE FACTOR."""
    text = header(first_line("3.04"), ("G    2 C1C L1C", "SYS / # / OBS TYPES"), ("G  100  1 L1C", "SYS / SCALE FACTOR"))
    (epoch,) = read(text + "> 2014 01 01 00 00  0.0000000  0  1\nG11  20000000.000  1000000000.000  \n")
    assert (epoch.pseudorange_m[0], epoch.phase_cyc[0]) == (20000000.0, 1e7)


V2_TYPES = ("     5    C1    L1    P2    L2    C2", "# / TYPES OF OBSERV")
V2 = header(first_line("2.11"), V2_TYPES, ("  2018    10    04    12    00    0.0000000     GPS", "TIME OF FIRST OBS"))
V2_ROWS = {
    "G01": "  20239291.580   106358207.71109  20239292.600    82876527.60049  20239292.320  ",
    "R07": "  20182234.680   108037121.18009                  84028883.21818  20182234.760  ",
    "R06": "  19617947.760   104685152.44607                                                ",
}


def v2_epoch(*satellites: str, seconds: str = " 0.0000000", flag: int = 0) -> str:
    names = [satellites[k : k + 12] for k in range(0, len(satellites), 12)]
    lines = [f" 18 10 04 12 00 {seconds}  {flag}{len(satellites):3d}" + "".join(names[0])]
    lines += [" " * 32 + "".join(more) for more in names[1:]]
    return "\n".join([*lines, *(V2_ROWS.get(name, V2_ROWS["G01"]) for name in satellites)]) + "\n"


def test_version_2_codes() -> None:
    """C1 carries L1, P2 carries L2; a satellite without P2 carries L2 on C2."""
    (epoch,) = read(V2 + v2_epoch("G01", "R07", "R06"))
    rows = {(satellite, code): (metres, cycles) for satellite, code, metres, cycles, _, _ in epoch.rows()}
    assert set(rows) == {("G01", "1C"), ("G01", "2W"), ("G01", "2X"), ("R06", "1C"), ("R07", "1C"), ("R07", "2C")}
    assert rows["G01", "2W"] == (20239292.6, 82876527.6)
    assert rows["G01", "2X"][0] == 20239292.32
    assert np.isnan(rows["G01", "2X"][1])
    assert rows["R07", "2C"] == (20182234.76, 84028883.218)
    assert epoch.flags[row(epoch, "R07", "2C")] == SLIP


def test_version_2_code_of_a_phase_stays() -> None:
    """A satellite whose P2 is missing for one epoch keeps its L2 where it was: the ambiguity lives on."""
    without_p2 = V2_ROWS["G01"][:32] + " " * 16 + V2_ROWS["G01"][48:]
    second = v2_epoch("G01", seconds=" 1.0000000").replace(V2_ROWS["G01"], without_p2)
    _, epoch = read(V2 + v2_epoch("G01") + second)
    assert epoch.phase_cyc[row(epoch, "G01", "2W")] == 82876527.6
    assert np.isnan(epoch.phase_cyc[row(epoch, "G01", "2X")])


def test_version_2_many_satellites() -> None:
    """Satellites beyond the twelfth stand on continuation lines."""
    names = [f"G{k:02d}" for k in range(1, 31)]
    (epoch,) = read(V2 + v2_epoch(*names))
    assert sorted({satellite_id(s) for s in epoch.satellite}) == names


def test_version_2_blank_system_is_the_files() -> None:
    """A satellite without a letter is one of the header's system."""
    text = header(first_line("2.10", "G"), V2_TYPES) + v2_epoch("  5", " 12")
    assert [satellite_id(s) for s in np.unique(read(text)[0].satellite)] == ["G05", "G12"]


@pytest.mark.parametrize("flag", [2, 3, 4, 5])
def test_events_are_skipped_and_their_header_lines_applied(flag: int) -> None:
    """An event's lines are header lines: they hold from there on, and are no observations."""
    event = f"> {'':29}{flag} {2:2d}\n{'     moved':<60}COMMENT\n{'other place':<60}MARKER NAME\n"
    reader = ObservationReader(V3 + V3_EPOCH + event + V3_EPOCH.replace("30.5", "31.5"))
    assert len(list(reader)) == 2
    assert reader.header.marker == "other place"
    assert reader.counters.ignored == {f"rinex/event {flag}": 1}
    assert not reader.counters.rejected


def test_event_changes_the_types() -> None:
    """New observation types hold for the epochs behind the event."""
    event = f"{'':26}  4  1\n{'     2    L1    C1':<60}# / TYPES OF OBSERV\n"
    last = " 18 10 04 12 00  2.0000000  0  1G01\n 106358207.711    20239291.580\n"
    epochs = read(V2 + v2_epoch("G01") + event + last)
    assert len(epochs) == 2
    assert [row[1:4] for row in epochs[1].rows()] == [("1C", 20239291.58, 106358207.711)]


def test_slip_records_are_skipped() -> None:
    """Flag 6 (slips that the receiver repaired) brings no epoch; flag 1 (power failure) marks all phases as slipped."""
    epochs = read(V2 + v2_epoch("G01", flag=6) + v2_epoch("G01", seconds=" 1.0000000", flag=1))
    assert len(epochs) == 1
    assert (epochs[0].flags & SLIP).all()


def test_repeated_satellite_counts_once() -> None:
    """Of a satellite that an epoch names twice the first row counts."""
    text = V3 + "> 2024 06 24 08 20 30.5000000  0  2\nG05  20000000.000\nG05  21000000.000\n"
    reader = ObservationReader(text)
    (epoch,) = reader
    assert epoch.pseudorange_m.tolist() == [20e6]
    assert reader.counters.rejected == {"rinex/satellite twice": 1}


def test_damage_is_counted_and_passed_over() -> None:
    """A ruined epoch costs that epoch; the next is read."""
    text = V3 + "> 2024 06 24 08 xx 30.5000000  0  1\nG05  20000000.000\ngarbage\n" + V3_EPOCH
    reader = ObservationReader(text)
    assert len(list(reader)) == 1
    assert sum(reader.counters.rejected.values()) == 3


def test_truncated_file() -> None:
    """A file that ends within an epoch gives the epochs before it."""
    reader = ObservationReader((V3 + V3_EPOCH + V3_EPOCH.replace("30.5", "31.5"))[:-80])
    assert len(list(reader)) == 1
    assert reader.counters.rejected["rinex/truncated epoch"] == 1


def test_line_ends_do_not_matter() -> None:
    """CR LF, and lines cut behind their last value, give the same epochs."""
    plain, dos = read(V3 + V3_EPOCH), read((V3 + V3_EPOCH).replace("\n", "\r\n"))
    assert next(plain[0].rows()) == next(dos[0].rows())
    assert next(plain[0].rows())[5] == 46.938
    assert read(V3 + V3_EPOCH.rstrip("\n"))[0].phase_cyc.tolist() == pytest.approx(plain[0].phase_cyc.tolist(), nan_ok=True)


@pytest.mark.parametrize("text", ["", "nothing", V3[:200], V3.replace("OBSERVATION", "NAVIGATION "), V3.replace("3.04", "9.99")])
def test_what_is_no_observation_file(text: str) -> None:
    """FormatError says that a text is no RINEX observation file."""
    with pytest.raises(FormatError):
        ObservationReader(text)


@given(st.floats(-9.9e7, 9.9e8).map(lambda value: f"{value:14.3f}"))
def test_numbers_are_correctly_rounded(text: str) -> None:
    """Every F14.3 number becomes the same double that Python's own parser gives."""
    (epoch,) = read(V3 + f"> 2024 06 24 08 20 30.5000000  0  1\nG05  20000000.000  {text}\n")
    value = float(text)
    assert epoch.phase_cyc[0] == value if value else np.isnan(epoch.phase_cyc[0])


@settings(max_examples=80)
@given(st.binary(max_size=60), st.integers(0, len(V2)), st.sampled_from([V3 + V3_EPOCH * 2, V2 + v2_epoch("G01", "R07") * 3]))
def test_damage_never_raises_anything_else(damage: bytes, at: int, text: str) -> None:
    """Whatever is written over a file: epochs, counters or FormatError, nothing else."""
    whole = text.encode()
    place = at * len(whole) // len(V2)
    try:
        for epoch in ObservationReader(whole[:place] + damage + whole[place + len(damage) // 2 :]):
            assert (np.diff(epoch.satellite.astype(int) * 512 + epoch.signal) > 0).all()
    except FormatError:
        pass
