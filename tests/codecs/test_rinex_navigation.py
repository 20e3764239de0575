"""RINEX navigation text to ephemerides; values against RTKLIB are in authority/test_rinex_against_rtklib.py."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.rinex_navigation import NavigationFile, read_navigation
from rtkmesh.errors import FormatError
from rtkmesh.gnss.ephemeris import GlonassEphemeris, KeplerEphemeris, KlobucharParameters, NavigationMessage
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_id
from rtkmesh.gnss.time import GpsTime


def header(version: str, kind: str, *lines: tuple[str, str]) -> str:
    rows = ((f"{version:>9}{'':11}{kind:<40}", "RINEX VERSION / TYPE"), *lines, ("", "END OF HEADER"))
    return "".join(f"{content:<60}{label}\n" for content, label in rows)


def record(first: str, values: list[float], *, start: int = 4, letter: str = "E") -> str:
    """Return a record: its first line with three numbers, then four a line."""
    fields = [f"{value:19.12E}".replace("E", letter) for value in values]
    lines = [first + "".join(fields[:3])]
    lines += [" " * start + "".join(fields[k : k + 4]) for k in range(3, len(fields), 4)]
    return "\n".join(lines) + "\n"


def kepler(toe_s: float, week: float, **changes: float) -> list[float]:
    """Return the 29 numbers of a plausible record: changes are given as ``v24=1.0``."""
    values = [1e-4, 2e-12, 0.0, 72.0, -98.2, 4.3e-9, 1.7, -5e-6, 5.9e-3, 1.8e-6, 5153.6, toe_s, 3e-8, 2.5, -5.8e-8, 0.97, 353.6]
    values += [1.27, -8.3e-9, -2.6e-10, 1.0, week, 0.0, 2.0, 0.0, -1.07e-8, 72.0, toe_s - 7200.0, 4.0]
    for name, value in changes.items():
        values[int(name[1:])] = value
    return values


V3 = header("3.04", "N: GNSS NAV DATA    M: MIXED")
GLONASS = [8.9e-5, 9.1e-13, 115200.0, -13736.8, -1.55, 9.3e-10, 0.0, -3309.2, -2.45, 1.8e-9, -4.0, 21242.4, -1.38, -1.8e-9, 1.0]


def one(text: str) -> KeplerEphemeris | GlonassEphemeris:
    file = read_navigation(text)
    assert not file.counters.rejected
    (ephemeris,) = file.ephemerides
    return ephemeris


def test_gps_record() -> None:
    """Every number of a record stands where its name says."""
    ephemeris = one(V3 + record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0)))
    assert isinstance(ephemeris, KeplerEphemeris)
    assert satellite_id(ephemeris.satellite) == "G05"
    assert ephemeris.message is NavigationMessage.LNAV
    assert ephemeris.toe == ephemeris.toc == GpsTime(2320, 122400.0)
    assert ephemeris.transmitted == GpsTime(2320, 115200.0)
    assert (ephemeris.iode, ephemeris.iodc, ephemeris.health, ephemeris.accuracy_m, ephemeris.fit_s) == (72, 72, 0, 2.0, 7200.0)
    assert (ephemeris.sqrt_a, ephemeris.eccentricity, ephemeris.m0_rad, ephemeris.delta_n_radps) == (5153.6, 5.9e-3, 1.7, 4.3e-9)
    assert (ephemeris.omega0_rad, ephemeris.omega_rad, ephemeris.omega_dot_radps) == (2.5, 1.27, -8.3e-9)
    assert (ephemeris.i0_rad, ephemeris.idot_radps) == (0.97, -2.6e-10)
    assert (ephemeris.cuc_rad, ephemeris.cus_rad, ephemeris.crc_m, ephemeris.crs_m) == (-5e-6, 1.8e-6, 353.6, -98.2)
    assert (ephemeris.cic_rad, ephemeris.cis_rad) == (3e-8, -5.8e-8)
    assert (ephemeris.af0_s, ephemeris.af1, ephemeris.af2, ephemeris.group_delay_s) == (1e-4, 2e-12, 0.0, (-1.07e-8, 0.0))


@pytest.mark.parametrize(("hours", "half_s"), [(0.0, 7200.0), (1.0, 7200.0), (4.0, 7200.0), (6.0, 10800.0)])
def test_fit_interval(hours: float, half_s: float) -> None:
    """The fit interval is given in hours; less than four is a flag of old files."""
    assert one(V3 + record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0, v28=hours))).fit_s == half_s


@pytest.mark.parametrize("week", [0.0, 2320.0, 2319.0, 272.0, 2321.0])
def test_week_number_does_not_matter(week: float) -> None:
    """toe is taken nearest to the clock's date, whatever the week number counts from."""
    late = record("G05 2024 06 23 00 00 00", kepler(0.0, week, v27=604000.0))
    ephemeris = one(V3 + late)
    assert isinstance(ephemeris, KeplerEphemeris)
    assert ephemeris.toe == GpsTime(2320, 0.0)
    assert ephemeris.transmitted == GpsTime(2319, 604000.0)


