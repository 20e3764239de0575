"""CRC-valid frames with any content: nothing raises, nothing grows, every frame is accounted for."""

from hypothesis import given, settings
from hypothesis import strategies as st

from rtkmesh.codecs.messages import Frame, Protocol
from rtkmesh.codecs.rtcm3 import Rtcm3Decoder
from rtkmesh.codecs.rtcm3_encode import frame
from rtkmesh.codecs.rtcm3_ephemeris import LAYOUTS
from rtkmesh.gnss.epoch import Epoch
from rtkmesh.gnss.time import GpsTime

KNOWN = (*range(1001, 1014), 1019, 1020, 1029, 1033, *range(1041, 1047), *range(1071, 1078), *range(1081, 1088), *range(1091, 1098))
KNOWN = (*KNOWN, *range(1101, 1108), *range(1111, 1118), *range(1121, 1128), *range(1131, 1138), 1230, 4072)


@st.composite
def payloads(draw: st.DrawFn) -> bytes:
    """A known or any number, then random bytes, often of just the length that the message has, often sparse."""
    number = draw(st.one_of(st.sampled_from(KNOWN), st.integers(0, 4095)))
    exact = [-(-LAYOUTS[number].bits // 8) - 2] if number in LAYOUTS else [17, 19, 60, 200]
    length = draw(st.one_of(st.sampled_from(exact), st.integers(0, 1021)))
    rng = draw(st.randoms(use_true_random=False))
    zeros = draw(st.sampled_from((0, 2, 6)))  # sparse bytes: masks with few bits, so that cells follow
    body = bytes(rng.getrandbits(8) if rng.randint(0, zeros) == 0 else 0 for _ in range(length))
    first = number << 4 | (body[0] & 15 if body else 0)
    return first.to_bytes(2, "big") + body


@settings(max_examples=40, deadline=None)
@given(stream=st.lists(payloads(), min_size=1, max_size=25), timed=st.booleans())
def test_any_crc_valid_stream_decodes_without_an_exception(stream: list[bytes], timed: bool):
    """Epochs that come out are sorted, finite in time and of equal columns; frames are decoded, ignored or rejected."""
    decoder = Rtcm3Decoder(GpsTime(2400, 0.0) if timed else None)
    messages = [message for payload in stream for message in decoder.decode(Frame(Protocol.RTCM3, "", frame(payload)))]
    messages += decoder.flush()
    for epoch in (message for message in messages if isinstance(message, Epoch)):
        keys = epoch.satellite.astype(int) * 512 + epoch.signal
        assert (keys[1:] > keys[:-1]).all()
        assert 0.0 <= epoch.time.tow_s < 604800.0
        assert len({len(epoch.flags), len(epoch.channel), len(epoch.pseudorange_m), len(epoch.lock_s), len(epoch)}) == 1
    counters = decoder.counters
    assert counters.epochs == sum(isinstance(message, Epoch) for message in messages)
    assert sum(counters.decoded.values()) + sum(counters.ignored.values()) + sum(counters.rejected.values()) >= len(stream)
