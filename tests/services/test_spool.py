"""The spool: what went in comes out from the last to the first, with its shared objects, and its file is gone afterwards."""

from pathlib import Path

import numpy as np
import pytest

from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.time import GpsTime
from rtkmesh_services.cli.spool import Spool
from rtkmesh_services.errors import SourceError


@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 200])
def test_a_spool_is_a_stack(count: int) -> None:
    """For every number of values around the size of its blocks."""
    with Spool[int]() as spool:
        for value in range(count):
            spool.append(value)
        assert len(spool) == count
        assert list(spool.backward()) == list(range(count))[::-1]


def test_epochs_come_back_to_the_last_bit() -> None:
    """Values that are not known included; what is repeated in a block is one object still."""
    epoch = make_epoch(GpsTime(2400, 5.0), satellite=[5, 7], signal=[1, 1], pseudorange_m=[2.2e7 / 3.0, np.nan])
    with Spool[tuple[int, object]]() as spool:
        for k in range(64):
            spool.append((k, epoch))
        found = list(spool.backward())
    assert found[0][1] is found[63][1]
    for name in ("pseudorange_m", "phase_cyc", "flags", "satellite"):
        assert getattr(found[0][1], name).tobytes() == getattr(epoch, name).tobytes()
    assert spool._file.closed


def test_a_full_disk_is_the_sites_fault() -> None:
    """It is said what could not be written."""
    with Path("/dev/full").open("wb", buffering=0) as full:
        spool = Spool[bytes](full)
        with pytest.raises(SourceError, match="temporary file: No space left on device"):
            fill(spool)


def fill(spool: Spool[bytes]) -> None:
    for _ in range(64):
        spool.append(bytes(100))