def test_unknown_transmission_time() -> None:
    """0.9999E9 says that the time of transmission is not known: toe stands in."""
    ephemeris = one(V3 + record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0, v27=0.9999e9)))
    assert ephemeris.transmitted == GpsTime(2320, 122400.0)


@pytest.mark.parametrize(
    ("sources", "message"),
    [(513, "INAV"), (516, "INAV"), (517, "INAV"), (258, "FNAV"), (2, "FNAV"), (1, "INAV"), (4, "INAV"), (0, "INAV")],
)
def test_galileo_messages(sources: int, message: str) -> None:
    """The data sources say whether the clock is that of I/NAV or of F/NAV."""
    ephemeris = one(V3 + record("E04 2024 06 24 08 00 00", kepler(115200.0, 2320.0, v20=float(sources), v23=-1.0)))
    assert isinstance(ephemeris, KeplerEphemeris)
    assert ephemeris.message is NavigationMessage[message]
    assert (ephemeris.iode, ephemeris.iodc, ephemeris.accuracy_m) == (72, 72, 500.0)


@pytest.mark.parametrize(("name", "message"), [("C05", "D2"), ("C11", "D1"), ("C58", "D1"), ("C59", "D2")])
def test_beidou_times(name: str, message: str) -> None:
    """BeiDou times are 14 s behind GPST, also over the end of a week; geostationary satellites send D2."""
    values = kepler(604790.0, 963.0, v27=604790.0, v28=3.0)
    ephemeris = one(V3 + record(f"{name} 2024 06 22 23 59 50", values))
    assert isinstance(ephemeris, KeplerEphemeris)
    assert ephemeris.message is NavigationMessage[message]
    assert ephemeris.toe == ephemeris.toc == ephemeris.transmitted == GpsTime(2320, 4.0)
    assert ephemeris.iodc == 3


def test_glonass_record() -> None:
    """GLONASS records are in UTC and kilometres; tau keeps RINEX's sign."""
    ephemeris = one(V3 + record("R01 2024 06 24 08 15 00", GLONASS))
    assert isinstance(ephemeris, GlonassEphemeris)
    assert ephemeris.toe == GpsTime.from_calendar(2024, 6, 24, 8, 15, 18.0)
    assert ephemeris.transmitted == GpsTime.from_calendar(2024, 6, 24, 8, 0, 18.0)
    assert ephemeris.position_m == (-13736.8e3, -3309.2e3, 21242.4e3)
    assert ephemeris.velocity_mps == (-1550.0, -2450.0, -1380.0)
    assert (ephemeris.channel, ephemeris.health, ephemeris.age_days) == (-4, 0, 1)
    assert (ephemeris.tau_s, ephemeris.gamma, ephemeris.iode) == (8.9e-5, 9.1e-13, 45)


@pytest.mark.parametrize(("written", "channel"), [(5.0, 5), (252.0, -4), (99.0, NO_CHANNEL)])
def test_glonass_channels(written: float, channel: int) -> None:
    """A channel written as an unsigned byte is understood; nonsense is not a channel."""
    values = [*GLONASS[:10], written, *GLONASS[11:]]
    assert one(V3 + record("R01 2024 06 24 08 15 00", values)).channel == channel


def test_glonass_of_version_305() -> None:
    """RINEX 3.05 adds a line with URA and the delay between L2 and L1."""
    text = header("3.05", "N: GNSS NAV DATA    M: MIXED") + 2 * record("R01 2024 06 24 08 15 00", [*GLONASS, 179.0, 4.6e-9, 2.5, 1.0])
    file = read_navigation(text)
    assert len(file.ephemerides) == 2
    assert isinstance(file.ephemerides[0], GlonassEphemeris)
    assert (file.ephemerides[0].group_delay_s, file.ephemerides[0].accuracy_m) == (4.6e-9, 2.5)


@pytest.mark.parametrize(
    ("kind", "first", "name"),
    [("N: GPS NAV DATA", " 5 24  6 24 10  0  0.0", "G05"), ("L: GALILEO NAV DATA", "12 24  6 24 10  0  0.0", "E12")],
)
def test_version_2_kepler(kind: str, first: str, name: str) -> None:
    """RINEX 2: the system is the file's; D exponents; two-digit years."""
    ephemeris = one(header("2.11", kind) + record(first, kepler(122400.0, 2320.0), start=3, letter="D"))
    assert satellite_id(ephemeris.satellite) == name
    assert ephemeris.toe == GpsTime(2320, 122400.0)


