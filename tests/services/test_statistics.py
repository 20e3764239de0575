"""Rolling quantiles."""

from hypothesis import given
from hypothesis import strategies as st

from rtkmesh_services.runtime.statistics import MAXIMUM_SAMPLES, RollingQuantiles


@given(st.lists(st.floats(min_value=0.0, max_value=1e6), min_size=1, max_size=300))
def test_quantiles_are_values_that_enough_values_do_not_exceed(values: list[float]):
    """Nearest rank: at least p percent of the values are at most the quantile, and it is one of them."""
    rolling = RollingQuantiles()
    for value in values:
        rolling.add(0, value)
    found = rolling.quantiles(0)
    assert found is not None
    for percent, quantile in ((50, found.p50), (95, found.p95), (99, found.p99)):
        assert quantile in values
        assert sum(value <= quantile for value in values) * 100 >= percent * len(values)
        assert sum(value < quantile for value in values) * 100 < percent * len(values)
    assert found.maximum == max(values)
    assert found.count == len(values)


def test_values_older_than_a_minute_are_forgotten():
    """The figures are of the last minute."""
    rolling = RollingQuantiles()
    rolling.add(0, 100.0)
    rolling.add(50_000_000_000, 1.0)
    found = rolling.quantiles(61_000_000_000)
    assert found is not None
    assert (found.maximum, found.count) == (1.0, 1)
    assert rolling.quantiles(200_000_000_000) is None


def test_memory_is_bounded():
    """A flood shortens the window, not the memory."""
    rolling = RollingQuantiles()
    for number in range(MAXIMUM_SAMPLES + 10):
        rolling.add(0, float(number))
    found = rolling.quantiles(0)
    assert found is not None
    assert found.count == MAXIMUM_SAMPLES
