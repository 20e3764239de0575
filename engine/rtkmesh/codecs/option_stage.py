"""What receiver options do to the messages of a stream, behind all decoders."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtkmesh.codecs.messages import Protocol
from rtkmesh.gnss.constants import SPEED_OF_LIGHT_MPS
from rtkmesh.gnss.ephemeris import Ephemeris, KeplerEphemeris, NavigationMessage
from rtkmesh.gnss.epoch import SLIP, Epoch
from rtkmesh.gnss.receiver_options import ReceiverOptions
from rtkmesh.gnss.signals import (
    ATTRIBUTES,
    GALILEO,
    MAX_SATELLITE,
    MAX_SIGNAL,
    SATELLITES_PER_SYSTEM,
    SYSTEMS,
    carrier_hz,
    signal_number,
)
from rtkmesh.gnss.time import GpsTime

_SIGMA_STEP_CYC: Final = 0.004  # of u-blox's index of the phase's sigma
_WORST_STEP: Final = 15.0  # where the receiver says none
_HALF_STEP: Final = 0.5
_TEXT_OF: Final = {NavigationMessage.INAV: "inav", NavigationMessage.FNAV: "fnav"}


class OptionStage:
    """Applies the options of one receiver."""

    def __init__(self, options: ReceiverOptions) -> None:
        self._options = options
        self._wanted = [(SYSTEMS.index(text[0]), signal_number(text[1:])) for text in options.signals]
        self._slipped = np.zeros((MAX_SATELLITE, MAX_SIGNAL), np.bool_)  # while their phases were left out
        o = options
        self._changes = bool(o.rounding_s or o.invert_doppler or o.signals or o.slip_sigma is not None or o.drop_sigma is not None)

    def passes(self, ephemeris: Ephemeris) -> bool:
        """Return whether an ephemeris is to be used: of Galileo only the wanted message's, where one is wanted."""
        wanted = self._options.galileo
        if not wanted or not isinstance(ephemeris, KeplerEphemeris) or ephemeris.satellite // SATELLITES_PER_SYSTEM != GALILEO:
            return True
        return _TEXT_OF.get(ephemeris.message) == wanted

    def epoch(self, epoch: Epoch, protocol: Protocol) -> Epoch:
        """Return the epoch as the options want it."""
        if not self._changes:
            return epoch
        o = self._options
        if self._wanted:
            epoch = epoch.take(self._kept(epoch))
        if protocol is Protocol.RTCM3 and o.invert_doppler:
            epoch = replace(epoch, doppler_hz=-epoch.doppler_hz)
        if protocol is not Protocol.RTCM3:
            epoch = self._by_sigma(epoch)
            epoch = rounded(epoch, o.rounding_s) if o.rounding_s else epoch
        return epoch

    def _kept(self, epoch: Epoch) -> NDArray[np.bool_]:
        """Return which rows stay: where a satellite has a wanted signal, its others of the band go."""
        kept = np.ones(len(epoch), np.bool_)
        wanted = np.zeros(len(epoch), np.bool_)
        for system, signal in self._wanted:
            wanted |= (epoch.satellite // SATELLITES_PER_SYSTEM == system) & (epoch.signal == signal)
        for k in np.flatnonzero(wanted).tolist():
            same_band = (epoch.satellite == epoch.satellite[k]) & (epoch.signal // ATTRIBUTES == epoch.signal[k] // ATTRIBUTES)
            kept &= ~same_band | wanted
        return kept

    def _by_sigma(self, epoch: Epoch) -> Epoch:
        """Mark slips and leave out phases by the receiver's own sigma of them; a slip of one that is left out is told with the next."""
        o = self._options
        if o.slip_sigma is None and o.drop_sigma is None:
            return epoch
        steps = np.where(np.isnan(epoch.phase_sigma_cyc), _WORST_STEP, epoch.phase_sigma_cyc / _SIGMA_STEP_CYC)
        flags, phase = epoch.flags.copy(), epoch.phase_cyc.copy()
        if o.slip_sigma is not None:
            flags[(steps > o.slip_sigma - _HALF_STEP) & np.isfinite(phase)] |= SLIP
        if o.drop_sigma is not None:
            dropped, waiting = (steps > o.drop_sigma + _HALF_STEP) & np.isfinite(phase), self._slipped[epoch.satellite, epoch.signal]
            waiting |= (flags & SLIP) > 0
            flags[waiting & np.isfinite(phase)] |= SLIP
            self._slipped[epoch.satellite, epoch.signal] = waiting & (dropped | np.isnan(phase))
            phase[dropped], flags[dropped] = np.nan, 0
        return replace(epoch, flags=flags, phase_cyc=phase)


def rounded(epoch: Epoch, step_s: float) -> Epoch:
    """Return the epoch with its time tag at the nearest multiple of ``step_s``, as if the receiver's clock had been set to that.

    Pseudoranges change by the speed of light times the step, phases by as many cycles.
    """
    late_s = epoch.time.tow_s - round(epoch.time.tow_s / step_s) * step_s
    time = GpsTime.normalized(epoch.time.week, round((epoch.time.tow_s - late_s) * 1e9) / 1e9)
    hz = np.array([
        carrier_hz(satellite, signal, channel)
        for satellite, signal, channel in zip(epoch.satellite.tolist(), epoch.signal.tolist(), epoch.channel.tolist(), strict=True)
    ])  # fmt: skip
    phase_cyc = np.where(hz > 0.0, epoch.phase_cyc - late_s * hz, np.nan)
    return replace(epoch, time=time, pseudorange_m=epoch.pseudorange_m - late_s * SPEED_OF_LIGHT_MPS, phase_cyc=phase_cyc)
