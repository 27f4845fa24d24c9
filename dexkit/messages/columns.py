"""Many samples of one type at once, as numpy columns.

Samples of equal shape (byte order, sequence lengths) are looked at as one structured array, so a
recording is read at memory speed instead of object by object.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError, WireError
from dexkit.messages.codec import check_count, check_end, is_big, truncated
from dexkit.messages.layout import Field, Primitive, Struct, max_size

__all__ = ["Columns", "Packed"]

_STEP = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\[(?P<index>\d*)\])?")
_UINT32 = (struct.Struct("<I"), struct.Struct(">I"))


class Packed(Sequence[bytes]):
    """Payloads in one buffer: many samples without an object for each.

    :param starts: where each begins in ``buffer``, shape (n,).
    :param sizes: how long each is, shape (n,).
    """

    def __init__(self, buffer: bytes, starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> None:
        self._buffer = buffer
        self._bytes = np.frombuffer(buffer, dtype=np.uint8)
        self._starts = starts
        self._sizes = sizes

    def __len__(self) -> int:
        return len(self._starts)

    @overload
    def __getitem__(self, at: int) -> bytes: ...
    @overload
    def __getitem__(self, at: slice) -> Packed: ...
    def __getitem__(self, at: int | slice) -> bytes | Packed:
        if isinstance(at, slice):
            return Packed(self._buffer, self._starts[at], self._sizes[at])
        start = int(self._starts[at])
        return self._buffer[start : start + int(self._sizes[at])]

    def __iter__(self) -> Iterator[bytes]:
        for start, size in zip(self._starts.tolist(), self._sizes.tolist(), strict=True):
            yield self._buffer[start : start + size]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence) or isinstance(other, (str, bytes)):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def alike(self) -> list[NDArray[np.intp]]:
        """Rows of equal length and equal first two bytes, those that come first first."""
        known = self._sizes >= 2
        head = np.zeros(len(self), dtype=np.int64)
        first = self._starts[known]
        head[known] = self._bytes[first] | self._bytes[first + 1].astype(np.int64) << 8
        keys, which = np.unique(self._sizes << 16 | head, return_inverse=True)
        groups = [np.flatnonzero(which == i) for i in range(len(keys))]
        return sorted(groups, key=lambda rows: int(rows[0]))

    def table(self, rows: NDArray[np.intp]) -> NDArray[np.uint8]:
        """Payloads of one length, shape (n, length)."""
        size = int(self._sizes[rows[0]])
        starts = self._starts[rows]
        if len(rows) > 1 and (np.diff(starts) == size).all():  # as they lie: no copy
            begin = int(starts[0])
            return self._bytes[begin : begin + size * len(rows)].reshape(len(rows), size)
        if not size:
            return np.empty((len(rows), 0), dtype=np.uint8)
        return np.lib.stride_tricks.sliding_window_view(self._bytes, size)[starts]


class Columns:
    """Columns of ``payloads``, all of one message type.

    :ivar errors: what is wrong with each sample that cannot be decoded, by its index.

    A column has one row per payload. What a sample does not have (it cannot be decoded, or its
    sequence is shorter) is NaN. Paths name members: ``"states[0].q"`` has shape (n,),
    ``"reserve"`` of an array member shape (n, length), ``"motor_state[].q"`` shape
    (n, longest sequence).
    """

    def __init__(self, kind: Struct, payloads: Sequence[bytes]) -> None:
        self._kind = kind
        self._n = len(payloads)
        self._limit = max_size(kind)
        self._sequences = [f.name for f in kind.fields if f.sequence]
        self.errors: dict[int, WireError] = {}
        self._groups: list[tuple[NDArray[np.intp], tuple[int, ...], NDArray[Any]]] = []
        # Samples of one length nearly always have one shape: parse one of them, compare the
        # others' sequence lengths with it in bulk, and parse singly only those that differ.
        odd: list[int] = []
        for rows in _alike(payloads):
            at, shape = self._first_good(rows, payloads)
            if shape is None:
                continue
            rest = rows[at:]
            table = _table(payloads, rest)
            where = _count_bytes(kind, shape[1])
            same = (table[:, where] == table[0, where]).all(axis=1)
            if same.all():
                self._add(shape, rest, table)
            else:
                self._add(shape, rest[same], table[same])
                odd += rest[~same].tolist()
        shapes: dict[tuple[bool, tuple[int, ...], int], list[int]] = {}
        for row in odd:
            shape = self._shape_of(row, payloads)
            if shape is not None:
                shapes.setdefault((*shape, len(payloads[row])), []).append(row)
        for (big, counts, _), found in shapes.items():
            rows = np.array(found, dtype=np.intp)
            self._add((big, counts), rows, _table(payloads, rows))

    def _shape_of(self, row: int, payloads: Sequence[bytes]) -> tuple[bool, tuple[int, ...]] | None:
        data = payloads[row]
        try:
            big = is_big(data, self._limit, self._kind.name)
            return big, _counts(self._kind, data, big)
        except WireError as error:
            self.errors[row] = error
            return None

    def _first_good(
        self, rows: NDArray[np.intp], payloads: Sequence[bytes]
    ) -> tuple[int, tuple[bool, tuple[int, ...]] | None]:
        for at, row in enumerate(rows):
            shape = self._shape_of(int(row), payloads)
            if shape is not None:
                return at, shape
        return len(rows), None

    def _add(
        self,
        shape: tuple[bool, tuple[int, ...]],
        rows: NDArray[np.intp],
        table: NDArray[np.uint8],
    ) -> None:
        big, counts = shape
        dtype = _dtype(self._kind, counts, ">" if big else "<", table.shape[1])
        self._groups.append((rows, counts, np.ascontiguousarray(table).view(dtype)[:, 0]))

    def __len__(self) -> int:
        return self._n

    @property
    def ok(self) -> NDArray[np.bool_]:
        """Which samples can be decoded, shape (n,)."""
        good = np.ones(self._n, dtype=np.bool_)
        good[list(self.errors)] = False
        return good

    def count(self, sequence: str) -> NDArray[np.intp]:
        """Length of a sequence in each sample, shape (n,); -1 where it cannot be decoded.

        :raises UsageError: the type has no such sequence.
        """
        if sequence not in self._sequences:
            raise UsageError(f"{self._kind.name} has no sequence {sequence!r}")
        at = self._sequences.index(sequence)
        out = np.full(self._n, -1, dtype=np.intp)
        for rows, counts, _ in self._groups:
            out[rows] = counts[at]
        return out

    def __getitem__(self, path: str) -> NDArray[np.float64]:
        """The column at ``path``, as float64 (every member's type fits).

        :raises UsageError: the type has no such member.
        """
        steps = list(self._steps(path))
        shape = self._shape(steps)
        out = np.full((self._n, *shape), np.nan)
        for rows, _, table in self._groups:
            values: NDArray[Any] | None = table
            for member, index in steps:
                assert values is not None
                values = values[member.name]
                if index is not None:
                    if index >= values.shape[1]:
                        values = None
                        break
                    values = values[:, index]
            if values is None:
                continue
            if not shape:
                out[rows] = values
            else:
                out[rows[:, None], np.arange(values.shape[1])] = values
        return out

    def _steps(self, path: str) -> Iterator[tuple[Field, int | None]]:
        """Parse and check a path: each member with its index, if any."""
        kind: Struct | Primitive = self._kind
        wide = 0
        for text in path.split("."):
            match = _STEP.fullmatch(text)
            fields = {f.name: f for f in kind.fields} if isinstance(kind, Struct) else {}
            if match is None or match["name"] not in fields:
                raise UsageError(
                    f"{self._kind.name} has no member {path!r}",
                    hint=f"at {text!r}: {', '.join(fields) or 'a number has no members'}",
                )
            member = fields[match["name"]]
            many = member.sequence or member.array is not None
            index = int(match["index"]) if match["index"] else None
            if match["index"] is not None and not many:
                raise UsageError(f"{self._kind.name}: {match['name']} in {path!r} is not a list")
            if member.array is not None and index is not None and index >= member.array:
                raise UsageError(f"{path!r}: {member.name} has {member.array} elements")
            wide += many and index is None
            yield member, index
            kind = member.type
        if isinstance(kind, Struct):
            raise UsageError(
                f"{path!r} is a {kind.name}, not a number",
                hint=f"its members: {', '.join(f.name for f in kind.fields)}",
            )
        if wide > 1:
            raise UsageError(f"{path!r} has two open dimensions; give one an index")

    def _shape(self, steps: list[tuple[Field, int | None]]) -> tuple[int, ...]:
        for member, index in steps:
            if index is None and member.sequence:
                lengths = self.count(member.name)
                return (int(lengths.max(initial=0)),)
            if index is None and member.array is not None:
                return (member.array,)
        return ()


def _alike(payloads: Sequence[bytes]) -> list[NDArray[np.intp]]:
    if isinstance(payloads, Packed):
        return payloads.alike()
    sizes: dict[tuple[bytes, int], list[int]] = {}
    for row, data in enumerate(payloads):
        sizes.setdefault((data[:2], len(data)), []).append(row)
    return [np.array(rows, dtype=np.intp) for rows in sizes.values()]


def _table(payloads: Sequence[bytes], rows: NDArray[np.intp]) -> NDArray[np.uint8]:
    if isinstance(payloads, Packed):
        return payloads.table(rows)
    joined = b"".join(payloads[i] for i in rows)
    return np.frombuffer(joined, dtype=np.uint8).reshape(len(rows), -1)


def _counts(kind: Struct, data: bytes, big: bool) -> tuple[int, ...]:
    """Lengths of the sequences; checks that the sample has exactly the length they ask for."""
    counts = []
    at = 0
    for member in kind.fields:
        if member.sequence:
            assert isinstance(member.type, Struct)
            at += -at % 4
            if len(data) < at + 8:
                raise truncated(kind.name, at + 8, len(data))
            count = _UINT32[big].unpack_from(data, at + 4)[0]
            at += 4 + count * member.type.end(0)
            check_count(f"{kind.name}.{member.name}", count, at + 4, len(data))
            counts.append(count)
        else:
            at = _end(member, at)
    if len(data) < at + 4:
        raise truncated(kind.name, at + 4, len(data))
    check_end(kind.name, data, at + 4)
    return tuple(counts)


def _count_bytes(kind: Struct, counts: tuple[int, ...]) -> list[int]:
    """Indices of the bytes that hold the sequence lengths of a sample with these lengths."""
    out: list[int] = []
    remaining = list(counts)
    at = 0
    for member in kind.fields:
        if member.sequence:
            assert isinstance(member.type, Struct)
            at += -at % 4
            out += range(at + 4, at + 8)
            at += 4 + remaining.pop(0) * member.type.end(0)
        else:
            at = _end(member, at)
    return out


def _end(member: Field, at: int) -> int:
    return Struct((), "", (member,)).end(at)


def _dtype(kind: Struct, counts: tuple[int, ...], order: str, size: int) -> np.dtype[Any]:
    """Structured type of a whole sample, header included."""
    names, formats, offsets = [], [], []
    remaining = list(counts)
    at = 0
    for member in kind.fields:
        names.append(member.name)
        if member.sequence:
            assert isinstance(member.type, Struct)
            at += -at % 4 + 4
            count = remaining.pop(0)
            formats.append(np.dtype((_element(member.type, 0, order), (count,))))
            offsets.append(at + 4)
            at += count * member.type.end(0)
            continue
        if isinstance(member.type, Struct):
            formats.append(_element(member.type, at, order))
            offsets.append(at + 4)
        else:
            formats.append(_number(member, order))
            offsets.append(at + 4 + -at % member.type.size)
        at = _end(member, at)
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def _number(member: Field, order: str) -> np.dtype[Any]:
    assert isinstance(member.type, Primitive)
    base = np.dtype(order + member.type.dtype)
    return base if member.array is None else np.dtype((base, (member.array,)))


def _element(kind: Struct, start: int, order: str) -> np.dtype[Any]:
    """Structured type of a fixed struct that starts at ``start``; offsets count from there."""
    names, formats, offsets = [], [], []
    at = start
    for member in kind.fields:
        names.append(member.name)
        if isinstance(member.type, Struct):
            formats.append(_element(member.type, at, order))
            offsets.append(at - start)
        else:
            formats.append(_number(member, order))
            offsets.append(at + -at % member.type.size - start)
        at = _end(member, at)
    return np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": at - start}
    )
