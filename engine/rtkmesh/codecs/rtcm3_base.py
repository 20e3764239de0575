"""A decoded stream to the RTCM 3 stream of a base station: what any receiver says, as MSM, station messages and ephemerides.

Time tags of MSM are whole milliseconds: ``at_whole_milliseconds`` turns the receiver's clock to them, which moves all ranges and phases
of an epoch by the same distance. Phases are levelled, and lock times are counted here, from the slips that the receiver told, so that
they show a slip also where the epoch of the slip itself was left out.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.messages import Message
from rtkmesh.codecs.rtcm3_encode import (
    PhaseLeveller,
    carriers_hz,
    encode_ephemeris,
    encode_epoch,
    encode_glonass_bias,
    encode_station_message,
)
from rtkmesh.codecs.rtcm3_thinning import ByteBudget, thinned
from rtkmesh.gnss.constants import SECONDS_PER_WEEK, SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.decimation import Decimator
from rtkmesh.gnss.ephemeris import Ephemeris, GlonassBias, GlonassEphemeris, KeplerEphemeris, ReferenceStation
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.signals import MAX_SATELLITE, MAX_SIGNAL, SATELLITES_PER_SYSTEM, SYSTEMS
from rtkmesh.gnss.time import GpsTime

_GLONASS_FIT_S: Final = 1800.0
_ALREADY_WHOLE_S: Final = 1e-9  # a time of week has no finer steps


@dataclass(frozen=True, slots=True)
class BaseOptions:
    """What a base sends.

    ``msm``: type of the observation messages, 4 to 7. ``systems``: RINEX letters. ``interval_s``: epochs at whole multiples of it, 0 all.
    ``bytes_per_second``: mean rate that is not exceeded (see ``rtcm3_thinning``), 0 no limit. ``station_interval_s``: seconds between
    the station's messages 1006, 1008, 1033 and 1230. ``ephemeris_interval_s``: seconds after which an ephemeris is sent again, 0 once.
    """

    msm: int = 7
    station_id: int = 0
    systems: str = SYSTEMS
    interval_s: float = 0.0
    bytes_per_second: float = 0.0
    station_interval_s: float = 10.0
    ephemeris_interval_s: float = 0.0


def at_whole_milliseconds(epoch: Epoch) -> Epoch:
    """Return the epoch as a receiver whose clock shows the nearest whole millisecond at the same instant would have measured it."""
    time = GpsTime.normalized(epoch.time.week, round(epoch.time.tow_s * 1e3) / 1e3)
    ahead_s = time - epoch.time
    if abs(ahead_s) < _ALREADY_WHOLE_S:
        return replace(epoch, time=time)
    range_m = ahead_s * SPEED_OF_LIGHT_MPS
    carrier = carriers_hz(epoch.satellite.astype(np.int64), epoch.signal.astype(np.int64), epoch.channel.astype(np.int64))
    phase_cyc = epoch.phase_cyc + np.where(carrier > 0.0, ahead_s * carrier, np.nan)
    return replace(epoch, time=time, pseudorange_m=epoch.pseudorange_m + range_m, phase_cyc=phase_cyc)


class ArcMemory:
    """Since when each phase has been tracked without a slip, as far as those who get only some of the epochs are to know."""

    def __init__(self) -> None:
        self._start_s: NDArray[np.float64] = np.full((MAX_SATELLITE, MAX_SIGNAL), np.nan)
        self._broken = np.zeros((MAX_SATELLITE, MAX_SIGNAL), np.bool_)
        self._last_s: NDArray[np.float64] = np.full((MAX_SATELLITE, MAX_SIGNAL), np.nan)
        self._epoch_s = np.nan

    def see(self, epoch: Epoch, time_s: float) -> None:
        """Take in an epoch, whether it is sent or not. Where no lock time is known a phase that was away counts as slipped."""
        tracked = np.isfinite(epoch.phase_cyc)
        index = epoch.satellite[tracked].astype(np.intp), epoch.signal[tracked].astype(np.intp)
        lock_s = epoch.lock_s[tracked]
        away = np.isnan(lock_s) & (self._last_s[index] != self._epoch_s)
        known = np.isfinite(self._start_s[index])
        slipped = (epoch.flags[tracked] & SLIP != 0) | away
        self._broken[index] |= slipped & known
        begun_s = np.where(slipped, time_s, time_s - np.where(np.isfinite(lock_s), lock_s, 0.0))
        self._start_s[index] = np.where(known, self._start_s[index], begun_s)
        self._last_s[index] = self._epoch_s = time_s

    def lock_s(self, epoch: Epoch, time_s: float) -> NDArray[np.float64]:
        """Return the lock times that an epoch is sent with: 0 where a slip came since the last one that was sent."""
        index = epoch.satellite.astype(np.intp), epoch.signal.astype(np.intp)
        return np.where(self._broken[index], 0.0, np.maximum(time_s - self._start_s[index], 0.0))

    def sent(self, epoch: Epoch, time_s: float) -> None:
        """Take note that an epoch was sent: its slips are told."""
        index = epoch.satellite.astype(np.intp), epoch.signal.astype(np.intp)
        self._start_s[index] = np.where(self._broken[index], time_s, self._start_s[index])
        self._broken[index] = False


class BaseEncoder:
    """Takes the messages of one decoded stream in their order and gives the frames of a base station.

    ``counters``: ``frames``, ``bytes``, ``epochs``, ``epochs_left_out`` (for want of bytes), ``ephemerides_unsendable``.
    """

    def __init__(self, options: BaseOptions) -> None:
        self._options = options
        self._station: ReferenceStation | None = None
        self._bias: GlonassBias | None = None
        self._ephemerides: dict[tuple[int, int], tuple[Ephemeris, bytes]] = {}
        self._ephemeris_sent_s: dict[tuple[int, int], float] = {}
        self._waiting: dict[tuple[int, int], None] = {}  # keys of ephemerides that are to be sent, in their order
        self.counters: Counter[str] = Counter()
        self.forget()

    @property
    def step(self) -> int:
        """How far epochs are thinned."""
        return self._budget.step

    def forget(self) -> None:
        """Begin a new stream: epochs may have been missed, and the new listener knows nothing of the station."""
        options = self._options
        self._leveller, self._arcs = PhaseLeveller(), ArcMemory()
        self._decimator, self._budget = Decimator(options.interval_s), ByteBudget(options.bytes_per_second)
        self._station_sent_s: float | None = None
        self._waiting = dict.fromkeys(self._ephemerides)

    def take(self, message: Message) -> list[bytes]:
        """Return the frames that are to be sent with this message: all of them come with epochs."""
        if isinstance(message, Epoch):
            return self._counted(self._epoch(message))
        if isinstance(message, KeplerEphemeris | GlonassEphemeris):
            self._ephemeris(message)
        elif isinstance(message, ReferenceStation):
            if message != self._station:
                self._station, self._station_sent_s = message, None
        elif isinstance(message, GlonassBias):
            self._bias = message
        return []

    def flush(self) -> list[bytes]:
        """Return what still waits for an epoch: the ephemerides."""
        waiting, self._waiting = self._waiting, {}
        return self._counted([self._ephemerides[key][1] for key in waiting])

    def _counted(self, frames: list[bytes]) -> list[bytes]:
        self.counters["frames"] += len(frames)
        self.counters["bytes"] += sum(map(len, frames))
        return frames

    def _ephemeris(self, ephemeris: Ephemeris) -> None:
        if SYSTEMS[ephemeris.satellite // SATELLITES_PER_SYSTEM] not in self._options.systems:
            return
        key = ephemeris.satellite, int(ephemeris.message) if isinstance(ephemeris, KeplerEphemeris) else -1
        try:
            frame = encode_ephemeris(ephemeris)
        except ValueError:  # a value that its field cannot hold, a message that RTCM has not got
            self.counters["ephemerides_unsendable"] += 1
            return
        if key not in self._ephemerides or self._ephemerides[key][1] != frame:
            self._ephemerides[key] = ephemeris, frame
            self._waiting[key] = None

    def _epoch(self, epoch: Epoch) -> list[bytes]:
        letters = self._options.systems
        kept = np.isin(epoch.satellite // SATELLITES_PER_SYSTEM, [SYSTEMS.index(letter) for letter in letters])
        epoch = at_whole_milliseconds(epoch if kept.all() else epoch.take(kept))
        time_s = epoch.time.week * SECONDS_PER_WEEK + epoch.time.tow_s
        epoch = self._leveller.level(epoch)
        self._arcs.see(epoch, time_s)
        if not self._decimator.takes(epoch.time) or not len(epoch):
            return []
        station, fixed_rate = self._station_messages(time_s)
        frames = self._budget.fit(epoch, time_s, fixed_rate, lambda part: self._observations(part, time_s))
        if not frames:
            self.counters["epochs_left_out"] += 1
            return station
        self.counters["epochs"] += 1
        self._arcs.sent(thinned(epoch, self._budget.step), time_s)
        return [*station, *frames, *self._ephemerides_due(epoch.time, time_s)]

    def _observations(self, epoch: Epoch, time_s: float) -> list[bytes]:
        lock_s = self._arcs.lock_s(epoch, time_s)
        return encode_epoch(replace(epoch, lock_s=lock_s), self._options.station_id, self._options.msm)

    def _station_messages(self, time_s: float) -> tuple[list[bytes], float]:
        """Return the station's messages if it is time for them, and their mean bytes per second. They are never left out."""
        frames = self._station_frames()
        interval_s = self._options.station_interval_s
        due = self._station_sent_s is None or not 0.0 <= time_s - self._station_sent_s < interval_s - _ALREADY_WHOLE_S
        if due:
            self._station_sent_s = time_s
        return (frames if due else []), sum(map(len, frames)) / interval_s

    def _station_frames(self) -> list[bytes]:
        station_id, frames = self._options.station_id, list[bytes]()
        if self._station is not None:
            station = replace(self._station, station_id=station_id)
            numbers = (1006, 1008, 1033) if station.position_ecef_m is not None else (1008, 1033)
            frames += [encode_station_message(station, number) for number in numbers]
        if self._bias is not None:
            frames.append(encode_glonass_bias(replace(self._bias, station_id=station_id)))
        return frames

    def _ephemerides_due(self, time: GpsTime, time_s: float) -> list[bytes]:
        """Return new ephemerides, and those that are to be sent again, as far as the link has room."""
        self._remind(time, time_s)
        unlimited, frames = self._options.bytes_per_second <= 0.0, list[bytes]()
        for key in tuple(self._waiting):
            frame = self._ephemerides[key][1]
            if not unlimited and len(frame) > self._budget.spare_bytes:
                break
            self._budget.spare_bytes -= len(frame)
            self._ephemeris_sent_s[key] = time_s
            del self._waiting[key]
            frames.append(frame)
        return frames

    def _remind(self, time: GpsTime, time_s: float) -> None:
        """Let ephemerides that are still valid wait again when their interval is over."""
        interval_s = self._options.ephemeris_interval_s
        if interval_s <= 0.0:
            return
        for key, (ephemeris, _) in self._ephemerides.items():
            fit_s = ephemeris.fit_s if isinstance(ephemeris, KeplerEphemeris) else _GLONASS_FIT_S
            due = time_s - self._ephemeris_sent_s.get(key, time_s) >= interval_s
            if due and abs(time - ephemeris.toe) <= fit_s:
                self._waiting[key] = None
