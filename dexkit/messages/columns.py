"""Decode many samples of one type at once, as numpy columns.

Samples of equal shape (byte order, sequence lengths) are looked at as one structured array, so a
recording is read at memory speed instead of object by object.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from dexkit.errors import UsageError, WireError
from dexkit.messages.codec import check_count, check_end, is_big, truncated
from dexkit.messages.layout import Field, Primitive, Struct, max_size
from dexkit.messages.packed import Words, aligned, pieces, rows_at

__all__ = ["Columns", "RowReader", "encode_columns"]

_STEP = re.compile(r"(?P<name>[A-Za-z_]\w*)(?:\[(?P<index>\d*)\])?")
_UINT32 = (struct.Struct("<I"), struct.Struct(">I"))
_Steps: TypeAlias = tuple[tuple[Field, "int | None"], ...]
_Shape: TypeAlias = tuple[bool, tuple[int, ...], int]
"""Whether the numbers are big-endian, lengths of the sequences, bytes."""


class Columns:
    """Columns of ``payloads``, all of one message type.

    :ivar errors: what is wrong with each sample that cannot be decoded, by its index.

    A column has one row per payload. What a sample does not have (it cannot be decoded, or its
    sequence is shorter) is NaN. Paths name members: ``"states[0].q"`` has shape (n,),
    ``"reserve"`` of an array member shape (n, length), ``"motor_state[].q"`` shape
    (n, longest sequence).
    """

    def __init__(self, kind: Struct, payloads: Sequence[bytes] = ()) -> None:
        self._kind = kind
        self._n = 0
        self._limit = max_size(kind)
        self._sequences = [f.name for f in kind.fields if f.sequence]
        self.errors: dict[int, WireError] = {}
        self._bad: dict[str, WireError] = {}
        self._groups: dict[_Shape, _Group] = {}
        self._usual: dict[int, _Group] = {}  # by length of the samples
        self._paths = _known_paths(kind)
        self._extremes: dict[str, tuple[float, float]] = {}
        for piece in pieces(payloads):
            self.append(*piece)

    def append(
        self,
        data: bytes | NDArray[np.uint8],
        starts: NDArray[np.int64],
        sizes: NDArray[np.int64],
    ) -> None:
        """Add the payloads that begin at ``starts`` in ``data``; their bytes are not kept."""
        self._extremes.clear()
        rows = np.arange(self._n, self._n + len(starts))
        self._n += len(starts)
        if len(sizes) and (sizes == sizes[0]).all():
            self._append(aligned(rows_at(data, starts, int(sizes[0]))), rows, int(sizes[0]))
            return
        order = np.argsort(sizes, kind="stable")
        ends = np.flatnonzero(np.diff(sizes[order])) + 1
        for some in np.split(order, ends) if len(order) else ():
            size = int(sizes[some[0]])
            self._append(aligned(rows_at(data, starts[some], size)), rows[some], size)

    def reorder(self, order: NDArray[np.intp]) -> None:
        """Put the samples into another order: the first is to be the one with number order[0]."""
        place = np.empty(self._n, dtype=np.intp)
        place[order] = np.arange(self._n)
        self.errors = {int(place[row]): error for row, error in self.errors.items()}
        for group in self._groups.values():
            group.rows = [place[np.concatenate(group.rows)]]
            group.moved = True

    def _append(self, table: NDArray[np.uint32], rows: NDArray[np.intp], size: int) -> None:
        # Samples of one length nearly always have one shape: parse one of them, compare the
        # others' header and sequence lengths with it in bulk, parse singly those that differ.
        while size not in self._usual and len(rows):
            shape = self._shape_of(table[0], int(rows[0]), size)
            if shape is None:
                table, rows = table[1:], rows[1:]
            else:
                self._usual[size] = self._group(shape, table[0])
        if not len(rows):
            return
        usual = self._usual[size]
        if usual.put_alike(table, rows):
            return
        changes = usual.words.changes(table)
        same = usual.agrees(table, changes)
        if same is None:
            usual.put(table, rows, changes)
            return
        found: dict[_Shape, list[int]] = {}
        for at in np.flatnonzero(~same).tolist():
            shape = self._shape_of(table[at], int(rows[at]), size)
            if shape is not None:
                found.setdefault(shape, []).append(at)
        for group, some in [
            (usual, np.flatnonzero(same)),
            *((self._group(s, table[at[0]]), np.array(at)) for s, at in found.items()),
        ]:
            group.put(table[some], rows[some], group.words.changes(table[some]))

    def _shape_of(self, words: NDArray[np.uint32], row: int, size: int) -> _Shape | None:
        data = words.view(np.uint8)[:size].tobytes()
        try:
            big = is_big(data, self._limit, self._kind.name)
            return big, _counts(self._kind, data, big), size
        except WireError as error:
            # without its traceback, which holds the samples; one error for all that are alike
            known = self._bad.setdefault(str(error), error.with_traceback(None))
            self.errors[row] = known
            return None

    def _group(self, shape: _Shape, first: NDArray[np.uint32]) -> _Group:
        if shape not in self._groups:
            self._groups[shape] = _Group(self._kind, shape, first.copy())
        return self._groups[shape]

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
        for group in self._groups.values():
            out[group.where(self._n)] = group.counts[at]
        return out

    def __getitem__(self, path: str) -> NDArray[np.float64]:
        """The column at ``path``, as float64 (every member's type fits).

        :raises UsageError: the type has no such member.
        """
        shape = self._shape(self._steps(path))
        return self._table([path], shape[0] if shape else 1).reshape(*shape, self._n).T

    def table(self, paths: Sequence[str]) -> NDArray[np.float64]:
        """Several columns of one number each side by side, shape (n, len(paths)).

        :raises UsageError: the type has no such member.
        """
        return self._table(paths, 1).T

    def _table(self, paths: Sequence[str], length: int) -> NDArray[np.float64]:
        out = np.empty((len(paths) * length, self._n))
        whole = sum(len(g.words) for g in self._groups.values()) == self._n
        for i, path in enumerate(paths):
            steps = self._steps(path)
            columns = out[i * length : (i + 1) * length]
            if not whole:
                columns[:] = np.nan
            for group in self._groups.values():
                leaf, places = group.places(steps)
                rows = group.where(self._n)
                columns[len(places) :, rows] = np.nan
                with np.errstate(invalid="ignore"):  # a signalling NaN stays a NaN
                    for column, at in zip(columns, places, strict=False):
                        for part, values in group.words.parts(leaf, at):
                            column[part if isinstance(rows, slice) else rows[part]] = values
        return out

    def extremes(self, path: str) -> tuple[float, float]:
        """The lowest and highest number at ``path``, of all samples that can be decoded.

        NaN if there are none, or if not all have it or if one is not a number.

        :raises UsageError: the type has no such member.
        """
        if path not in self._extremes:
            self._extremes[path] = self._find_extremes(path)
        return self._extremes[path]

    def _find_extremes(self, path: str) -> tuple[float, float]:
        steps = self._steps(path)
        shape = self._shape(steps)
        low, high = [], []
        for group in self._groups.values():
            leaf, places = group.places(steps)
            if len(places) != (shape[0] if shape else 1):
                return np.nan, np.nan
            if len(group.words) and places:
                least, most = group.words.extremes(leaf, places)
                low.append(least)
                high.append(most)
        # numpy's, which pass NaN on
        return (float(np.min(low)), float(np.max(high))) if low else (np.nan, np.nan)

    @property
    def are_zero(self) -> bool:
        """Whether there are samples, and every number in all of them is 0."""
        return bool(self._groups) and all(g.is_zero for g in self._groups.values())

    def constant(self, path: str) -> NDArray[np.float64] | None:
        """The row that every sample has at ``path``, shape (1,) or (1, length); None if they
        differ, or if not all have it.

        :raises UsageError: as for a column.
        """
        steps = self._steps(path)
        group = next(iter(self._groups.values()), None)
        if group is None or len(group.words) != self._n:
            return None
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


class RowReader:
    """Decodes small batches of one type again and again: the same numbers of every sample.

    Where :class:`Columns` is made for whole recordings, this keeps what it has learnt of a shape,
    so that a batch costs little more than its numbers.

    :param paths: of one number each, as :class:`Columns` takes them.
    :raises UsageError: the type has no such member.
    """

    def __init__(self, kind: Struct, paths: Sequence[str]) -> None:
        self._kind = kind
        self._limit = max_size(kind)
        self._paths = [_steps(kind, path) for path in paths]
        self._plans: dict[int, _Plan] = {}

    def read(self, payloads: Sequence[bytes]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The numbers, shape (n, len(paths)), and which samples can be decoded, shape (n,).

        What a sample does not have is NaN.
        """
        out = np.full((len(payloads), len(self._paths)), np.nan)
        good = np.ones(len(payloads), dtype=np.bool_)
        sizes = {len(payload) for payload in payloads}
        for size in sizes:
            rows: NDArray[np.intp] = np.arange(len(payloads))
            some = payloads
            if len(sizes) > 1:
                rows = np.array([i for i, p in enumerate(payloads) if len(p) == size])
                some = [payloads[i] for i in rows.tolist()]
            self._read(some, size, rows, out, good)
        return out, good

    def _read(
        self,
        payloads: Sequence[bytes],
        size: int,
        rows: NDArray[np.intp],
        out: NDArray[np.float64],
        good: NDArray[np.bool_],
    ) -> None:
        raw = np.frombuffer(b"".join(payloads), np.uint8).reshape(len(payloads), size)
        waiting: NDArray[np.intp] = np.arange(len(payloads))
        while len(waiting):
            plan = self._plans.get(size)
            if plan is not None and len(same := waiting[plan.agrees(raw[waiting])]):
                plan.read(raw[same], rows[same], out)
                waiting = np.setdiff1d(waiting, same, assume_unique=True)
                continue
            first = int(waiting[0])
            try:
                data = payloads[first]
                big = is_big(data, self._limit, self._kind.name)
                self._plans[size] = _Plan(self._kind, self._paths, data, big)
            except WireError:
                good[rows[first]] = False
                waiting = waiting[1:]


class _Plan:
    """Offsets of the numbers in samples of one shape."""

    def __init__(self, kind: Struct, paths: Sequence[_Steps], data: bytes, big: bool) -> None:
        counts = _counts(kind, data, big)
        dtype = _dtype(kind, counts, ">" if big else "<", len(data))
        words = _count_words(kind, counts)
        # the header's first two bytes, and the lengths of the sequences
        self._fixed = np.array([0, 1, *(4 * w + i for w in words for i in range(4))])
        self._example = np.frombuffer(data, np.uint8)[self._fixed]
        by_type: dict[np.dtype[Any], tuple[list[int], list[int]]] = {}
        for column, steps in enumerate(paths):
            leaf, places = _places(dtype, 0, steps)
            if len(places) == 1:
                columns, starts = by_type.setdefault(leaf, ([], []))
                columns.append(column)
                starts.append(places[0])
        self._gathers = [
            (leaf, columns, (np.array(starts)[:, None] + np.arange(leaf.itemsize)).ravel())
            for leaf, (columns, starts) in by_type.items()
        ]

    def agrees(self, raw: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which samples are of this shape."""
        return np.asarray((raw[:, self._fixed] == self._example).all(axis=1))

    def read(
        self, raw: NDArray[np.uint8], rows: NDArray[np.intp], out: NDArray[np.float64]
    ) -> None:
        """Put the numbers into rows of a table."""
        for leaf, columns, octets in self._gathers:
            values = np.ascontiguousarray(raw[:, octets]).view(leaf)
            out[rows[:, None], columns] = values


def encode_columns(
    kind: Struct,
    example: bytes,
    values: Sequence[tuple[Sequence[str | int], NDArray[Any]]],
    n: int,
) -> list[bytes]:
    """Encode many samples of one shape at once: the reverse of :class:`Columns`.

    :param example: a sample of that shape, little endian; it gives what ``values`` does not name.
    :param values: for a number in the message, by names of members and places in lists, its value
        in each sample, shape (n,), in its own type.
    :param n: how many samples.
    """
    dtype = _dtype(kind, _counts(kind, example, False), "<", len(example))
    rows: NDArray[np.void] = np.zeros(n, dtype)
    raw = rows.view(np.uint8).reshape(n, len(example))
    raw[:] = np.frombuffer(example, np.uint8)
    for steps, column in values:
        (member, *rest) = steps
        here: NDArray[Any]
        if str(member) in (dtype.names or ()):
            here = rows[str(member)]
        else:  # structs of a fixed array are members of their own
            field = next(f for f in kind.fields if f.name == member)
            here = rows[field.places()[int(rest.pop(0))]]
        for step in rest[:-1]:
            here = here[step] if isinstance(step, str) else here[:, step]
        if not rest:
            rows[str(member)] = column
        elif isinstance(rest[-1], str):
            here[rest[-1]] = column
        else:
            here[:, rest[-1]] = column
    return [row.tobytes() for row in raw]


class _Layout:
    """Offsets of the members in samples of one shape."""

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype = dtype
        self._known: dict[int, tuple[_Steps, np.dtype[Any], list[int]]] = {}

    def places(self, steps: _Steps) -> tuple[np.dtype[Any], list[int]]:
        """Type and first byte of each number."""
        if id(steps) not in self._known:
            self._known[id(steps)] = (steps, *_places(self._dtype, 0, steps))
        _, leaf, places = self._known[id(steps)]
        return leaf, places


_LAYOUTS: dict[tuple[int, tuple[int, ...], str, int], tuple[Struct, _Layout]] = {}
_MOST_LAYOUTS = 64
"""Layouts that are kept: of every type that dexkit knows, in the lengths that are usual."""


def _layout(kind: Struct, counts: tuple[int, ...], order: str, size: int) -> _Layout:
    """The layout of samples with these sequence lengths."""
    key = (id(kind), counts, order, size)
    if key not in _LAYOUTS:
        while len(_LAYOUTS) >= _MOST_LAYOUTS:
            _LAYOUTS.pop(next(iter(_LAYOUTS)))
        _LAYOUTS[key] = kind, _Layout(_dtype(kind, counts, order, size))
    return _LAYOUTS[key][1]


class _Group:
    """Samples of one shape.

    :ivar counts: lengths of their sequences.
    :ivar rows: which of all samples these are, piece by piece.
    :ivar moved: whether these are no longer in the order of :attr:`words`.
    """

    def __init__(self, kind: Struct, shape: _Shape, first: NDArray[np.uint32]) -> None:
        big, self.counts, size = shape
        self.rows: list[NDArray[np.intp]] = []
        self.moved = False
        self.words = Words(first)
        self._layout = _layout(kind, self.counts, ">" if big else "<", size)
        # the header's first two bytes define the byte order, the others are free
        self._fixed = np.array([0, *_count_words(kind, self.counts)])
        self._mask = np.full(len(self._fixed), 0xFFFFFFFF, dtype=np.uint32)
        self._mask[:1].view(np.uint8)[2:] = 0

    @property
    def is_zero(self) -> bool:
        """Whether every number in all samples is 0."""
        return self.words.are_zero(self._fixed)

    def agrees(
        self, table: NDArray[np.uint32], changes: NDArray[np.uint32]
    ) -> NDArray[np.bool_] | None:
        """Which samples are of this shape; None for all.

        :param changes: the bits in which any of them differs from the first of this shape.
        """
        if not (changes[self._fixed] & self._mask).any():
            return None
        return self.words.same(table, self._fixed, self._mask)

    def put_alike(self, table: NDArray[np.uint32], rows: NDArray[np.intp]) -> bool:
        """Add samples if nothing changes in them that has not changed before.

        :returns: whether it has; if not, none is added.
        """
        if any(self.words.varies(4 * word) for word in self._fixed.tolist()):
            return False
        if not self.words.put_alike(table):
            return False
        self.rows.append(rows)
        return True

    def put(
        self, table: NDArray[np.uint32], rows: NDArray[np.intp], changes: NDArray[np.uint32]
    ) -> None:
        """Add samples that agree."""
        self.words.put(table, changes)
        self.rows.append(rows)

    def where(self, n: int) -> NDArray[np.intp] | slice:
        """Which of all ``n`` samples these are."""
        if len(self.words) == n and not self.moved:
            return slice(None)
        self.rows = [np.concatenate(self.rows)]
        return self.rows[0]

    def places(self, steps: _Steps) -> tuple[np.dtype[Any], list[int]]:
        """Type and first byte of each number that a path names, without those that the payload
        lacks.
        """
        return self._layout.places(steps)


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


_PATHS: dict[int, tuple[Struct, dict[str, _Steps]]] = {}


def _known_paths(kind: Struct) -> dict[str, _Steps]:
    """The paths of a type that have been parsed; by identity, for comparing types takes longer."""
    return _PATHS.setdefault(id(kind), (kind, {}))[1]


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
            at += -at % 4
            if len(data) < at + 8:
                name = (
                    f"{kind.name}.{member.name}"
                    if isinstance(member.type, Primitive)
                    else kind.name
                )
                raise truncated(name, at + 8, len(data))
            count = _UINT32[big].unpack_from(data, at + 4)[0]
            at += 4 + count * member.element_size
            check_count(f"{kind.name}.{member.name}", count, at + 4, len(data), member.most)
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
            at += -at % 4
            out.append(at // 4 + 1)
            at += 4 + remaining.pop(0) * member.element_size
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
            at += -at % 4 + 4
            count = remaining.pop(0)
            element = (
                _element(member.type, 0, order)
                if isinstance(member.type, Struct)
                else np.dtype(order + member.type.dtype)
            )
            formats.append(np.dtype((element, (count,))))
            offsets.append(at + 4)
            at += count * member.element_size
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
