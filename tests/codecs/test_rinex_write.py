"""RINEX files that we write: our reader, and hatanaka's compression and back, give the same values and flags."""

from dataclasses import fields, replace
from datetime import UTC, datetime
from math import nan
from typing import Any

import hatanaka
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.rinex_navigation import read_navigation
from rtkmesh.codecs.rinex_navigation_write import navigation_header, navigation_record
from rtkmesh.codecs.rinex_observation import ObservationReader
from rtkmesh.codecs.rinex_observation_rows import write_decimal
from rtkmesh.codecs.rinex_observation_write import Equipment, ObservationWriter, Survey
from rtkmesh.codecs.rinex_write import Origin
from rtkmesh.gnss.ephemeris import (
    Ephemeris,
    GlonassBias,
    GlonassEphemeris,
    KeplerEphemeris,
    KlobucharParameters,
    NavigationMessage,
    ReferenceStation,
)
from rtkmesh.gnss.epoch import HALF_CYCLE, SLIP, Epoch, make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime

NO_SHRINK = (Phase.explicit, Phase.reuse, Phase.generate)  # files come from a seed: smaller ones say no more
START = GpsTime(2400, 345600.25)
CODES = {"G": "1C 1W 2L 2W 5Q", "R": "1C 2P 3X", "E": "1C 5Q 6B 7Q 8Q", "C": "2I 1P 5P 6I 7I", "J": "1C 2L 5Q", "S": "1C 5I", "I": "5A 9A"}
KEPLER = {
    "G05": NavigationMessage.LNAV, "J02": NavigationMessage.LNAV, "E11": NavigationMessage.INAV, "E12": NavigationMessage.FNAV,
    "C23": NavigationMessage.D1, "C03": NavigationMessage.D2, "I05": NavigationMessage.LNAV,
}  # fmt: skip


def origin(version: float) -> Origin:
    return Origin(version, "rtkmesh", datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC), ("from a test",))


def written(epochs: list[Epoch], version: float = 3.05, equipment: Equipment | None = None) -> bytes:
    survey = Survey()
    for epoch in epochs:
        survey.add(epoch)
    writer = ObservationWriter(survey, origin(version), equipment or Equipment())
    return writer.header().encode("ascii") + b"".join(map(writer.epoch, epochs))


