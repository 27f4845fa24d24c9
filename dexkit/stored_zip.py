"""Write and read zip archives of one form: members stored as they are, one after the other.

The form (APPNOTE.TXT of PKWARE, 4.3) leaves no choice: no compression, no encryption, no extra
fields, no comments, no bytes between or around the members, all times 1980-01-01, mode 0644. The
same members give the same bytes, every zip tool can unpack them, and there is nothing to hide a
second content in: what reads differently here and in another tool is refused, and a size in a
header is never more than the file has.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from dexkit.errors import ArchiveError
from dexkit.escaping import one_line

__all__ = [
    "LARGEST_MEMBER",
    "MOST_MEMBERS",
    "Content",
    "Member",
    "is_safe_name",
    "member_pieces",
    "pack",
    "read_directory",
]

LARGEST_MEMBER = (1 << 32) - 1
"""Bytes of a member, and of all of them together: what 32-bit fields can hold."""
MOST_MEMBERS = 16
_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._+=@,() -]{0,98}[A-Za-z0-9_)])?")
_LOCAL = struct.Struct("<4s5H3L2H")
_CENTRAL = struct.Struct("<4s6H3L5H2L")
_END = struct.Struct("<4s4H2LH")
_NEEDED = 10  # version 1.0: stored members
_MADE_BY = 3 << 8 | 20  # Unix, version 2.0
_DATE = 1 << 5 | 1  # 1 January 1980, the first day that the format knows
_MODE = 0o100644 << 16
_PIECE = 1 << 20  # bytes
_FORM_HINT = "verify the archive as 'dexkit sign' wrote it; packing it again makes it another one"


@dataclass(frozen=True)
class Member:
    """A member of an archive.

    :param offset: of its first byte in the archive.
    """

    name: str
    size: int
    crc: int
    offset: int


@dataclass(frozen=True)
class Content:
    """A member that is to be written.

    :param crc: CRC-32 of what ``pieces`` gives, and ``size`` its length in bytes.
    :param pieces: called once, when the member's turn has come.
    """

    name: str
    size: int
    crc: int
    pieces: Callable[[], Iterable[bytes]]


def is_safe_name(name: str) -> bool:
    """Whether a member may have that name: at most 100 ASCII characters, no folder."""
    return _NAME.fullmatch(name) is not None


def _local(name: bytes, size: int, crc: int) -> bytes:
    head = (b"PK\3\4", _NEEDED, 0, 0, 0, _DATE, crc, size, size, len(name), 0)
    return _LOCAL.pack(*head) + name


def _central(name: bytes, size: int, crc: int, offset: int) -> bytes:
    head = (b"PK\1\2", _MADE_BY, _NEEDED, 0, 0, 0, _DATE, crc, size, size, len(name))
    return _CENTRAL.pack(*head, 0, 0, 0, 0, _MODE, offset) + name


def _end(count: int, size: int, offset: int) -> bytes:
    return _END.pack(b"PK\5\6", 0, 0, count, count, size, offset, 0)


def pack(contents: Sequence[Content]) -> Iterator[bytes]:
    """The bytes of an archive, in pieces.

    :raises ArchiveError: a name is not safe or occurs twice, they are too many, or too large.
    """
    names = [content.name for content in contents]
    if len({name.casefold() for name in names}) < len(names) or len(names) > MOST_MEMBERS:
        raise ArchiveError("an archive cannot have two members of one name, or so many")
    directory, offset = [], 0
    for content in contents:
        if not is_safe_name(content.name):
            raise ArchiveError(f"{one_line(content.name, 120)!r} cannot be a name in an archive")
        name = content.name.encode("ascii")
        directory.append(_central(name, content.size, content.crc, offset))
        offset += _LOCAL.size + len(name) + content.size
        if offset > LARGEST_MEMBER - 4096:  # which leaves room for the directory
            raise ArchiveError("more than 4 GB cannot be put into an archive")
    for content in contents:
        yield _local(content.name.encode("ascii"), content.size, content.crc)
        yield from content.pieces()
    listing = b"".join(directory)
    yield listing + _end(len(directory), len(listing), offset)


def read_directory(file: BinaryIO, origin: object) -> list[Member]:
    """The members of an archive, in their order; reads its headers only.

    :param file: an ordinary file, opened for reading bytes.
    :param origin: what to call it.
    :raises ArchiveError: it has not exactly the form that :func:`pack` writes.
    """
    size = file.seek(0, 2)
    end = _at(file, max(0, size - _END.size), _END.size)
    if len(end) < _END.size or end[:4] != b"PK\5\6":
        if _at(file, 0, 4) == b"PK\3\4":
            raise ArchiveError(f"{origin} is cut short, or has data after its end")
        raise ArchiveError(
            f"{origin} is not a zip archive", hint="'dexkit sign' writes what this can verify"
        )
    *_, count, length, start, comment = _END.unpack(end)
    if count > MOST_MEMBERS:
        raise ArchiveError(f"{origin} has {count} members; {MOST_MEMBERS} are the most")
    longest = MOST_MEMBERS * (_CENTRAL.size + 512)
    if comment or length > longest or start + length + _END.size != size:
        raise ArchiveError(
            f"{origin}: the directory is not where its end says: cut short, or changed",
            hint=_FORM_HINT,
        )
    listing = _at(file, start, length)
    members: list[Member] = []
    place = at = 0
    for _ in range(count):
        if len(listing) - place < _CENTRAL.size:
            raise ArchiveError(f"{origin}: its directory ends too early", hint=_FORM_HINT)
        fields = _CENTRAL.unpack_from(listing, place)
        flags, method, crc, packed, plain, named = (fields[i] for i in (3, 4, 7, 8, 9, 10))
        raw = listing[place + _CENTRAL.size : place + _CENTRAL.size + named]
        name = _safe(raw, origin)
        if any(name.casefold() == m.name.casefold() for m in members):
            raise ArchiveError(f"{origin} has two members of the name {name}")
        if method or packed != plain:
            raise ArchiveError(f"{origin}: {name} is compressed", hint=_FORM_HINT)
        if flags & 1:
            raise ArchiveError(f"{origin}: {name} is encrypted", hint=_FORM_HINT)
        entry = _central(raw, plain, crc, at)
        header = _local(raw, plain, crc)
        if listing[place : place + len(entry)] != entry or _at(file, at, len(header)) != header:
            raise ArchiveError(
                f"{origin}: the headers of {name} are not as 'dexkit sign' writes them",
                hint=_FORM_HINT,
            )
        members.append(Member(name, plain, crc, at + len(header)))
        place += len(entry)
        at += len(header) + plain
        if at > start:
            raise ArchiveError(f"{origin}: {name} is longer than the archive", hint=_FORM_HINT)
    if at != start or _end(count, place, at) != end or place != length:
        raise ArchiveError(f"{origin} holds bytes that belong to no member", hint=_FORM_HINT)
    return members


def _at(file: BinaryIO, offset: int, length: int) -> bytes:
    file.seek(offset)
    return file.read(length)


def _safe(raw: bytes, origin: object) -> str:
    try:
        name = raw.decode("utf-8")
    except UnicodeDecodeError:
        raise ArchiveError(f"{origin} has a member whose name is not UTF-8 text") from None
    if not is_safe_name(name):
        raise ArchiveError(
            f"{origin} has a member of the unsafe name {one_line(name, 80)!r}",
            hint="names are letters, digits and ._+=@,()- without folders",
        )
    return name


def member_pieces(file: BinaryIO, member: Member) -> Iterator[bytes]:
    """The content of a member, in pieces of at most 1 MiB.

    :raises ArchiveError: the file has become shorter.
    """
    left, place = member.size, member.offset
    while left:
        piece = _at(file, place, min(left, _PIECE))
        if not piece:
            raise ArchiveError(f"{member.name} ends too early: the archive became shorter")
        yield piece
        left -= len(piece)
        place += len(piece)
