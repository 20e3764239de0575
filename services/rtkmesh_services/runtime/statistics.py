"""Rolling figures of a process: cheap to add to at every epoch, computed only when somebody asks."""

from collections import deque
from typing import Final

from rtkmesh_schemas.status import Quantiles

WINDOW_NS: Final = 60_000_000_000
MAXIMUM_SAMPLES: Final = 6000  # 100 Hz for a minute; beyond that the window is shorter


class RollingQuantiles:
    """Quantiles of a latency or duration over the last minute (at most the last 6000 values)."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque(maxlen=MAXIMUM_SAMPLES)

    def add(self, now_mono_ns: int, value_ms: float) -> None:
        """Add one value, milliseconds."""
        self._samples.append((now_mono_ns, value_ms))

    def quantiles(self, now_mono_ns: int) -> Quantiles | None:
        """Return the quantiles of the last minute (nearest rank), or None without a value."""
        while self._samples and now_mono_ns - self._samples[0][0] > WINDOW_NS:
            self._samples.popleft()
        values = sorted(value for _, value in self._samples)
        if not values:
            return None
        return Quantiles(p50=_rank(values, 50), p95=_rank(values, 95), p99=_rank(values, 99), maximum=values[-1], count=len(values))


def _rank(values: list[float], percent: int) -> float:
    """Return the nearest-rank quantile: the smallest value that at least ``percent`` of the values do not exceed."""
    return values[max(0, -(-len(values) * percent // 100) - 1)]
