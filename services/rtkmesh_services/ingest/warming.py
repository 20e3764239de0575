"""What is compiled or loaded before the first byte comes."""

from functools import cache

from rtkmesh.codecs.rtcm3_encode import encode_epoch
from rtkmesh.codecs.sbf_encode import block, encode_meas_epoch, encode_meas_extra
from rtkmesh.codecs.sbf_navigation import GPS_RAW_CA
from rtkmesh.codecs.stream import StreamDecoder, StreamOptions
from rtkmesh.codecs.ubx_encode import encode_rawx
from rtkmesh.codecs.unicore_encode import encode_compressed, encode_observations
from rtkmesh.gnss.epoch import make_epoch
from rtkmesh.gnss.signals import NO_CHANNEL, satellite_number, signal_number
from rtkmesh.gnss.time import GpsTime


@cache
def warm_decoder() -> None:
    """Decode an epoch of each protocol that receivers send, so that the kernels are compiled or loaded before the first byte."""
    start = GpsTime(2400, 0.0)
    satellites = [satellite_number(name) for name in ("G05", "R07", "E11", "C23")]
    signals = [signal_number(code) for code in ("1C", "1C", "1C", "2I")]
    columns = {
        "pseudorange_m": [2.2e7] * 4,
        "phase_cyc": [1.1e8] * 4,
        "doppler_hz": [10.0] * 4,
        "cn0_dbhz": [45.0] * 4,
        "lock_s": [9.0] * 4,
    }
    epoch = make_epoch(start, satellite=satellites, signal=signals, channel=[NO_CHANNEL, 1, NO_CHANNEL, NO_CHANNEL], **columns)
    decoder = StreamDecoder(StreamOptions(approximate_time=start))
    unicore = encode_observations(epoch), encode_compressed(epoch, "OBSVMCMP")
    septentrio = encode_meas_epoch(epoch) + encode_meas_extra(epoch)
    subframe = block(GPS_RAW_CA, start, bytes((5, 1)) + bytes(44))  # nothing in it: the kernels that look at it refuse it
    for data in (encode_rawx(epoch), *encode_epoch(epoch, 1), *unicore, septentrio, septentrio, subframe):
        decoder.feed(data)
    decoder.flush()
