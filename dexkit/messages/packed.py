"""Payloads in shared buffers, and their words that change between samples; used by columns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

__all__ = ["Packed", "Piece", "Words", "aligned", "pieces", "rows_at"]

_BLOCK = 512
"""Payloads that are looked at at once: few enough to stay in the processor's cache."""
_SEGMENT = 1 << 16
"""Most samples whose changing words are kept in one table."""
_FIRST = 1 << 18
"""Words of the first samples that get a table; those that are not filled cost no memory."""
_COMPARED = 1 << 14
"""Most words of samples that are compared with the first one at once."""
_FOLDED = 16
"""Rows of changing words that are reduced as one."""

_SEALED = _SEGMENT // 2
"""Fewest samples of a table that is compressed when no more are added: of recordings of minutes."""

Piece: TypeAlias = "tuple[bytes | NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]"
"""A buffer, where some payloads begin in it, and how long each of them is."""


def rows_at(
    data: bytes | NDArray[np.uint8], starts: NDArray[np.int64], size: int
) -> NDArray[np.uint8]:
    """``size`` bytes from each start, shape (n, size)."""
    if not size or not len(starts):
        return np.empty((len(starts), size), dtype=np.uint8)
    # one item for each place where it may begin, for whole items are copied quickly
    every: NDArray[np.void] = np.ndarray((len(data) - size + 1,), f"V{size}", data, strides=(1,))
    return every[starts].view(np.uint8).reshape(len(starts), size)


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

    def pieces(self) -> Iterator[Piece]:
        """All payloads in their order, in pieces that lie in one buffer."""
        buffer = self._bytes
        for at in range(0, len(self), _BLOCK):
            some = slice(at, at + _BLOCK)
            yield buffer, self._starts[some], self._sizes[some]


def pieces(payloads: Sequence[bytes]) -> Iterator[Piece]:
    """Payloads in pieces of a few hundred that lie in one buffer."""
    if isinstance(payloads, Packed):
        yield from payloads.pieces()
        return
    for at in range(0, len(payloads), _BLOCK):
        some = payloads[at : at + _BLOCK]
        sizes = np.array([len(p) for p in some], dtype=np.int64)
        yield b"".join(some), np.cumsum(sizes) - sizes, sizes


class _Sealed:
    """A finished table of changing words, each column compressed by itself: many of them change
    seldom, or by little.
    """

    def __init__(self, table: NDArray[np.uint32]) -> None:
        from zstandard import ZstdCompressor

        self.shape = table.shape
        compressor = ZstdCompressor(level=1)
        # the bytes of equal weight together: those that change little compress well then
        self._columns = [
            compressor.compress(
                np.ascontiguousarray(column).view(np.uint8).reshape(-1, 4).T.tobytes()
            )
            for column in table.T
        ]

    def column(self, at: int) -> NDArray[np.uint32]:
        """One column, shape (n, 1)."""
        from zstandard import ZstdDecompressor

        data = ZstdDecompressor().decompress(self._columns[at])
        planes = np.frombuffer(data, np.uint8).reshape(4, self.shape[0])
        return np.ascontiguousarray(planes.T).view(np.uint32)


