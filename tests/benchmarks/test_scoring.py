"""The judge itself: scores of tracks whose errors are known, and the repair of what it judges against."""

import importlib.util
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
NAMES = ("score_pos", "cases", "rtklib", "results")
TRUTH_ECEF_M = (-3962108.673, 3381309.574, 3668678.638)


@pytest.fixture(scope="module")
def benchmarks() -> Iterator[dict[str, ModuleType]]:
    """The modules of the benchmarks' folder, which is no package."""
    modules: dict[str, ModuleType] = {}
    for name in NAMES:
        spec = importlib.util.spec_from_file_location(name, BENCHMARKS / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        modules[name] = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(modules[name])
    yield modules
    for name in NAMES:
        del sys.modules[name]


def pos(
    path: Path,
    errors_enu_m: list[tuple[float, float, float]],
    quality: list[int],
    turn: "np.ndarray[tuple[int, int], np.dtype[np.float64]]",
) -> Path:
    """Write a .pos of one epoch a second with these errors of TRUTH_ECEF_M."""
    lines = ["%  GPST                      x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns"]
    for k, (error, q) in enumerate(zip(errors_enu_m, quality, strict=True)):
        x, y, z = np.array(TRUTH_ECEF_M) + turn.T @ np.array(error)
        lines.append(f"2021/03/19 12:00:{k:02d}.000 {x:.4f} {y:.4f} {z:.4f} {q} 9 0.01 0.01 0.01 0 0 0 0.0 9.9")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_known_errors_are_found(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """Shares of fixes, right and wrong ones, the longest run of wrong ones, errors in east-north-up, time to first fix."""
    judge = benchmarks["score_pos"]
    turn = judge.enu_from_ecef_at(np.array(TRUTH_ECEF_M))
    errors = [
        (0.0, 0.0, 5.0),
        (0.03, 0.04, 0.0),
        (0.0, 0.0, 0.10),
        (0.3, 0.0, 0.0),
        (0.0, 0.0, 0.2),
        (0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0),
        (0.0, 0.0, 9.0),
    ]
    file = pos(tmp_path / "a.pos", errors, [2, 1, 1, 1, 1, 1, 1, 5], turn)
    row = judge.score(file, judge.Truth(position_ecef_m=TRUTH_ECEF_M), epochs=10)
    assert (row["solutions"], row["fix_pct"], row["float_pct"], row["right_fix_pct"]) == (8, 60.0, 10.0, 30.0)
    assert (row["wrong_fixes"], row["longest_wrong_run"], row["ttff_s"]) == (3, 2, 1.0)
    assert row["h_fixed"]["max"] == pytest.approx(1.0, abs=2e-4)
    assert row["v_fixed"]["max"] == pytest.approx(0.2, abs=2e-4)


def test_what_one_alone_fixes_has_no_part_in_common_errors(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """Epochs of both, fixed in both: of four fixes with 1, 2, 3 and 9 cm two are common, whatever the other's errors are."""
    judge = benchmarks["score_pos"]
    turn = judge.enu_from_ecef_at(np.array(TRUTH_ECEF_M))
    ours = pos(tmp_path / "a.pos", [(0.01, 0.0, 0.0), (0.02, 0.0, 0.01), (0.03, 0.0, 0.0), (0.09, 0.0, 0.0)], [1, 1, 1, 1], turn)
    theirs = pos(tmp_path / "b.pos", [(0.5, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.0, 0.0)], [1, 1, 2], turn)
    row = judge.common_fixes(ours, theirs, judge.Truth(position_ecef_m=TRUTH_ECEF_M))
    assert row["count"] == 2
    assert (row["h"]["max"], row["v"]["max"]) == pytest.approx((0.02, 0.01), abs=2e-4)
    never = pos(tmp_path / "c.pos", [(0.0, 0.0, 0.0)], [2], turn)
    assert judge.common_fixes(ours, never, judge.Truth(position_ecef_m=TRUTH_ECEF_M)) is None


def test_a_reference_counts_where_it_is(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """Only epochs between fixes of the reference are compared, interpolated; without common epochs there is an error."""
    judge = benchmarks["score_pos"]
    turn = judge.enu_from_ecef_at(np.array(TRUTH_ECEF_M))
    reference = pos(tmp_path / "r.pos", [(float(k), 0.0, 0.0) for k in range(6)], [1, 1, 1, 2, 2, 1], turn)
    file = pos(tmp_path / "a.pos", [(k + 0.1, 0.0, 0.0) for k in range(6)], [1] * 6, turn)
    row = judge.score(file, judge.Truth(reference=reference))
    assert (row["compared"], row["right_fix_pct"], row["wrong_fixes"]) == (3, 100.0, 0)
    assert row["h_fixed"]["p50"] == pytest.approx(0.1, abs=2e-4)
    late = tmp_path / "late.pos"
    late.write_text(file.read_text().replace("12:00:", "13:00:"))
    with pytest.raises(judge.ScoreError, match="no epochs in common"):
        judge.score(late, judge.Truth(reference=reference))


def test_forms_and_times_of_a_file_do_not_matter(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """llh with week and seconds gives the same track as xyz with the calendar."""
    judge = benchmarks["score_pos"]
    xyz, llh = tmp_path / "xyz.pos", tmp_path / "llh.pos"
    x, y, z = judge.ecef_from_geodetic(np.array([[35.34, 139.52, 60.0]]))[0]
    xyz.write_text(f"% x-ecef(m)\n2021/03/19 12:00:01.000 {x:.4f} {y:.4f} {z:.4f} 1 9 0 0 0 0 0 0 0 0\n")
    llh.write_text("% latitude(deg)\n2149 475201.000 35.34 139.52 60.0 1 9 0 0 0 0 0 0 0 0\n")
    a, b = judge.read_track(xyz), judge.read_track(llh)
    assert (a.kind, b.kind, a.time_s[0]) == ("ecef", "ecef", b.time_s[0])
    np.testing.assert_allclose(a.vector_m, b.vector_m, atol=1e-3)


@pytest.mark.parametrize(("flags", "longest"), [([], 0), ([0, 0], 0), ([1], 1), ([1, 1, 0, 1], 2), ([0, 1, 0, 1, 1, 1], 3)])
def test_longest_run(benchmarks: dict[str, ModuleType], flags: list[int], longest: int):
    """Runs at both ends count."""
    assert benchmarks["score_pos"].longest_run(np.array(flags, np.bool_)) == longest


def test_weeks_are_repaired(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """Whole weeks are taken away; epochs of no sensible time go with their satellites."""
    file = tmp_path / "a.obs"
    file.write_text(
        "HEADER\n> 2018 07 14 23 59 59.0000000  0  1\nG01 1\n> 2018 10 21 00 00 15.0000000  0  1\nG02 2\n"
        "> 2018 07 20 10 15 44.0  0  1\nG03 3\n"
    )
    benchmarks["rtklib"].repair_weeks(file, datetime(2018, 7, 14, 12))
    assert file.read_text() == "HEADER\n> 2018 07 14 23 59 59.0000000  0  1\nG01 1\n> 2018 07 15 00 00 15.0000000  0  1\nG02 2\n"


def test_a_block_is_filled_between_its_markers(benchmarks: dict[str, ModuleType], tmp_path: Path):
    """What stands around stays; a page without the block is an error."""
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- x -->\nold\n<!-- /x -->\nb\n")
    benchmarks["results"].fill(page, "x", "new \\1\n")
    assert page.read_text() == "a\n<!-- x -->\nnew \\1\n<!-- /x -->\nb\n"
    with pytest.raises(benchmarks["results"].MarkerError):
        benchmarks["results"].fill(page, "y", "")


@pytest.mark.data
def test_stored_solutions_score_as_their_readme_says(benchmarks: dict[str, ModuleType], data: Path):
    """RTKLIB's stored results of a static and of a moving pair, with the figures of the recordings' own page."""
    by_name = {case.name: case for case in benchmarks["cases"].load(data)}
    stromlo = by_name["stromlo_l12"].score(by_name["stromlo_l12"].stored["b34"])
    assert (stromlo["fix_pct"], stromlo["h_fixed"]["rms"], stromlo["v_fixed"]["rms"]) == (99.91, 0.0042, 0.0446)
    walk = by_name["galway_b_walk"].score(by_name["galway_b_walk"].stored["demo5_rec"])
    assert (walk["fix_pct"], walk["h_fixed"]["rms"], walk["v_fixed"]["rms"]) == (
        48.05,
        pytest.approx(0.338, abs=6e-4),
        pytest.approx(0.705, abs=6e-4),
    )
