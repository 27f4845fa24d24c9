"""Payloads in a few buffers, and columns of them: the same as payloads one by one."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dexkit.messages.packed
from dexkit.messages import message_type
from dexkit.messages.columns import Columns
from dexkit.messages.packed import Packed, pieces, rows_at
from tests.messages_helpers import messages

PATHS = {
    "unitree_go::msg::dds_::MotorStates_": (
        "states",
        ["states[0].q", "states[2].temperature", "states[].mode", "states[0].reserve"],
    ),
    "unitree_hg::msg::dds_::HandState_": (
        "motor_state",
        [
            *("motor_state[1].q", "motor_state[].mode", "motor_state[0].temperature"),
            *("press_sensor_state[0].pressure", "press_sensor_state[].lost"),
            *("imu_state.quaternion", "imu_state.temperature", "error", "power_v"),
        ],
    ),
}


def packed(payloads: list[bytes], cuts: list[int], order: list[int]) -> Packed:
    """``payloads`` in blocks that begin at ``cuts``, given in ``order``."""
    edges = sorted({0, *(c for c in cuts if c < len(payloads)), len(payloads)})
    blocks = [np.frombuffer(b"".join(payloads[a:b]), dtype=np.uint8) for a, b in pairwise(edges)]
    sizes = np.array([len(p) for p in payloads], dtype=np.int64)
    starts = np.cumsum(sizes) - sizes
    which = np.array(order, dtype=np.intp)
    return Packed(blocks, starts[which], sizes[which])


def damaged(payload: bytes, at: int, value: int) -> bytes:
    """``payload`` with one byte written over."""
    at %= len(payload)
    return payload[:at] + bytes([value]) + payload[at + 1 :]


@given(st.lists(st.binary(max_size=9), max_size=12), st.data())
def test_payloads_are_given_as_they_were_put_in(payloads: list[bytes], data: st.DataObject) -> None:
    cuts = data.draw(st.lists(st.integers(0, 12), max_size=4))
    order = data.draw(st.permutations(range(len(payloads))))
    wanted = [payloads[i] for i in order]
    given_ = packed(payloads, cuts, order)
    found = [
        rows_at(data, np.array([start]), size)[0].tobytes()
        for data, starts, sizes in pieces(given_)
        for start, size in zip(starts.tolist(), sizes.tolist(), strict=True)
    ]
    assert found == wanted
    assert given_ == wanted
    assert given_[1:] == wanted[1:]
    assert [given_[i] for i in range(len(wanted))] == wanted
    assert [packed(payloads, cuts, order)[i] for i in range(len(wanted))] == wanted


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(sorted(PATHS)), st.data())
def test_columns_of_packed_payloads_are_those_of_single_ones(
    name: str, data: st.DataObject
) -> None:
    mt = message_type(name)
    sequence, paths = PATHS[name]
    whole = [mt.encode(m) for m in data.draw(st.lists(messages(name, 3), min_size=1, max_size=3))]
    kinds = st.one_of(
        st.sampled_from(whole),
        st.builds(damaged, st.sampled_from(whole), st.integers(0), st.integers(0, 255)),
        st.builds(lambda p, n: p[: n % len(p)], st.sampled_from(whole), st.integers(0)),
    )
    payloads = data.draw(st.lists(kinds, max_size=20))
    cuts = data.draw(st.lists(st.integers(0, 20), max_size=4))
    order = (
        list(range(len(payloads)))
        if data.draw(st.booleans())
        else data.draw(st.permutations(range(len(payloads))))
    )
    if data.draw(st.booleans()):
        bulk = mt.columns(packed(payloads, cuts, order))
    else:  # as a reader gets them: piece by piece, and put in order afterwards
        bulk = Columns(mt.layout)
        for edge in pairwise(sorted({0, *(c for c in cuts if c < len(payloads)), len(payloads)})):
            for piece in pieces(payloads[slice(*edge)]):
                bulk.append(*piece)
        bulk.reorder(np.array(order, dtype=np.intp))
    single = [mt.columns([payloads[i]]) for i in order]
    assert {i: str(e) for i, e in bulk.errors.items()} == {
        i: str(one.errors[0]) for i, one in enumerate(single) if one.errors
    }
    counts = [int(one.count(sequence)[0]) for one in single]
    assert bulk.count(sequence).tolist() == counts
    for path in paths:
        _same(bulk, single, path)


def _same(bulk: Columns, single: list[Columns], path: str) -> None:
    column = bulk[path]
    assert len(column) == len(single)
    for row, one in enumerate(single):
        value = one[path][0]
        wide = np.full(column.shape[1:], np.nan)
        wide[tuple(slice(n) for n in value.shape)] = value
        assert np.array_equal(column[row], wide, equal_nan=True)
    constant = bulk.constant(path)
    if constant is not None:
        assert not bulk.errors
        assert constant.shape == (1, *column.shape[1:])
        assert (column == constant).all() or np.isnan(constant).any()
    seen = column[bulk.ok]
    low, high = (f(seen) if seen.size else np.nan for f in (np.min, np.max))
    assert np.array_equal(bulk.extremes(path), (low, high), equal_nan=True)
    if column.ndim == 1:
        assert np.array_equal(bulk.table([path, path]), np.stack([column] * 2).T, equal_nan=True)


def test_columns_of_compressed_tables_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    mt = message_type("unitree_hg::msg::dds_::HandState_")
    random = np.random.default_rng(1)
    payloads = []
    for i in range(900):
        message = mt.cls(motor_state=[mt.motor_type.cls() for _ in range(2)])
        message.motor_state[0].q = float(random.normal())
        message.motor_state[1].q = float("nan") if i == 500 else float(i)
        message.motor_state[0].mode = i % 250
        message.power_v = float(i > 333)  # a word that begins to change within a table
        payloads.append(mt.encode(message))
    plain = mt.columns(payloads)
    made: list[int] = []

    class Sealed(dexkit.messages.packed._Sealed):
        def __init__(self, table: np.ndarray[tuple[int, ...], np.dtype[np.uint32]]) -> None:
            made.append(len(table))
            super().__init__(table)

    monkeypatch.setattr(dexkit.messages.packed, "_SEGMENT", 64)
    monkeypatch.setattr(dexkit.messages.packed, "_SEALED", 10)
    monkeypatch.setattr(dexkit.messages.packed, "_Sealed", Sealed)
    columns = mt.columns(payloads)
    assert len(made) > 5
    for path in ("motor_state[0].q", "motor_state[1].q", "motor_state[].mode", "power_v"):
        assert np.array_equal(columns[path], plain[path], equal_nan=True), path
        assert np.array_equal(columns.extremes(path), plain.extremes(path), equal_nan=True), path
        assert columns.constant(path) is None