class Words:
    """Samples of one length, word by word: the first of them, and columns of what changes.

    Most of a state never changes, and what does is asked for member by member. So a sample is
    read once, when it is in the cache, and only its changing words are kept.

    :param first: the first sample, from :func:`aligned`.
    """

    def __init__(self, first: NDArray[np.uint32]) -> None:
        self._row = first
        self._n = 0
        # changing words in the order in which they began to
        self._changing: NDArray[np.intp] = np.empty(0, dtype=np.intp)
        self._place: dict[int, int] = {}
        # tables of the words that changed until then, a row for each sample: no more is allocated
        # than twice the samples take, beyond a first table, and memory that is not touched costs
        # nothing
        self._tables: list[NDArray[np.uint32]] = []
        # of those, the finished ones of a long recording
        self._sealed: dict[int, _Sealed] = {}
        self._begins: list[int] = []  # the first sample of each table
        # some samples like the first one, their changing words 0, for comparison
        self._constant = b""
        self._limits: dict[np.dtype[Any], tuple[NDArray[Any], NDArray[Any]]] = {}

    def __len__(self) -> int:
        return self._n

    def put_alike(self, piece: NDArray[np.uint32]) -> bool:
        """Add samples in which only words change that have changed before.

        :param piece: is overwritten if they are added.
        :returns: whether they are; if not, none is added.
        """
        kept = self._room(len(piece))
        piece.take(self._changing, axis=1, out=kept, mode="clip")
        # comparing memory takes a tenth of the time that arrays of differences do
        piece[:, self._changing] = 0
        step = max(1, _COMPARED // piece.shape[1])
        if len(self._constant) < min(step, len(piece)) * piece.strides[0]:
            row = self._row.copy()
            row[self._changing] = 0
            self._constant = np.tile(row, min(step, len(piece))).tobytes()
        for at in range(0, len(piece), step):
            if not self._constant.startswith(piece[at : at + step].data):
                piece[:, self._changing] = kept
                return False
        self._add(kept)
        return True

    def _room(self, n: int) -> NDArray[np.uint32]:
        """An array for the changing words of some samples: where :meth:`_add` is to put them, if
        there is room. If they are not added, the next ones overwrite them.
        """
        k = len(self._changing)
        if self._tables and self._tables[-1].shape[1] == k:
            at = self._n - self._begins[-1]
            place = self._tables[-1][at : at + n]
            if len(place) == n:
                return place
        return np.empty((n, k), dtype=np.uint32)

    def changes(self, piece: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Which bits of each word differ from the first sample's, anywhere in ``piece``."""
        return np.asarray(np.bitwise_or.reduce(piece ^ self._row, axis=0))

    def same(
        self, piece: NDArray[np.uint32], words: NDArray[np.intp], mask: NDArray[np.uint32]
    ) -> NDArray[np.bool_]:
        """Which samples in ``piece`` have these words, as far as masked, as the first has them."""
        return np.asarray((((piece[:, words] ^ self._row[words]) & mask) == 0).all(axis=1))

    def put(self, piece: NDArray[np.uint32], changes: NDArray[np.uint32]) -> None:
        """Add samples, and what of them :meth:`changes`."""
        changes[self._changing] = 0
        new = np.flatnonzero(changes)
        if len(new):
            self._place |= {word: at for at, word in enumerate(new.tolist(), len(self._changing))}
            self._changing = np.concatenate([self._changing, new])
            self._constant = b""
        self._add(piece.take(self._changing, axis=1))

    def _add(self, kept: NDArray[np.uint32]) -> None:
        """Add samples' changing words."""
        self._limits.clear()
        if self._tables and self._tables[-1].shape[1] < kept.shape[1]:
            used = self._n - self._begins[-1]
            if 2 * used < len(self._tables[-1]):
                self._tables[-1] = self._tables[-1][:used].copy()
        while len(kept):
            table = self._tables[-1] if self._tables else kept[:0]
            at = self._n - self._begins[-1] if self._begins else 0
            if at == len(table) or table.shape[1] < kept.shape[1]:
                first = _FIRST // len(self._row)
                length = min(max(len(kept), self._n, first), _SEGMENT)
                self._seal()
                table = np.empty((length, kept.shape[1]), dtype=np.uint32)
                self._tables.append(table)
                self._begins.append(self._n)
                at = 0
            some = min(len(kept), len(table) - at)
            if kept.base is not table:  # they are not there yet
                table[at : at + some] = kept[:some]
            self._n += some
            kept = kept[some:]

    def _seal(self) -> None:
        """Compress the last table, to which no more is added, if it has many samples."""
        if not self._tables or (used := self._n - self._begins[-1]) < _SEALED:
            return
        last = len(self._tables) - 1
        self._sealed[last] = _Sealed(self._tables[last][:used])
        self._tables[last] = self._tables[last][:0].copy()

    def varies(self, at: int) -> bool:
        """Whether the word with the byte ``at`` ever changes."""
        return at // 4 in self._place

    def first(self, leaf: np.dtype[Any], at: int) -> Any:
        """The number at byte ``at`` of the first sample."""
        return self._row.view(np.uint8)[at : at + leaf.itemsize].view(leaf)[0]

    def are_zero(self, but: NDArray[np.intp]) -> bool:
        """Whether all words of all samples are 0, apart from these."""
        row = self._row.copy()
        row[but] = 0
        return not len(self._changing) and not row.any()

    def extremes(self, leaf: np.dtype[Any], places: Sequence[int]) -> tuple[float, float]:
        """The lowest and highest of the numbers at some bytes, in all samples; NaN passes on."""
        low, high = [], []
        same = [at for at in places if at // 4 not in self._place]
        if same:
            octets = np.array(same)[:, None] + np.arange(leaf.itemsize)
            values = self._row.view(np.uint8)[octets].view(leaf)
            low.append(float(values.min()))
            high.append(float(values.max()))
        for at in places:
            if at // 4 not in self._place:
                continue
            if leaf.itemsize == 4:
                least, most = self._bounds(leaf)
                low.append(float(least[self._place[at // 4]]))
                high.append(float(most[self._place[at // 4]]))
                continue
            for _, values in self.parts(leaf, at):
                low.append(float(values.min()))
                high.append(float(values.max()))
        return float(np.min(low)), float(np.max(high))

    def _bounds(self, leaf: np.dtype[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """The lowest and highest of each changing word, all of them taken for this type."""
        if leaf not in self._limits:
            # a word that changes only in a later table has the first sample's value until then
            least = self._row[self._changing].view(leaf)
            most = least.copy()
            ends = [*self._begins[1:], self._n]
            for number, (begin, end, table) in enumerate(
                zip(self._begins, ends, self._tables, strict=True)
            ):
                k = table.shape[1]
                if number in self._sealed:
                    for at in range(k):
                        column = self._sealed[number].column(at).view(leaf)
                        np.minimum(least[at], column.min(), out=least[at : at + 1])
                        np.maximum(most[at], column.max(), out=most[at : at + 1])
                    continue
                for rows in _wide(table[: end - begin]):
                    values = rows.view(leaf)
                    for found, of in ((least, np.minimum), (most, np.maximum)):
                        some = of.reduce(of.reduce(values, axis=0).reshape(-1, k), axis=0)
                        of(found[:k], some, out=found[:k])
            self._limits[leaf] = least, most
        return self._limits[leaf]

    def parts(self, leaf: np.dtype[Any], at: int) -> Iterator[tuple[slice, Any]]:
        """The number at byte ``at`` of each sample: arrays, or one number that some all have."""
        place = self._place.get(at // 4)
        if place is None:
            yield slice(0, self._n), self.first(leaf, at)
            return
        ends = [*self._begins[1:], self._n]
        for number, (begin, end, table) in enumerate(
            zip(self._begins, ends, self._tables, strict=True)
        ):
            if place >= table.shape[1]:
                yield slice(begin, end), self.first(leaf, at)  # it changed only later
            else:
                sealed = self._sealed.get(number)
                column = (
                    table[: end - begin, place : place + 1]
                    if sealed is None
                    else sealed.column(place)
                )
                column = column.view(leaf)
                yield slice(begin, end), column[:, at % 4 // leaf.itemsize]


def _wide(table: NDArray[np.uint32]) -> Iterator[NDArray[np.uint32]]:
    """Rows of a table, several as one: long rows are reduced several times as fast."""
    n, k = table.shape
    whole = n // _FOLDED * _FOLDED
    if whole and k:
        yield table[:whole].reshape(-1, _FOLDED * k)
    if whole < n and k:
        yield table[whole:]


def aligned(table: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Rows of bytes as rows of words, the last one filled up."""
    n, size = table.shape
    if size % 4:
        padded = np.zeros((n, size + -size % 4), dtype=np.uint8)
        padded[:, :size] = table
        table = padded
    return table.view(np.uint32)
