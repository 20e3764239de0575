"""A solver's table in RTKLIB's words and back; wrong words are refused with the nearest right one."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_schemas.config import AmbiguityTable, DynamicsTable, NoiseTable, SolverTable, SyncTable
from rtkmesh_services.conf.choices import DIALECTS, Dialect
from rtkmesh_services.conf.rows_positioning import ROWS
from rtkmesh_services.conf.solver_keys import SOLVER_ROWS, solver_options, with_solver_option
from rtkmesh_services.conf.solver_setters import ENGINE_DEFAULTS, effective
from rtkmesh_services.errors import ConfError

BLANK = SolverTable(rover="rover", base="base")
rounded = st.floats(0.01, 50.0).map(lambda value: float(f"{value:.6g}"))
tables = st.builds(
    SolverTable,
    rover=st.just("rover"),
    base=st.just("base"),
    mode=st.sampled_from(["single", "dgps", "static", "kinematic", "moving-base"]),
    systems=st.sets(st.sampled_from("GRECJSI"), min_size=1).map(lambda letters: "".join(c for c in "GRECJSI" if c in letters)),
    frequencies=st.integers(1, 4),
    elevation_mask_deg=rounded,
    cn0_mask_dbhz=rounded,
    max_age_s=rounded,
    baseline_length_m=rounded,
    baseline_sigma_m=rounded,
    excluded=st.lists(st.sampled_from(["G05", "R12", "E11", "C02", "J01", "S20"]), unique=True).map(tuple),
    sync=st.builds(SyncTable, matched_only=st.booleans(), interpolate=st.sampled_from([None, True])),
    noise=st.builds(NoiseTable, phase_a_m=rounded, phase_b_m=rounded, code_ratio=rounded),
    dynamics=st.builds(DynamicsTable, acceleration_horizontal_mps2=rounded, acceleration_vertical_mps2=rounded, ambiguity_cyc=rounded),
    ambiguity=st.builds(
        AmbiguityTable,
        mode=st.sampled_from(["off", "instantaneous", "continuous", "fix-and-hold"]),
        ratio=rounded.map(lambda value: value + 1.0),
        elevation_mask_deg=rounded,
        minimum_lock_epochs=st.integers(0, 100),
        minimum_ambiguities=st.integers(5, 20),
        hold_after_epochs=st.integers(1, 100),
    ),
)


@pytest.mark.parametrize("dialect", DIALECTS)
@given(table=tables)
def test_what_is_written_is_read_back(dialect: Dialect, table: SolverTable):
    """Every key of a table that RTKLIB has goes out and comes back the same; minfixsats is demo5's alone."""
    read = BLANK
    for line in solver_options(table, dialect):
        read, _ = with_solver_option(read, line.key, line.value, dialect)
    if dialect == "2.4":
        ambiguity = msgspec.structs.replace(read.ambiguity, minimum_ambiguities=table.ambiguity.minimum_ambiguities)
        read = msgspec.structs.replace(read, ambiguity=ambiguity)
    near = msgspec.structs.replace(read, ambiguity=msgspec.structs.replace(read.ambiguity, ratio=table.ambiguity.ratio))
    assert near == table
    assert read.ambiguity.ratio == pytest.approx(table.ambiguity.ratio, rel=1e-9)


def test_the_defaults_of_a_table_are_what_the_engine_uses():
    """What is None in a table is written as the engine's own value, which is looked up here."""
    from math import degrees

    from rtkmesh_services.mapping.options import rtk_options

    options = rtk_options(BLANK)
    for path in ENGINE_DEFAULTS:
        part, name = path.split(".")
        mask = name == "elevation_mask_deg"
        value = getattr(getattr(options, part), "elevation_mask_rad" if mask else name)
        assert effective(BLANK, path) == pytest.approx(degrees(value)) if mask else effective(BLANK, path) == value


