"""BeiDou D2 held against RTKLIB demo5's decoder (pyrtklib5): no recording at hand holds D2 subframes."""

import random
from typing import Any

import pytest

from rtkmesh.codecs.ephemerides import d2_ephemeris
from rtkmesh.codecs.subframes import BEIDOU_PREAMBLE, D2_EPHEMERIS, D2_PAGE, D2_PAGE_BITS
from rtkmesh.gnss.ephemeris import KeplerEphemeris

pyrtklib5: Any = pytest.importorskip("pyrtklib5", reason="pyrtklib5 has wheels for x86-64 only")

_BYTES_PER_SUBFRAME = 38


def pages(numbers: dict[str, int], sow_s: int) -> tuple[int, bytes]:
    """Return the joined 150-bit pages, and the same as RTKLIB wants them."""
    joined = D2_EPHEMERIS.write({f.name: numbers[f.name] * f.scale for f in D2_EPHEMERIS.fields if f.name in numbers})
    block, buffer = 0, b""
    for i in range(10):
        page = joined >> D2_PAGE_BITS * (9 - i) & (1 << D2_PAGE_BITS) - 1
        page = D2_PAGE.write({"preamble": BEIDOU_PREAMBLE, "subframe": 1, "page": i + 1, "sow_s": sow_s + 3 * i}, page)
        block = block << D2_PAGE_BITS | page
        buffer += (page << _BYTES_PER_SUBFRAME * 8 - D2_PAGE_BITS).to_bytes(_BYTES_PER_SUBFRAME, "big")
    return block, buffer


def theirs(buffer: bytes) -> Any:
    buffer += bytes(_BYTES_PER_SUBFRAME)  # the UTC page that it looks for as well; without one it returns 0
    array = getattr(pyrtklib5, "Arr1Dunsigned char")(len(buffer))
    for i, byte in enumerate(buffer):
        array[i] = byte
    ephemeris = pyrtklib5.eph_t()
    pyrtklib5.decode_bds_d2(array, ephemeris, pyrtklib5.Arr1Ddouble(8))
    assert ephemeris.A > 0.0  # it fills the ephemeris only if pages and times fit together
    return ephemeris


@pytest.mark.parametrize("seed", range(20))
def test_random_d2_pages_mean_the_same_to_rtklib(seed: int):
    """Every field of ten random pages."""
    rng = random.Random(seed)
    numbers = {f.name: f.coding.decode(rng.getrandbits(f.length), f.length) for f in D2_EPHEMERIS.fields}
    numbers |= {"week": 994, "toc_s": 36_000, "toe_s": 36_000, "sow_s": 288_000}
    numbers |= {"sqrt_a": int(6493.4 * 2**19) + seed, "eccentricity": rng.getrandbits(24)}
    block, buffer = pages(numbers, 288_000)
    ours, e = d2_ephemeris(195, block), theirs(buffer)
    assert isinstance(ours, KeplerEphemeris)
    assert (ours.iode, ours.iodc, ours.health) == (e.iode, e.iodc, e.svh)
    pairs = {
        "m0_rad": e.M0, "delta_n_radps": e.deln, "omega0_rad": e.OMG0, "omega_rad": e.omg, "omega_dot_radps": e.OMGd, "i0_rad": e.i0,
        "idot_radps": e.idot, "eccentricity": e.e, "cuc_rad": e.cuc, "cus_rad": e.cus, "crc_m": e.crc, "crs_m": e.crs, "cic_rad": e.cic,
        "cis_rad": e.cis, "af0_s": e.f0, "af1": e.f1, "af2": e.f2,
    }  # fmt: skip
    for name, value in pairs.items():
        assert getattr(ours, name) == pytest.approx(value, rel=1e-12, abs=0.0), name
    assert ours.sqrt_a**2 == pytest.approx(e.A, rel=1e-12)
    assert ours.toe.tow_s == e.toes + 14.0 == 288_014.0
    assert ours.group_delay_s == pytest.approx((e.tgd[0], e.tgd[1]), rel=1e-12)
