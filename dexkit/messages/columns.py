"""Many samples of one type at once, as numpy columns.

Samples of equal shape (byte order, sequence lengths) are looked at as one structured array, so a
recording is read at memory speed instead of object by object.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError, WireError
from dexkit.messages.codec import check_count, check_end, is_big, truncated
from dexkit.messages.layout import Field, Primitive, Struct, max_size

__all__ = ["Columns", "Packed"]

_STEP = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\[(?P<index>\d*)\])?")
_UINT32 = (struct.Struct("<I"), struct.Struct(">I"))
_BLOCK = 512
"""Samples that are turned into columns at once: few enough to stay in the processor's cache."""

_Steps: TypeAlias = tuple[tuple[Field, "int | None"], ...]


class Packed(Sequence[bytes]):
    """Payloads one behind the other in a few buffers: many samples without an object for each.

    :param blocks: the buffers, each of whole payloads.
    :param starts: where each payload begins, counted through all of ``blocks``, shape (n,).
    :param sizes: how long each is, shape (n,).
    """

    def __init__(
        self,
        blocks: Sequence[NDArray[np.uint8]],
        starts: NDArray[np.int64],
        sizes: NDArray[np.int64],
    ) -> None:
        self._blocks = blocks
        self._joined: NDArray[np.uint8] | None = None
        self._starts = starts
        self._sizes = sizes

    @property
    def _bytes(self) -> NDArray[np.uint8]:
        """All blocks as one, for those who do not go from front to back."""
        if self._joined is None:
            self._joined = np.concatenate([np.empty(0, np.uint8), *self._blocks])
            self._blocks = [self._joined]  # so that they are not held twice
        return self._joined

    def __len__(self) -> int:
        return len(self._starts)

    @overload
    def __getitem__(self, at: int) -> bytes: ...
    @overload
    def __getitem__(self, at: slice) -> Packed: ...
    def __getitem__(self, at: int | slice) -> bytes | Packed:
        if isinstance(at, slice):
            return Packed([self._bytes], self._starts[at], self._sizes[at])
        start, size = int(self._starts[at]), int(self._sizes[at])
        first = self._blocks[0] if len(self._blocks) else self._bytes
        if start + size <= len(first):
            return first[start : start + size].tobytes()
        return self._bytes[start : start + size].tobytes()

    def __iter__(self) -> Iterator[bytes]:
        buffer = self._bytes.data
        for start, size in zip(self._starts.tolist(), self._sizes.tolist(), strict=True):
            yield bytes(buffer[start : start + size])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence) or isinstance(other, (str, bytes)):
            return NotImplemented
        return len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def alike(self) -> list[NDArray[np.intp]]:
        """Rows of equal length and equal first two bytes, those that come first first."""
        if not len(self):
            return []
        every = np.arange(len(self))
        tables = self._as_they_lie(every) if self._sizes[0] >= 2 else None
        if tables is not None:
            head = np.concatenate([t[:, 0] | t[:, 1].astype(np.int64) << 8 for t in tables])
        else:
            known = self._sizes >= 2
            head = np.zeros(len(self), dtype=np.int64)
            first = self._starts[known]
            head[known] = self._bytes[first] | self._bytes[first + 1].astype(np.int64) << 8
        keys = self._sizes << 16 | head
        if (keys == keys[0]).all():
            return [every]
        keys, which = np.unique(keys, return_inverse=True)
        groups = [np.flatnonzero(which == i) for i in range(len(keys))]
        return sorted(groups, key=lambda rows: int(rows[0]))

    def tables(self, rows: NDArray[np.intp]) -> list[NDArray[np.uint8]]:
        """Payloads of one length in their order, in pieces of shape (some, length)."""
        tables = self._as_they_lie(rows)
        if tables is not None:
            return tables
        size = int(self._sizes[rows[0]])
        if not size:
            return [np.empty((len(rows), 0), dtype=np.uint8)]
        every = np.lib.stride_tricks.sliding_window_view(self._bytes, size)
        return [every[self._starts[rows]]]

    def _as_they_lie(self, rows: NDArray[np.intp]) -> list[NDArray[np.uint8]] | None:
        """The same without a copy, if they are of one length and lie one behind the other."""
        size = int(self._sizes[rows[0]])
        starts = self._starts[rows]
        if not size or (self._sizes[rows] != size).any() or (np.diff(starts) != size).any():
            return None
        begin, end = int(starts[0]), int(starts[-1]) + size
        found: list[NDArray[np.uint8]] = []
        base = 0
        for block in self._blocks:
            piece = block[max(begin - base, 0) : max(end - base, 0)]
            if len(piece):
                found.append(piece.reshape(-1, size))
            base += len(block)
        return found


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
        self._groups: list[_Group] = []
        self._paths: dict[str, _Steps] = {}
        # Samples of one length nearly always have one shape: parse one of them, compare the
        # others' sequence lengths with it in bulk, and parse singly only those that differ.
        odd: list[int] = []
        for rows in _alike(payloads):
            at, shape = self._first_good(rows, payloads)
            if shape is None:
                continue
            rest = rows[at:]
            words = _Words(_tables(payloads, rest), len(rest))
            same = words.same(_count_words(kind, shape[1]))
            if same is None:
                self._add(shape, rest, words)
            else:
                self._add(shape, rest[same], words.only(same))
                odd += rest[~same].tolist()
        shapes: dict[tuple[bool, tuple[int, ...], int], list[int]] = {}
        for row in odd:
            shape = self._shape_of(row, payloads)
            if shape is not None:
                shapes.setdefault((*shape, len(payloads[row])), []).append(row)
        for (big, counts, _), found in shapes.items():
            rows = np.array(found, dtype=np.intp)
            self._add((big, counts), rows, _Words(_tables(payloads, rows), len(rows)))

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
        self, shape: tuple[bool, tuple[int, ...]], rows: NDArray[np.intp], words: _Words
    ) -> None:
        big, counts = shape
        dtype = _dtype(self._kind, counts, ">" if big else "<", words.size)
        where = slice(None) if len(rows) == self._n else rows
        self._groups.append(_Group(where, counts, dtype, words))

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
        for group in self._groups:
            out[group.rows] = group.counts[at]
        return out

    def __getitem__(self, path: str) -> NDArray[np.float64]:
        """The column at ``path``, as float64 (every member's type fits).

        :raises UsageError: the type has no such member.
        """
        steps = self._steps(path)
        shape = self._shape(steps)
        out = np.full((*shape, self._n), np.nan)
        for group in self._groups:
            leaf, places = group.places(steps)
            for column, at in zip(out.reshape(-1, self._n), places, strict=False):
                column[group.rows] = group.words.column(leaf, at)
        return out.T

    def constant(self, path: str) -> NDArray[np.float64] | None:
        """The row that every sample has at ``path``, shape (1,) or (1, length); None if they
        differ, or if not all have it.

        :raises UsageError: as for a column.
        """
        steps = self._steps(path)
        if len(self._groups) != 1 or not isinstance(self._groups[0].rows, slice):
            return None
        group = self._groups[0]
        leaf, places = group.places(steps)
        shape = self._shape(steps)
        if len(places) != (shape[0] if shape else 1):
            return None
        if any(group.words.varies(at) for at in places):
            return None
        values = [group.words.first(leaf, at) for at in places]
        return np.array(values, dtype=np.float64).reshape(1, *shape)

    def _steps(self, path: str) -> _Steps:
        if path not in self._paths:
            self._paths[path] = _steps(self._kind, path)
        return self._paths[path]

    def _shape(self, steps: _Steps) -> tuple[int, ...]:
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