@st.composite
def files(draw: st.DrawFn) -> list[Epoch]:
    """A few epochs of any satellites with values missing here and there."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    letters = draw(st.lists(st.sampled_from(list(CODES)), min_size=1, max_size=7, unique=True))
    rows = [
        (satellite_number(f"{letter}{number:02d}"), signal_number(code))
        for letter in letters for number in rng.choice(30, 4, replace=False) + 1 for code in CODES[letter].split()
    ]  # fmt: skip
    epochs: list[Epoch] = []
    for k in range(draw(st.integers(1, 4))):
        chosen = [row for row in rows if rng.random() < 0.8] or rows[:1]
        count = len(chosen)
        satellite = np.array([satellite for satellite, _ in chosen])
        missing = rng.random((4, count)) < draw(st.sampled_from((0.0, 0.3)))
        phase = np.where(missing[1], nan, rng.uniform(-9e8, 9e9, count))
        epochs.append(make_epoch(
            START + k * draw(st.sampled_from((0.05, 1.0, 30.0))), satellite=satellite, signal=[signal for _, signal in chosen],
            channel=np.where(satellite // 64 == 1, satellite % 14 - 7, NO_CHANNEL), phase_cyc=phase,
            flags=np.where(np.isnan(phase), 0, rng.choice((0, SLIP, HALF_CYCLE, SLIP | HALF_CYCLE), count)),
            pseudorange_m=np.where(missing[0], nan, rng.uniform(1.9e7, 4.1e7, count)),
            doppler_hz=np.where(missing[2], nan, rng.uniform(-5e3, 5e3, count)),
            cn0_dbhz=np.where(missing[3], nan, rng.uniform(5.0, 60.0, count)),
        ))  # fmt: skip
    return epochs


def assert_equal(got: list[Epoch], expected: list[Epoch]) -> None:
    """Rows without code, phase and Doppler are none for the reader; what is printed has three decimals."""
    kept = [
        epoch.take(np.isfinite(epoch.pseudorange_m) | np.isfinite(epoch.phase_cyc) | np.isfinite(epoch.doppler_hz)) for epoch in expected
    ]
    kept = [one for one, epoch in zip(kept, expected, strict=True) if len(epoch)]
    assert [len(one) for one in got] == [len(one) for one in kept]
    for one, other in zip(got, kept, strict=True):
        assert abs(one.time - other.time) < 1e-6
        for name in ("satellite", "signal", "channel", "flags"):
            assert getattr(one, name).tolist() == getattr(other, name).tolist(), name
        for name in ("pseudorange_m", "phase_cyc", "doppler_hz", "cn0_dbhz"):
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0.0, atol=5.1e-4, err_msg=name)


@settings(max_examples=15, deadline=None, phases=NO_SHRINK)
@given(epochs=files(), version=st.sampled_from((3.05, 4.0)))
def test_our_reader_gets_everything_back(epochs: list[Epoch], version: float):
    reader = ObservationReader(written(epochs, version))
    assert_equal(list(reader), epochs)
    assert not reader.counters.rejected
    assert reader.header.version == version


@settings(max_examples=5, deadline=None, phases=NO_SHRINK)
@given(epochs=files())
def test_hatanaka_gets_the_same_text_back(epochs: list[Epoch]):
    """But for numbers between -1 and 1, which its programs write without the zero."""
    text = written(epochs)
    assert hatanaka.decompress(hatanaka.rnx2crx(text)).replace(b" -.", b"-0.").replace(b"  .", b" 0.") == text


def test_the_header_says_what_is_known():
    station = ReferenceStation(7, (3784992.7, 901280.71, 5037095.8123), 1.5, "LEIAR25.R3      NONE", "09330026", "RECEIVER X")
    names = [f"R{k:02d}" for k in range(1, 11)]
    one = make_epoch(
        START, satellite=[*map(satellite_number, names), satellite_number("G01")], signal=[signal_number("1C")] * 11,
        channel=[*range(-7, 3), NO_CHANNEL], pseudorange_m=[2e7] * 11,
    )  # fmt: skip
    text = written(
        [one, replace(one, time=START + 30.0)], equipment=Equipment("ROOF", station, None, GlonassBias(7, True, (1.5, nan, -2.25, nan)))
    )
    header = text[: text.index(b"END OF HEADER")].decode()
    assert all(len(line) <= 80 for line in header.splitlines())
    told = ObservationReader(text).header
    assert (told.marker, told.antenna, told.antenna_serial, told.receiver) == ("ROOF", "LEIAR25.R3      NONE", "09330026", "RECEIVER X")
    assert told.station().position_ecef_m == station.position_ecef_m
    assert (told.interval_s, told.observables) == (30.0, {"G": ("C1C",), "R": ("C1C",)})
    assert told.glonass_channels == {satellite_number(name): channel for name, channel in zip(names, range(-7, 3), strict=True)}
    assert " C1C    1.500 C1P    0.000 C2C   -2.250 C2P    0.000" in header
    assert f"{18:6d}{'':54}LEAP SECONDS" in header


def test_an_unknown_position_is_the_approximate_one():
    one = make_epoch(START, satellite=[5], signal=[28], pseudorange_m=[2e7])
    told = ObservationReader(written([one], equipment=Equipment(approximate_ecef_m=(1.0, 2.0, 3.0)))).header
    assert told.position_ecef_m == (1.0, 2.0, 3.0)
    assert b"UNKNOWN" in written([one])


def test_an_epoch_at_the_end_of_a_second_is_rounded_into_the_next():
    one = make_epoch(GpsTime(2400, 604799.99999997), satellite=[5], signal=[28], pseudorange_m=[2e7])
    assert b"\n> 2026 01 11 00 00  0.0000000  0  1\n" in written([one])


@settings(max_examples=300, deadline=None)
@given(st.floats(-1.1e9, 1.1e10))
def test_a_number_is_what_printf_makes_of_it(value: float):
    """But for the last digit where the fourth decimal is a tie; what does not fit, and nothing but zeros, stays blank."""
    out = np.full(20, ord(" "), np.uint8)
    there = write_decimal(out, 3, value)
    text, expected = out.tobytes().decode(), f"{value:14.3f}"
    assert text[:3] + text[17:] == " " * 6
    if len(expected) > 14 or float(expected) == 0.0 or abs(value) == 0.0005:  # a tie: zero here
        assert not there
        assert not text.strip()
        return
    assert abs(float(text) - float(expected)) < 1.1e-3
    assert text[3:17] == f"{float(text):14.3f}"


def test_values_that_are_not_there_are_blank():
    for value in (nan, 0.0, 4e-4, -4e-4, 1e11, -1e9, float("inf")):
        out = np.full(14, ord(" "), np.uint8)
        assert not write_decimal(out, 0, value)
        assert not out.tobytes().strip()


@st.composite
def ephemerides(draw: st.DrawFn) -> Ephemeris:
    """Ephemerides of every record there is, with values of the size that they have."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    name = draw(st.sampled_from([*KEPLER, "R07"]))
    toe = GpsTime(2400, 900.0 * draw(st.integers(8, 660)))
    if name == "R07":
        toe = toe + 18.0
        vectors = [tuple((rng.uniform(-1.0, 1.0, 3) * scale).tolist()) for scale in (2.5e7, 3e3, 1e-5)]
        return GlonassEphemeris(
            satellite_number(name), int(rng.integers(-7, 7)), round((toe.tow_s + 10782.0) % 86400.0 / 900.0), toe, toe + -1800.0,
            int(rng.integers(0, 2)), 4.0, 1, *vectors, tau_s=rng.uniform(-1e-4, 1e-4), gamma=rng.uniform(-1e-12, 1e-12),
            group_delay_s=rng.uniform(-1e-8, 1e-8),
        )  # type: ignore[arg-type]  # fmt: skip
    message = KEPLER[name]
    wide = {f.name: rng.uniform(-1e-3, 1e-3) for f in fields(KeplerEphemeris)}
    issue = int(rng.integers(0, 32))
    fixed: dict[str, Any] = {
        "satellite": satellite_number(name), "message": message, "iode": issue, "iodc": issue, "toe": toe, "toc": toe,
        "transmitted": toe + -600.0, "health": int(rng.integers(0, 2)),
        "accuracy_m": 2.8, "sqrt_a": 5153.7 + rng.uniform(), "eccentricity": rng.uniform(0.0, 0.02),
        "fit_s": {"E": 14400.0, "C": 10800.0}.get(name[0], 7200.0), "group_delay_s": (rng.uniform(-1e-8, 1e-8), rng.uniform(-1e-8, 1e-8)),
    }  # fmt: skip
    if name[0] in "GJI":
        fixed["group_delay_s"] = (fixed["group_delay_s"][0], 0.0)
    return KeplerEphemeris(**{**wide, **fixed})


