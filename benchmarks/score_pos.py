#!/usr/bin/env python3
"""Score a solution file in RTKLIB's .pos format against the truth.

  score_pos.py SOL.pos --truth=X,Y,Z                 static truth, ECEF metres
  score_pos.py SOL.pos --truth-llh=LAT,LON,H         static truth, degrees and metres above the ellipsoid
  score_pos.py SOL.pos --reference REF.pos           moving truth: another .pos (its Q=1 epochs, interpolated over at most 1.5 s)
  score_pos.py SOL.pos --baseline LENGTH             an enu file of a moving base: error of the length, spread of the heading
  score_pos.py SOL.pos                               no truth: the median fix stands in (repeatability only)

Reads llh (degrees), xyz and enu files, calendar or week/tow time. Errors are in metres; h = horizontal, v = vertical (up). A fix is
Q=1, a float Q=2; a fix is wrong when it is off by more than --wrong in 3D. right_fix_pct is the share of the epochs (with
--reference: of the compared ones) that are fixed and right. Stands alone: numpy is all it needs, nothing of what it judges is used.
"""

import argparse
import json
import sys
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
Flags = NDArray[np.bool_]
Row = dict[str, Any]

FIX, FLOAT = 1, 2
WRONG_M: Final = 0.15
_LONGEST_GAP_S: Final = 1.6  # of the reference: its epochs are interpolated over this, not over more
_SAME_EPOCH_S: Final = 0.011  # tags of the same epoch of two receivers or formats differ by less

# WGS 84
_A_M: Final = 6378137.0
_F: Final = 1.0 / 298.257223563
_E2: Final = _F * (2.0 - _F)


class ScoreError(Exception):
    """A file that cannot be scored."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The solutions of one file: GPS seconds, ECEF or east-north-up metres (n x 3), RTKLIB's quality numbers."""

    kind: Literal["ecef", "enu"]
    time_s: Vector
    vector_m: Vector
    quality: NDArray[np.int64]

    def since(self, skip_s: float) -> "Track":
        """Return the track without its first seconds."""
        keep = self.time_s >= self.time_s[0] + skip_s
        return self.where(keep)

    def where(self, keep: Flags) -> "Track":
        """Return the track of some of its epochs."""
        return Track(self.kind, self.time_s[keep], self.vector_m[keep], self.quality[keep])

    def fixed_with(self, other: "Track") -> "Track":
        """Return the fixes at epochs at which another track is fixed too."""
        theirs_s = other.time_s[other.quality == FIX]
        if not len(theirs_s):
            return self.where(np.zeros(len(self.time_s), np.bool_))
        after = np.clip(np.searchsorted(theirs_s, self.time_s), 1, max(len(theirs_s) - 1, 1)) % len(theirs_s)
        near_s = np.minimum(np.abs(theirs_s[after] - self.time_s), np.abs(theirs_s[after - 1] - self.time_s))
        return self.where((self.quality == FIX) & (near_s < _SAME_EPOCH_S))


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """What a file is held against; nothing given: its own median fix."""

    position_ecef_m: tuple[float, float, float] | None = None
    reference: Path | None = None
    baseline_m: float | None = None


def ecef_from_geodetic(llh_deg_m: Vector) -> Vector:
    """Return ECEF metres (n x 3) of latitude, longitude (degrees) and ellipsoidal height (n x 3)."""
    lat, lon, h_m = np.radians(llh_deg_m[:, 0]), np.radians(llh_deg_m[:, 1]), llh_deg_m[:, 2]
    normal_m = _A_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (normal_m + h_m) * np.cos(lat) * np.cos(lon),
            (normal_m + h_m) * np.cos(lat) * np.sin(lon),
            (normal_m * (1.0 - _E2) + h_m) * np.sin(lat),
        ],
        axis=-1,
    )


def enu_from_ecef_at(origin_ecef_m: Vector) -> Vector:
    """Return the rotation (rows east, north, up) at a point."""
    x, y, z = origin_ecef_m
    lon, p = np.arctan2(y, x), np.hypot(x, y)
    lat = np.arctan2(z, p * (1.0 - _E2))
    for _ in range(6):
        normal_m = _A_M / np.sqrt(1.0 - _E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + _E2 * normal_m * np.sin(lat), p)
    sl, cl, so, co = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


# --- reading ---


def read_track(path: Path) -> Track:
    """Return the solutions of a .pos file; ScoreError when there are none."""
    form, rows = "", list[tuple[float, ...]]()
    for line in path.read_text(errors="replace").splitlines():
        if line.startswith("%"):
            form = _form_of(line) or form
        elif (row := _row_of(line)) is not None:
            rows.append(row)
    if not rows:
        raise ScoreError(f"{path}: no solution lines")
    table = np.array(rows)
    vector_m = table[:, 1:4]
    if not form:
        form = "xyz" if np.abs(vector_m).max() > 1e5 else "llh"
    if form == "llh":
        vector_m = ecef_from_geodetic(vector_m)
    return Track("enu" if form == "enu" else "ecef", table[:, 0], vector_m, table[:, 4].astype(np.int64))