def _tables(payloads: Sequence[bytes], rows: NDArray[np.intp]) -> list[NDArray[np.uint8]]:
    if isinstance(payloads, Packed):
        return payloads.tables(rows)
    joined = b"".join(payloads[i] for i in rows)
    return [np.frombuffer(joined, dtype=np.uint8).reshape(len(rows), -1)]


class _Words:
    """Samples of one shape, word by word: the first of them, and columns of what changes.

    Most of a state never changes, and what does is asked for member by member. So a sample is
    read once, when it is in the cache, and only its changing words are kept.

    :param tables: the samples, in pieces of shape (some, size).
    :ivar size: bytes in a sample.
    """

    def __init__(self, tables: Sequence[NDArray[np.uint8]], n: int) -> None:
        self.size = tables[0].shape[1]
        self._row = _aligned(tables[0][:1])[0]
        # changing words in the order in which they began to; memory not touched costs nothing
        self._changing: list[int] = []
        self._columns: NDArray[np.uint32] = np.empty((len(self._row), n), dtype=np.uint32)
        begin = 0
        for table in tables:
            for at in range(0, len(table), _BLOCK):
                piece = _aligned(table[at : at + _BLOCK])
                self._put(begin, piece)
                begin += len(piece)
        self._place = {word: place for place, word in enumerate(self._changing)}

    def _put(self, begin: int, piece: NDArray[np.uint32]) -> None:
        changes = np.bitwise_or.reduce(piece ^ self._row, axis=0)
        changes[self._changing] = 0
        for word in np.flatnonzero(changes).tolist():
            self._columns[len(self._changing), :begin] = self._row[word]
            self._changing.append(word)
        known = slice(len(self._changing)), slice(begin, begin + len(piece))
        self._columns[known] = piece.take(self._changing, axis=1).T

    def same(self, words: list[int]) -> NDArray[np.bool_] | None:
        """Which samples have these words as the first has them; None for all."""
        found = [self._columns[self._place[w]] == self._row[w] for w in words if w in self._place]
        return np.logical_and.reduce(found) if found else None

    def only(self, rows: NDArray[np.bool_]) -> _Words:
        """Some of the samples, the first among them."""
        out = copy(self)
        # in order of columns, as they were: their bytes are looked at as other numbers
        out._columns = np.ascontiguousarray(self._columns[: len(self._changing), rows])
        return out

    def varies(self, at: int) -> bool:
        """Whether the word with the byte ``at`` ever changes."""
        return at // 4 in self._place

    def first(self, leaf: np.dtype[Any], at: int) -> Any:
        """The number at byte ``at`` of the first sample."""
        return self._row.view(np.uint8)[at : at + leaf.itemsize].view(leaf)[0]

    def column(self, leaf: np.dtype[Any], at: int) -> Any:
        """The number at byte ``at`` of each sample, shape (n,), or () if it never changes."""
        place = self._place.get(at // 4)
        if place is None:
            return self.first(leaf, at)
        return self._columns[place].view(leaf)[at % 4 // leaf.itemsize :: 4 // leaf.itemsize]


def _aligned(table: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Rows of bytes as rows of words, the last one filled up."""
    n, size = table.shape
    if size % 4:
        padded = np.zeros((n, size + -size % 4), dtype=np.uint8)
        padded[:, :size] = table
        table = padded
    return table.view(np.uint32)


class _Group(NamedTuple):
    """Samples of one shape.

    :param rows: which these are.
    :param counts: lengths of their sequences.
    :param dtype: structured type of one.
    """

    rows: NDArray[np.intp] | slice
    counts: tuple[int, ...]
    dtype: np.dtype[Any]
    words: _Words

    def places(self, steps: _Steps) -> tuple[np.dtype[Any], list[int]]:
        """Type, and first byte of each number, of what a path names; none that it lacks."""
        return _places(self.dtype, 0, steps)


def _places(here: np.dtype[Any], start: int, steps: _Steps) -> tuple[np.dtype[Any], list[int]]:
    if not steps:
        return here, [start]
    (member, index), *rest = steps
    names = [member.name]
    if member.is_structs:
        names = member.places()[slice(None) if index is None else slice(index, index + 1)]
    leaf, places = here, []
    assert here.fields is not None
    for name in names:
        kind, offset = here.fields[name][:2]
        starts = [start + offset]
        if kind.subdtype is not None:
            kind, (length, *_) = kind.subdtype
            indices = range(length) if index is None else range(index, min(index + 1, length))
            starts = [starts[0] + i * kind.itemsize for i in indices]
        for at in starts:
            leaf, more = _places(kind, at, tuple(rest))
            places += more
    return leaf, places


def _steps(kind: Struct, path: str) -> _Steps:
    """Parse and check a path: each member with its index, if any."""
    steps: list[tuple[Field, int | None]] = []
    here: Struct | Primitive = kind
    wide = 0
    for text in path.split("."):
        match = _STEP.fullmatch(text)
        fields = {f.name: f for f in here.fields} if isinstance(here, Struct) else {}
        if match is None or match["name"] not in fields:
            raise UsageError(
                f"{kind.name} has no member {path!r}",
                hint=f"at {text!r}: {', '.join(fields) or 'a number has no members'}",
            )
        member = fields[match["name"]]
        many = member.sequence or member.array is not None
        index = int(match["index"]) if match["index"] else None
        if match["index"] is not None and not many:
            raise UsageError(f"{kind.name}: {match['name']} in {path!r} is not a list")
        if member.array is not None and index is not None and index >= member.array:
            raise UsageError(f"{path!r}: {member.name} has {member.array} elements")
        wide += many and index is None
        steps.append((member, index))
        here = member.type
    if isinstance(here, Struct):
        raise UsageError(
            f"{path!r} is a {here.name}, not a number",
            hint=f"its members: {', '.join(f.name for f in here.fields)}",
        )
    if wide > 1:
        raise UsageError(f"{path!r} has two open dimensions; give one an index")
    return tuple(steps)


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


def _count_words(kind: Struct, counts: tuple[int, ...]) -> list[int]:
    """Which words of a sample with these sequence lengths hold them."""
    out: list[int] = []
    remaining = list(counts)
    at = 0
    for member in kind.fields:
        if member.sequence:
            assert isinstance(member.type, Struct)
            at += -at % 4
            out.append(at // 4 + 1)
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
        if member.is_structs:
            # a member for each: the first may lie otherwise than the rest
            assert isinstance(member.type, Struct)
            for name in member.places():
                names.append(name)
                formats.append(_element(member.type, at, order))
                offsets.append(at + 4)
                at = member.type.end(at)
            continue
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
