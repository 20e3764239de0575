"""Which of an ingest's sources is used: the first one that brings frames, in the order of the file. No thread, no clock."""

from math import inf


class Failover:
    """Decides by the instants of whole frames. Sources from 0 to ``running`` - 1 are to be open, all better placed ones included."""

    def __init__(self, count: int, after_s: float, return_s: float, now_s: float) -> None:
        self._count, self._after_s, self._return_s = count, after_s, return_s
        self._heard_s = [-inf] * count
        self._since_s = [now_s] * count  # beginning of the present time without gaps
        self._opened_s = now_s
        self.active, self.running = 0, 1

    def heard(self, source: int, now_s: float) -> bool:
        """A source has brought a frame; return whether it becomes the active one with it."""
        if now_s - self._heard_s[source] > self._after_s:
            self._since_s[source] = now_s
        self._heard_s[source] = now_s
        if source == self.active or not self._takes_over(source, now_s):
            return False
        self.active, self.running = source, source + 1
        return True

    def silent(self, now_s: float) -> bool:
        """Return whether one more source is to be opened because none of the open ones brings anything."""
        newest_s = max(self._opened_s, *self._heard_s)
        if now_s - newest_s <= self._after_s or self.running == self._count:
            return False
        self._opened_s, self.running = now_s, self.running + 1
        return True

    def _takes_over(self, source: int, now_s: float) -> bool:
        if now_s - self._heard_s[self.active] > self._after_s:
            return True
        return source < self.active and now_s - self._since_s[source] >= self._return_s