def test_version_2_glonass() -> None:
    """RINEX 2 counts the message frame time from the day's beginning."""
    values = [*GLONASS[:2], 28800.0, *GLONASS[3:]]
    ephemeris = one(header("2.10", "GLONASS NAV DATA") + record(" 1 24  6 24  8 15  0.0", values, start=3, letter="D"))
    assert satellite_id(ephemeris.satellite) == "R01"
    assert ephemeris.transmitted == GpsTime.from_calendar(2024, 6, 24, 8, 0, 18.0)


def test_version_4_records() -> None:
    """RINEX 4: records that repeat version 3's are read, the others counted."""
    gps = record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0))
    ionosphere = "> ION G05 LNAV\n    2024 06 24 10 00 00 1.0E-08 1.0E-08-1.0E-07-1.0E-07\n"
    file = read_navigation(header("4.00", "N: GNSS NAV DATA    M: MIXED") + "> EPH G05 LNAV\n" + gps + ionosphere)
    assert len(file.ephemerides) == 1
    assert file.counters.ignored == {"rinex/ION G05 LNAV": 1}


def test_ionosphere_of_version_3() -> None:
    """The last set of each system counts; Galileo's is of another model."""
    text = header(
        "3.04",
        "N: GNSS NAV DATA    M: MIXED",
        ("GPSA   1.8626E-08  2.2352E-08 -1.1921E-07 -5.9605E-08", "IONOSPHERIC CORR"),
        ("GPSB   1.2902E+05  1.6384E+05 -1.9661E+05 -2.6214E+05", "IONOSPHERIC CORR"),
        ("GAL    1.6175E+02  6.6016E-01  1.9379E-02  0.0000E+00", "IONOSPHERIC CORR"),
        ("BDSA    .1118D-07   .7451D-08  -.5960D-07  -.5960D-07", "IONOSPHERIC CORR"),
        ("    18    18  1929     7GPS", "LEAP SECONDS"),
    )
    file = read_navigation(text)
    assert file.klobuchar == [
        KlobucharParameters("G", (1.8626e-08, 2.2352e-08, -1.1921e-07, -5.9605e-08), (129020.0, 163840.0, -196610.0, -262140.0))
    ]
    assert file.leap_seconds == 18


def test_ionosphere_of_version_2() -> None:
    """ION ALPHA and ION BETA are GPS's."""
    lines = (
        ("    1.0245D-08  7.4506D-09 -5.9605D-08 -5.9605D-08", "ION ALPHA"),
        ("    8.8064D+04  0.0000D+00 -1.9661D+05 -6.5536D+04", "ION BETA"),
    )
    (klobuchar,) = read_navigation(header("2.10", "NAVIGATION DATA", *lines)).klobuchar
    assert klobuchar == KlobucharParameters("G", (1.0245e-8, 7.4506e-9, -5.9605e-8, -5.9605e-8), (88064.0, 0.0, -196610.0, -65536.0))


def test_sbas_is_counted() -> None:
    """SBAS records are no orbit that the engine uses: counted, and the next record is found behind them."""
    text = V3 + record("S20 2024 06 24 08 15 00", GLONASS) + record("R01 2024 06 24 08 15 00", GLONASS)
    file = read_navigation(text)
    assert len(file.ephemerides) == 1
    assert file.counters.ignored == {"rinex/S": 1}


def test_cut_record() -> None:
    """A record that is cut short by the next one, or by the end of the file, costs only itself."""
    whole = record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0))
    cut = "".join(whole.splitlines(keepends=True)[:4]).replace("G05", "G06")
    file = read_navigation(V3 + cut + whole + cut)
    assert [satellite_id(e.satellite) for e in file.ephemerides] == ["G05"]
    assert file.counters.rejected == {"rinex/truncated record": 2}


@pytest.mark.parametrize("text", ["", "nothing", header("3.04", "OBSERVATION DATA    M"), V3[:100], header("1.00", "N")])
def test_what_is_no_navigation_file(text: str) -> None:
    """FormatError says that a text is no RINEX navigation file."""
    with pytest.raises(FormatError):
        read_navigation(text)


WHOLE = (V3 + record("G05 2024 06 24 10 00 00", kepler(122400.0, 2320.0)) + record("R01 2024 06 24 08 15 00", GLONASS)).encode()


@settings(max_examples=150)
@given(st.one_of(st.binary(max_size=40), st.sampled_from([b"nan", b"inf", b"1E999", b"9" * 19])), st.integers(0, len(WHOLE)))
def test_damage_never_raises_anything_else(damage: bytes, at: int) -> None:
    """Whatever is written over a file: ephemerides, counters or FormatError, nothing else."""
    try:
        file = read_navigation(WHOLE[:at] + damage + WHOLE[at + len(damage) :])
    except FormatError:
        return
    assert isinstance(file, NavigationFile)
