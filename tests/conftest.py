"""Shared fixtures: where the recordings and the oracles are."""

import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import HealthCheck, settings

from rtkmesh_services.runtime.kernel_cache import use_kernel_cache

use_kernel_cache()
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell that starts us in the background ignores it for all below it
STATE = tempfile.TemporaryDirectory(prefix="rtkmesh-state-")
os.environ["RTKMESH_STATE"] = STATE.name  # no test touches what this host keeps
settings.register_profile("tests", deadline=None)
settings.register_profile("ci", deadline=None, derandomize=True)  # what fails there fails here too
settings.register_profile("fuzz", deadline=None, max_examples=5000, suppress_health_check=list(HealthCheck))
settings.load_profile("fuzz" if os.environ.get("RTKMESH_FUZZ") else "ci" if os.environ.get("CI") else "tests")

REPOSITORY = Path(__file__).resolve().parents[1]
BENCHMARKS = REPOSITORY / "benchmarks"
TIMED = {"services", "fuzz"}  # folders whose tests meet the machine's clock: a second try, told by the summary, where the first one fails


def data_folder() -> Path | None:
    """Return the folder of the recordings, or None."""
    for candidate in (os.environ.get("RTKMESH_DATA"), REPOSITORY.parent / "shared" / "data"):
        if candidate and (Path(candidate) / "cases.toml").is_file():
            return Path(candidate)
    return None


@pytest.fixture(scope="session")
def data() -> Path:
    """The recordings; the test skips without them, except on CI, where they must be."""
    folder = data_folder()
    if folder is None:
        if os.environ.get("CI"):
            pytest.fail("the recordings are missing on CI (RTKMESH_DATA or ../shared/data)")
        pytest.skip("no recordings: set RTKMESH_DATA")
    return folder


@pytest.fixture(scope="module")
def benchmarks(request: pytest.FixtureRequest) -> Iterator[SimpleNamespace]:
    """The benchmarks that the test module lists as ``NAMES``: their folder is no package, and they are forgotten after the module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        yield SimpleNamespace(**{name: __import__(name) for name in request.module.NAMES})
    for name, module in list(sys.modules.items()):
        if Path(getattr(module, "__file__", None) or "/").parent == BENCHMARKS:
            del sys.modules[name]


@pytest.fixture(scope="session")
def rtklib_program():
    """A function that returns the path of one of RTKLIB's programs; the test skips without it, except on CI."""

    def find(name: str) -> str:
        path = shutil.which(name)
        if path is None:
            if os.environ.get("CI"):
                pytest.fail(f"{name} is missing on CI (Debian package rtklib)")
            pytest.skip(f"{name} is not installed (Debian package rtklib)")
        return path

    return find


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what is quick first: processes and slow tests come last, in the random order that they have."""
    items.sort(key=lambda item: sum(item.get_closest_marker(name) is not None for name in ("e2e", "slow")))
    for item in items:
        if any(item.get_closest_marker(name) for name in ("e2e", "slow")) or TIMED & set(item.path.relative_to(REPOSITORY).parts):
            item.add_marker(pytest.mark.flaky(reruns=1))
