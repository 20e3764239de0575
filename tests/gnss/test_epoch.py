"""Epochs keep one row per satellite and signal, in order, whatever order they were made in; the wire keeps every bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtkmesh.gnss.epoch import COLUMNS, Epoch, make_epoch
from rtkmesh.gnss.signals import satellite_id, signal_code
from rtkmesh.gnss.time import GpsTime
from rtkmesh_schemas.errors import DecodeError
from rtkmesh_schemas.observation import Observation
from rtkmesh_schemas.wire import decode, encode, encoding_of
from rtkmesh_services.mapping.observation import epoch_of, observation_of

TIME = GpsTime(2300, 123.456)
rows = st.lists(st.tuples(st.integers(1, 63), st.sampled_from([28, 44, 74, 198])), min_size=1, max_size=40)
any_float = st.floats(width=64, allow_nan=True, allow_infinity=True)


@given(rows)
def test_rows_are_sorted_and_single(pairs: list[tuple[int, int]]) -> None:
    epoch = make_epoch(
        TIME, satellite=[s for s, _ in pairs], signal=[g for _, g in pairs], pseudorange_m=np.arange(len(pairs), dtype=float)
    )
    made = list(zip(epoch.satellite.tolist(), epoch.signal.tolist(), strict=True))
    assert made == sorted(set(pairs))
    for i, pair in enumerate(made):
        assert epoch.pseudorange_m[i] == pairs.index(pair)
    assert np.isnan(epoch.phase_cyc).all()


@given(rows, st.data())
def test_the_wire_keeps_every_bit(pairs: list[tuple[int, int]], data: st.DataObject) -> None:
    count = len(pairs)
    values = data.draw(st.lists(any_float, min_size=count, max_size=count))
    epoch = make_epoch(TIME, satellite=[s for s, _ in pairs], signal=[g for _, g in pairs], phase_cyc=values, flags=[3] * count)
    message = observation_of(epoch, source="rover", start_id="a", sequence=9)
    again = epoch_of(decode(Observation, encode(message), encoding_of(Observation)))
    assert again.time == epoch.time
    for name, _, _ in COLUMNS:
        column, back = getattr(epoch, name), getattr(again, name)
        assert (column.tobytes(), column.dtype) == (back.tobytes(), back.dtype)
        assert back.flags.writeable


def test_columns_that_do_not_fit_are_refused() -> None:
    epoch = make_epoch(TIME, satellite=[1, 2], signal=[28, 28])
    message = observation_of(epoch, source="rover", start_id="a", sequence=0)
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    for name, wrong in (("phase_cyc", b"\0" * 8), ("cn0_dbhz", b"\0" * 13), ("satellite", ["G01", "Q99"]), ("signal", ["1C"])):
        with pytest.raises(DecodeError):
            epoch_of(Observation(**{**fields, name: wrong}))


def test_rows_for_people() -> None:
    epoch: Epoch = make_epoch(TIME, satellite=[5], signal=[28], pseudorange_m=[2.0e7], cn0_dbhz=[45.0])
    [row] = epoch.rows()
    assert row[:3] == (satellite_id(5), signal_code(28), 2.0e7)
    assert len(epoch.take(np.array([False]))) == 0
