"""Signal pairing."""

import numpy as np

from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.signals import satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime
from rtkmesh.rtk.matching import SAME_BAND, SAME_CODE, SAME_FAMILY, match, matching_rules

TIME = GpsTime(2300, 1000.0)


def epoch(*rows, without_phase=(), cn0_dbhz=45.0):
    satellite = [satellite_number(row.split()[0]) for row in rows]
    signal = [signal_number(row.split()[1]) for row in rows]
    phase = [np.nan if row in without_phase else 1e8 for row in rows]
    return make_epoch(
        TIME, satellite=satellite, signal=signal, pseudorange_m=[2.2e7] * len(rows), phase_cyc=phase, cn0_dbhz=[cn0_dbhz] * len(rows)
    )


def matched(rover, base, systems="GREJC", frequencies=2, excluded=(), cn0_mask_dbhz=0.0):
    pairs = match(rover.signals, base.signals, matching_rules(systems, frequencies, excluded, cn0_mask_dbhz))
    rows, others = list(rover.rows()), list(base.rows())
    return [(rows[i][0], rows[i][1], others[j][1], int(k)) for i, j, k in zip(pairs.rover, pairs.base, pairs.likeness, strict=True)], pairs


def test_identical_codes_come_first_then_the_family_then_the_band():
    """A rover with 2W and 2L takes what the base has; 2L pairs with 2X as kin and with 2W as a code of the band."""
    rover = epoch("G01 1C", "G01 2W", "G01 2L", "G02 1C", "G02 2L", "G03 1C", "G03 2L")
    base = epoch("G01 1C", "G01 2L", "G02 1C", "G02 2X", "G03 1C", "G03 2W")
    found, _ = matched(rover, base)
    assert found == [
        ("G01", "1C", "1C", SAME_CODE), ("G01", "2L", "2L", SAME_CODE), ("G02", "1C", "1C", SAME_CODE),
        ("G02", "2L", "2X", SAME_FAMILY), ("G03", "1C", "1C", SAME_CODE), ("G03", "2L", "2W", SAME_BAND),
    ]  # fmt: skip


def test_bands_are_taken_in_order_of_preference_and_up_to_the_limit():
    """Galileo: E5b before E5a, E5a where the base has no E5b; BeiDou: B1I, B2, B3 before B1C."""
    rover = epoch("E01 1C", "E01 5Q", "E01 7Q", "E02 1C", "E02 5Q", "E02 7Q", "C20 1P", "C20 2I", "C20 6I")
    base = epoch("E01 1C", "E01 5Q", "E01 7Q", "E02 1C", "E02 5Q", "C20 1P", "C20 2I", "C20 6I")
    assert [row[:2] for row in matched(rover, base)[0]] == [
        ("E01", "1C"), ("E01", "7Q"), ("E02", "1C"), ("E02", "5Q"), ("C20", "2I"), ("C20", "6I"),
    ]  # fmt: skip
    assert [row[:2] for row in matched(rover, base, frequencies=1)[0]] == [("E01", "1C"), ("E02", "1C"), ("C20", "2I")]


def test_masks_and_signals_with_phase():
    """Systems, excluded satellites and the C/N0 mask act; a code with phase is preferred to the same code without."""
    rover, base = epoch("G01 1C", "G02 1C", "R01 1C"), epoch("G01 1C", "G02 1C", "R01 1C")
    assert [row[0] for row in matched(rover, base, systems="R")[0]] == ["R01"]
    assert [row[0] for row in matched(rover, base, excluded=("G02",))[0]] == ["G01", "R01"]
    assert matched(rover, epoch("G01 1C", cn0_dbhz=20.0), cn0_mask_dbhz=30.0)[0] == []
    old = epoch("G01 1C", "G01 1W", without_phase=("G01 1W",))
    assert matched(old, old)[0] == [("G01", "1C", "1C", SAME_CODE)]


def test_groups_and_keys_follow_content():
    """Satellites with the same pair of signals share a clock group; keys are unique and the numbering does not depend on others."""
    rover = epoch("G01 1C", "G02 1C", "G02 2L", "G03 1C", "G03 2L", "E01 1C")
    _, pairs = matched(rover, rover)
    assert pairs.groups == 3
    assert pairs.group.tolist() == [0, 0, 1, 0, 1, 2]
    assert len(set(pairs.key.tolist())) == len(pairs.key)
    empty = epoch()
    assert len(matched(rover, empty)[1].key) == 0


def test_geostationary_satellites_of_beidou_have_clocks_of_their_own():
    """Their phases can be half a cycle off those of the others; C05 and C59 are geostationary, C06 and C58 are not, nor is G05."""
    rows = ("G05 1C", "G06 1C", "C05 2I", "C06 2I", "C58 2I", "C59 2I")
    _, pairs = matched(epoch(*rows), epoch(*rows))
    assert pairs.groups == 3
    assert list(pairs.group) == [0, 0, 2, 1, 1, 2]