def _form_of(header: str) -> str:
    low = header.lower()
    for word, form in (("latitude", "llh"), ("x-ecef", "xyz"), ("e-baseline", "enu")):
        if word in low:
            return form
    return ""


def _row_of(line: str) -> tuple[float, ...] | None:
    """Return time, three coordinates and quality of a solution line, None for other lines."""
    parts = line.replace(",", " ").split()
    if len(parts) < 12 or parts[0].startswith("$"):
        return None
    try:
        return (_seconds(parts[0], parts[1]), float(parts[2]), float(parts[3]), float(parts[4]), float(int(parts[5])))
    except ValueError:
        return None


def _seconds(day: str, time: str) -> float:
    """Return seconds since the GPS epoch of ``2018/07/14 23:50:09.0`` or ``2009 604209.0``."""
    if "/" not in day:
        return int(day) * 604800.0 + float(time)
    year, month, of_month = (int(part) for part in day.split("/"))
    hour, minute, second = time.split(":")
    days = (date(year, month, of_month) - date(1980, 1, 6)).days
    return days * 86400.0 + int(hour) * 3600.0 + int(minute) * 60.0 + float(second)


# --- scoring ---


def score(path: Path, truth: Truth, *, epochs: int | None = None, wrong_m: float = WRONG_M, skip_s: float = 0.0) -> Row:
    """Return the figures of a file. ``epochs``: how many could have been solved (default: those in the file)."""
    track = read_track(path).since(skip_s)
    count = epochs or len(track.time_s)
    row = _availability(track, count)
    if truth.baseline_m is not None:
        return row | _baseline(track, truth.baseline_m, wrong_m)
    error_enu_m, fixed, compared = _errors(track, truth)
    if truth.reference is not None:
        row["compared"] = compared
    if truth.reference is None and truth.position_ecef_m is None:
        row["truth"] = "median of the fixes (repeatability only)"
    return row | _accuracy(error_enu_m, fixed, compared if truth.reference else count, wrong_m)


def common_fixes(path: Path, other: Path, truth: Truth) -> Row | None:
    """Return how many fixes of two files are of equal epochs, and their horizontal and vertical errors in the first file; None if none.

    What one file fixes alone, often the hardest epochs, has no part in it.
    """
    track = read_track(path).fixed_with(read_track(other))
    if not len(track.time_s):
        return None
    error_enu_m, _, _ = _errors(track, truth)
    return {"count": len(track.time_s), "h": spread(np.linalg.norm(error_enu_m[:, :2], axis=1)), "v": spread(error_enu_m[:, 2])}


def _availability(track: Track, count: int) -> Row:
    fixed = track.quality == FIX
    return {
        "solutions": len(track.time_s),
        "of_epochs": count,
        "available_pct": _percent(len(track.time_s), count),
        "fix_pct": _percent(int(fixed.sum()), count),
        "float_pct": _percent(int((track.quality == FLOAT).sum()), count),
        "ttff_s": round(float(track.time_s[fixed][0] - track.time_s[0]), 2) if fixed.any() else None,
    }


def _errors(track: Track, truth: Truth) -> tuple[Vector, Flags, int]:
    """Return errors east, north, up (n x 3), which of them are of fixes, and their number."""
    fixed = track.quality == FIX
    if truth.reference is not None:
        return _errors_against(track, read_track(truth.reference))
    if truth.position_ecef_m is not None:
        origin_m = np.array(truth.position_ecef_m)
    else:
        origin_m = np.median(track.vector_m[fixed] if fixed.any() else track.vector_m, axis=0)
    turn = np.eye(3) if track.kind == "enu" else enu_from_ecef_at(origin_m)
    return (track.vector_m - origin_m) @ turn.T, fixed, len(fixed)


def _errors_against(track: Track, reference: Track) -> tuple[Vector, Flags, int]:
    """Return the same against the fixes of a moving reference, at the epochs that it covers."""
    known = reference.quality == FIX
    time_s, vector_m = reference.time_s[known], reference.vector_m[known]
    if len(time_s) < 2:
        raise ScoreError("the reference has no fixes")
    after = np.clip(np.searchsorted(time_s, track.time_s), 1, len(time_s) - 1)
    gap_s = time_s[after] - time_s[after - 1]
    inside = (track.time_s >= time_s[after - 1] - _SAME_EPOCH_S) & (track.time_s <= time_s[after] + _SAME_EPOCH_S)
    at = np.flatnonzero(inside & (gap_s < _LONGEST_GAP_S))
    if not len(at):
        raise ScoreError("no epochs in common with the reference")
    part = ((track.time_s[at] - time_s[after[at] - 1]) / gap_s[at])[:, None]
    difference_m = track.vector_m[at] - (vector_m[after[at] - 1] * (1.0 - part) + vector_m[after[at]] * part)
    turn = np.eye(3) if track.kind == "enu" else enu_from_ecef_at(track.vector_m[at][0])
    return difference_m @ turn.T, (track.quality == FIX)[at], len(at)


