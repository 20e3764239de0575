"""A caster's mount point as a source: which one, in which version, and what it is told about the rover's place."""

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from math import isfinite
from typing import Final

from rtkmesh_services.errors import RefusedError, SourceError
from rtkmesh_services.ingest.gga import gga_sentence
from rtkmesh_services.ingest.urls import SourceUrl, wants_nearest
from rtkmesh_services.ingest.wires import POLL_S, ReopenError, SilentError, Wire
from rtkmesh_services.ntrip.address import CasterAddress
from rtkmesh_services.ntrip.connection import AnswerError, CasterConnection, TlsOptions, fetch_table, open_stream
from rtkmesh_services.ntrip.place import Place
from rtkmesh_services.ntrip.source_table import MountPoint, nearest_mount
from rtkmesh_services.runtime.backoff import CASTER, Backoff

TIMEOUT_S: Final = 30.0
GGA_PERIOD_S: Final = 10.0
MAXIMUM_DISTANCE_KM: Final = 100.0
NEARER_KM: Final = 5.0  # another mount point must be nearer by so much, and by a fifth, before it is taken instead
NEARER_SHARE: Final = 0.8
MOVED_KM: Final = 0.5  # a rover that has moved so far tells it at once
TABLE_VALID_S: Final = 86400.0

FindPlace = Callable[[], Place | None]
Say = Callable[[str], None]


class NtripWire:
    """An open mount point. What can be written to it are positions alone."""

    bytes_per_s = 0.0

    def __init__(self, connection: CasterConnection, source: "NtripSource", gga: bool) -> None:
        self._connection, self._source, self._gga = connection, source, gga
        answer = connection.answer
        trusted = ", certificate not verified" if source.trusts_anybody else ""
        self.detail = f"{connection.address} ({answer.protocol if answer else '?'}{trusted})"
        self._opened_s = self._heard_s = time.monotonic()
        self._told: Place | None = None
        self._told_s = self._looked_s = 0.0

    def read(self) -> bytes | None:
        """Return new bytes, b"" when the caster has closed, None when nothing came."""
        now_s = time.monotonic()
        self._tell_place(now_s)
        with self._source.guarded():
            data = self._connection.read()
        if data:
            self._heard_s = now_s
        elif data is None and now_s - self._heard_s > self._source.timeout_s:
            self._complain()
        return data

    def write(self, data: bytes) -> None:
        """Refuse: a caster takes no corrections from us here."""
        del data
        raise ConnectionError("a caster takes no data from a client")

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _tell_place(self, now_s: float) -> None:
        """Tell the caster where the rover is, when it wants to know and it is time; see whether another mount point is nearer now."""
        place = self._source.find_place() if self._gga or self._source.nearest else None
        if place is None:
            return
        if now_s - self._looked_s >= self._source.gga_period_s:
            self._looked_s = now_s
            self._source.stay_or_move(self._connection.address.mount, place)
        due = now_s - self._told_s >= self._source.gga_period_s or (now_s - self._told_s >= 1.0 and _moved(self._told, place))
        if self._gga and due:
            self._connection.write(gga_sentence(place, time.time()).encode())
            self._told, self._told_s = place, now_s

    def _complain(self) -> None:
        text = f"no data for {self._source.timeout_s:.0f} s"
        if self._heard_s > self._opened_s:
            raise SilentError(text)
        hint = "" if self._gga else ": some mount points say nothing before they know a position (gga=on)"
        raise SourceError(f"{self._connection.address}: {text}{hint}")


