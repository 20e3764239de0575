"""A million hostile pieces through everything that reads what others send (``make fuzz``: ten millions), and the table's own order."""

import mmap
import os

import pytest
from tests.fuzz import harness
from tests.fuzz.harness import Reader, Target, run
from tests.fuzz.targets import all_targets

PIECES = 10_000_000 if os.environ.get("RTKMESH_FUZZ") else 1_000_000
TARGETS = all_targets()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("target", TARGETS, ids=[target.name for target in TARGETS])
def test_nothing_raises_hangs_or_grows(target: Target):
    """No exception out, no piece over its limit of processor time, no memory, and every frame accounted for."""
    run(target, 300, seed=10**6)  # imports and kernels
    outcome = run(target, round(PIECES * target.share), seed=1)
    assert outcome.failures == []
    assert outcome.pieces == round(PIECES * target.share)


def test_the_shares_make_a_whole():
    """A million pieces are a million."""
    assert sum(target.share for target in TARGETS) == pytest.approx(1.0, abs=0.01)
    assert len({target.name for target in TARGETS}) == len(TARGETS)


class Bad:
    """Readers that do what must not go unseen."""

    def __init__(self) -> None:
        self.kept: list[mmap.mmap] = []
        self.taken = 0

    def raises(self, _: bytes) -> None:
        self.taken += 1
        if self.taken == 50:
            raise IndexError("beyond")

    def hangs(self, _: bytes) -> None:
        self.taken += 1
        if self.taken == 50:
            sum(range(2_000_000))

    def grows(self, _: bytes) -> None:
        pages = mmap.mmap(-1, 1 << 18)  # pages of its own: an allocator may have freed memory to give
        pages.write(b"\x01" * len(pages))
        self.kept.append(pages)


@pytest.mark.parametrize(("fault", "says"), [("raises", "IndexError: beyond"), ("hangs", "every time"), ("grows", "memory grew")])
def test_the_harness_sees(fault: str, says: str):
    """A harness that finds nothing proves nothing."""
    target = Target(fault, lambda _: iter([b"x"] * 400), lambda: Reader(getattr(Bad(), fault)), 0.0)
    outcome = run(target, 400)
    assert [says in failure for failure in outcome.failures] == [True]
    assert harness.LIMIT_S == 0.002