@settings(max_examples=40, deadline=None, phases=NO_SHRINK)
@given(content=st.lists(ephemerides(), min_size=1, max_size=4), version=st.sampled_from((3.05, 4.0)))
def test_navigation_records_come_back(content: list[Ephemeris], version: float):
    """Every number to twelve digits, every time and issue exactly, in both versions and all systems."""
    text = navigation_header(origin(version), leap_seconds=18) + "".join(navigation_record(one, version) for one in content)
    got = read_navigation(text)
    assert not got.counters.rejected
    assert not got.counters.ignored
    assert (got.version, got.leap_seconds) == (version, 18)
    for one, other in zip(got.ephemerides, content, strict=True):
        assert type(one) is type(other)
        for field in fields(other):
            x, y = getattr(one, field.name), getattr(other, field.name)
            if isinstance(y, float | tuple):
                np.testing.assert_allclose(x, y, rtol=6e-13, atol=1e-30, err_msg=field.name)
            elif isinstance(y, GpsTime):
                assert abs(x - y) < 1e-6, field.name
            else:
                assert x == y, field.name


def test_the_ionosphere_of_all_systems_comes_back_in_version_3():
    content = [KlobucharParameters(system, (1.25e-8, 2e-8, -3e-8, 4e-8), (9e4, -1e5, 2e5, 3e5)) for system in "GCJI"]
    assert read_navigation(navigation_header(origin(3.05), content)).klobuchar == content
    assert "IONOSPHERIC" not in navigation_header(origin(4.0), content)


def test_a_message_without_a_record_is_refused():
    one = ephemeris_of("G05")
    with pytest.raises(ValueError, match="no RINEX record"):
        navigation_record(replace(one, message=NavigationMessage.CNAV), 3.05)


def ephemeris_of(name: str) -> KeplerEphemeris:
    zero = {field.name: 0.0 for field in fields(KeplerEphemeris)}
    times: dict[str, Any] = dict.fromkeys(("toe", "toc", "transmitted"), START)
    more = {"satellite": satellite_number(name), "message": KEPLER[name], "group_delay_s": (0.0, 0.0), "iode": 1, "iodc": 1, "health": 0}
    return KeplerEphemeris(**{**zero, **times, **more})  # type: ignore[arg-type]