class NtripSource:
    """Opens the mount point of a URL again and again, and remembers what it has learned: source table, version, choice."""

    backoff: Backoff = CASTER

    def __init__(self, url: SourceUrl, find_place: FindPlace | None = None, say: Say | None = None) -> None:
        assert url.caster is not None, "an NTRIP URL has one"
        self._address: CasterAddress = url.caster
        fixed = url.place
        self._find_place: FindPlace | None = (lambda: fixed) if fixed is not None else find_place
        self._say = say
        self._tls = TlsOptions(authority=url.options.get("ca", ""), verify=url.word("verify") == "yes")
        self.trusts_anybody = self._address.tls and not self._tls.verify
        self._gga, self._version_word = url.word("gga"), url.word("version")
        self._version = 1 if self._version_word == "1" else 2
        self._table: list[MountPoint] | None = None
        self._table_s = 0.0
        self._chosen = ""
        self._reach_km = url.number("max_distance", MAXIMUM_DISTANCE_KM)
        self.nearest = wants_nearest(url)
        self.timeout_s = url.number("timeout", TIMEOUT_S)
        self.gga_period_s = max(1.0, url.number("gga_period", GGA_PERIOD_S))

    def open(self, stopping: threading.Event) -> Wire | None:
        """Return the open mount point; waits for a position where one is needed first."""
        address, gga = self._address, self._gga == "on"
        if self.nearest or (self._gga == "auto" and self._find_place is not None):
            self._learn()
        if self.nearest:
            place = self._wait_for_place(stopping, "the nearest mount point can be chosen when there is a position")
            if place is None:
                return None
            address = replace(address, mount=self._choose(place))
        row = self._row(address.mount)
        gga = gga or (self._gga == "auto" and row is not None and row.needs_gga)
        place = self._wait_for_place(stopping, f"{address} wants a position, and there is none yet") if gga else None
        if gga and place is None:
            return None
        return self._opened(address, place)

    def close(self) -> None:
        """Nothing is kept open."""

    def find_place(self) -> Place | None:
        """Return where the rover is: as configured, or as its solver says; None while nobody knows."""
        return None if self._find_place is None else self._find_place()

    @contextmanager
    def guarded(self) -> Generator[None]:
        """Do something with a connection; when what comes makes no sense, the other version is tried next."""
        try:
            yield
        except AnswerError:
            if self._version_word == "auto":
                self._version = 3 - self._version
            raise

    def stay_or_move(self, mount: str, place: Place) -> None:
        """ReopenError when another mount point is much nearer than the chosen one."""
        if not self.nearest or (row := self._row(mount)) is None:
            return
        best = nearest_mount(self._table or [], *place[:2])
        if best is not None and _much_nearer(best, row, place):
            raise ReopenError(f"{best.name} is now nearer than {mount}")

    def _opened(self, address: CasterAddress, place: Place | None) -> Wire:
        gga = gga_sentence(place, time.time()) if place is not None else ""
        try:
            with self.guarded():
                connection = open_stream(address, version=self._version, gga=gga, tls=self._tls)
        except RefusedError as error:
            if error.lasting and self.nearest:
                self._table = None  # the chosen mount point may be gone
            raise
        return NtripWire(connection, self, gga=place is not None)

    def _learn(self) -> None:
        """Fetch the source table when there is none, or an old one. A caster without one is no fault unless we must choose from it."""
        if self._table is not None and time.monotonic() - self._table_s < TABLE_VALID_S:
            return
        try:
            with self.guarded():
                self._table = fetch_table(self._address, version=self._version, tls=self._tls)
            self._table_s = time.monotonic()
        except (RefusedError, AnswerError):
            if self.nearest:
                raise
            self._table, self._table_s = [], time.monotonic()

    def _row(self, mount: str) -> MountPoint | None:
        return next((row for row in self._table or [] if row.name == mount), None)

    def _choose(self, place: Place) -> str:
        """Return the mount point for a place: the last one, unless another one is much nearer."""
        best, last = nearest_mount(self._table or [], *place[:2]), self._row(self._chosen)
        where = f"{self._address.host}:{self._address.port}"
        if best is None:
            count, self._table = len(self._table or []), None  # a caster that has just started may know more soon
            raise SourceError(f"{where}: none of {count} mount points gives RTCM 3 of a known place")
        if (distance_km := best.distance_km(*place[:2])) > self._reach_km:
            text = f"{where}: the nearest mount point, {best.name}, is {distance_km:.0f} km away (max_distance={self._reach_km:.0f})"
            raise RefusedError(text, lasting=True)
        if last is None or _much_nearer(best, last, place):
            self._chosen = best.name
        return self._chosen

    def _wait_for_place(self, stopping: threading.Event, text: str) -> Place | None:
        """Wait until there is a position; None when the process is to end."""
        if (place := self.find_place()) is None and self._say is not None:
            self._say(text)
        while place is None and not stopping.wait(POLL_S):
            place = self.find_place()
        return place


def _much_nearer(best: MountPoint, last: MountPoint, place: Place) -> bool:
    new_km, old_km = best.distance_km(*place[:2]), last.distance_km(*place[:2])
    return best.name != last.name and new_km < min(old_km - NEARER_KM, NEARER_SHARE * old_km)


def _moved(told: Place | None, place: Place) -> bool:
    """Return whether a place is far from the one that was told."""
    if told is None:
        return True
    distance_km = MountPoint("", lat_deg=told.lat_deg, lon_deg=told.lon_deg).distance_km(place.lat_deg, place.lon_deg)
    return isfinite(distance_km) and distance_km > MOVED_KM