# (key, value, dialect, key of our table, value there)
UNDERSTOOD = [
    ("pos1-posmode", "4", "2.4", "mode", "moving-base"),
    ("pos1-posmode", "4", "demo5", "mode", "static-start"),
    ("pos1-posmode", "5", "demo5", "mode", "moving-base"),
    ("pos1-posmode", " static", "demo5", "mode", "static"),
    ("pos1-posmode", "kin", "demo5", "mode", "kinematic"),
    ("pos1-posmode", "", "demo5", "mode", "single"),
    ("pos1-frequency", "l1+2", "2.4", "frequencies", 2),
    ("pos1-frequency", "3", "demo5", "frequencies", 3),
    ("pos1-navsys", "63", "2.4", "systems", "GRECJS"),
    ("pos1-exclsats", "G05 S129", "demo5", "excluded", ("G05", "S29")),
    ("pos2-baselen", "", "2.4", "baseline_length_m", None),
    ("pos1-snrmask_L1", "35,35,38", "demo5", "cn0_mask_dbhz", 0.0),
    ("pos1-snrmask_L1", "35,35,35,35,35,35,35,36,38", "demo5", "cn0_mask_dbhz", 35.0),
]


@pytest.mark.parametrize(("key", "value", "dialect", "ours", "expected"), UNDERSTOOD)
def test_values_mean_what_rtklib_means(key: str, value: str, dialect: Dialect, ours: str, expected: object):
    """Names by their beginning, numbers by dialect, empty as the first choice."""
    assert getattr(with_solver_option(BLANK, key, value, dialect)[0], ours) == expected


REFUSED = [
    ("pos1-elmaskk", "15", "demo5", "did you mean 'pos1-elmask'?"),
    ("pos1-posmode", "kinematik", "demo5", "did you mean 'kinematic'?"),
    ("pos1-posmode", "static-start", "2.4", "demo5 has it"),
    ("pos1-posmode", "ppp-kine", "demo5", "no PPP"),
    ("pos1-posmode", "17", "demo5", "allowed are 0 single"),
    ("pos1-elmask", "steep", "demo5", "is no number"),
    ("pos1-elmask", "95", "demo5", "<= 90"),
    ("pos1-exclsats", "G5 X01", "demo5", "'X01' is no satellite"),
    ("pos1-navsys", "0", "demo5", "names no system"),
    ("pos1-sateph", "precise", "demo5", "broadcast ephemerides"),
    ("pos2-rejgdop", "30", "demo5", "a key of 2.4"),
    ("pos2-arfilter", "on", "2.4", "a key of demo5"),
    ("pos2-rejphase", "2", "demo5", "own statistics"),
    ("stats-errphase", "nan", "demo5", "is no number"),
]


@pytest.mark.parametrize(("key", "value", "dialect", "words"), REFUSED)
def test_wrong_words_are_refused(key: str, value: str, dialect: Dialect, words: str):
    """The text names the key, what is wrong, and what is right."""
    with pytest.raises(ConfError, match=words.replace("(", r"\(").replace("?", r"\?")):
        with_solver_option(BLANK, key, value, dialect)


def test_tides_in_both_dialects():
    """2.4's `on` is what is done anyway; demo5 reads it as 0, which is told; ocean loading is refused."""
    assert with_solver_option(BLANK, "pos1-tidecorr", "on", "2.4")[0] == BLANK
    assert "demo5 reads 'on' as 0" in with_solver_option(BLANK, "pos1-tidecorr", "on", "demo5")[1]
    with pytest.raises(ConfError, match="ocean loading"):
        with_solver_option(BLANK, "pos1-tidecorr", "otl", "2.4")


@given(key=st.sampled_from([*SOLVER_ROWS, "x"]), value=st.text(max_size=20), dialect=st.sampled_from(DIALECTS))
def test_any_text_is_a_value_or_refused(key: str, value: str, dialect: Dialect):
    """Nothing but ConfError comes out of any key and text."""
    try:
        table, _ = with_solver_option(BLANK, key, value, dialect)
    except ConfError:
        return
    assert isinstance(table, SolverTable)


def test_the_table_of_keys_has_each_once():
    """Two rows of one name would hide each other."""
    assert len(SOLVER_ROWS) == len(ROWS)