def _accuracy(error_enu_m: Vector, fixed: Flags, count: int, wrong_m: float) -> Row:
    error_m = np.linalg.norm(error_enu_m, axis=1)
    wrong = fixed & (error_m > wrong_m)
    row: Row = {}
    for name, chosen in (("fixed", fixed), ("all", np.ones(len(fixed), np.bool_))):
        row[f"h_{name}"] = spread(np.linalg.norm(error_enu_m[chosen, :2], axis=1))
        row[f"v_{name}"] = spread(error_enu_m[chosen, 2])
    return row | {
        "right_fix_pct": _percent(int((fixed & ~wrong).sum()), count),
        "wrong_fixes": int(wrong.sum()),
        "longest_wrong_run": longest_run(wrong),
        "wrong_fix_pct_of_fix": _percent(int(wrong.sum()), int(fixed.sum())) if fixed.any() else None,
        "within_0.5m_pct": _percent(int((error_m <= 0.5).sum()), count),
    }


def _baseline(track: Track, length_m: float, wrong_m: float) -> Row:
    if track.kind != "enu":
        raise ScoreError("--baseline needs an enu file")
    vector_m = track.vector_m[track.quality == FIX]
    error_m = np.linalg.norm(vector_m, axis=1) - length_m
    row: Row = {"length_error_fixed": spread(error_m)}
    if len(vector_m):
        row["wrong_fix_pct_of_fix"] = _percent(int((np.abs(error_m) > wrong_m).sum()), len(error_m))
        row["heading_mean_deg"], row["heading_spread_deg"] = _heading(vector_m)
    return row


def _heading(vector_enu_m: Vector) -> tuple[float, Row | None]:
    """Return the circular mean of the headings and their spread about it, degrees."""
    heading = np.arctan2(vector_enu_m[:, 0], vector_enu_m[:, 1])
    mean = float(np.angle(np.exp(1j * heading).mean()))
    off_deg = np.degrees(np.remainder(heading - mean + np.pi, 2.0 * np.pi) - np.pi)
    return round(float(np.degrees(mean)) % 360.0, 4), spread(off_deg)


def spread(values: Vector) -> Row | None:
    """Return rms, median, 95th percentile and maximum of magnitudes."""
    v = np.abs(values)
    if v.size == 0:
        return None
    figures = {"rms": np.sqrt(np.mean(v**2)), "p50": np.percentile(v, 50), "p95": np.percentile(v, 95), "max": v.max()}
    return {name: round(float(value), 4) for name, value in figures.items()}


def longest_run(flags: Flags) -> int:
    """Return the length of the longest run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0


def _percent(part: int, whole: int) -> float:
    return round(100.0 * part / whole, 2) if whole else 0.0


# --- command line ---


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("solution", type=Path)
    parser.add_argument("--truth", metavar="X,Y,Z")
    parser.add_argument("--truth-llh", metavar="LAT,LON,H")
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--baseline", type=float, metavar="METRES")
    parser.add_argument("--epochs", type=int, help="epochs that could have been solved")
    parser.add_argument("--wrong", type=float, default=WRONG_M, help="metres in 3D beyond which a fix is wrong (default %(default)s)")
    parser.add_argument("--skip", type=float, default=0.0, help="seconds left out at the start")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    truth = Truth(position_ecef_m=_given_position(options), reference=options.reference, baseline_m=options.baseline)
    try:
        row = score(options.solution, truth, epochs=options.epochs, wrong_m=options.wrong, skip_s=options.skip)
    except (OSError, ScoreError) as error:
        print(f"score_pos: {error}", file=sys.stderr)
        return 2
    if options.json:
        print(json.dumps(row))
    else:
        for name, value in row.items():
            print(f"{name:22} {value}")
    return 0


def _given_position(options: argparse.Namespace) -> tuple[float, float, float] | None:
    text = options.truth or options.truth_llh
    if not text:
        return None
    a, b, c = (float(part) for part in text.split(","))
    if options.truth:
        return a, b, c
    x, y, z = ecef_from_geodetic(np.array([[a, b, c]]))[0].tolist()
    return x, y, z


if __name__ == "__main__":
    sys.exit(main())
