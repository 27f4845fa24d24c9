"""Parse the ``.idl`` files: structs, members, and the offset of each member in plain CDR.

The generator, the schema texts, the error messages, the bulk decoder and the CycloneDDS types
are all made from :data:`STRUCTS`, so a layout is written down once, in ``idl/*.idl``.

The subset of IDL that is read: nested modules, ``@final`` structs of numeric members,
one-dimensional arrays of them, members that are structs, unbounded sequences of structs, and (in
structs that no other contains) one-dimensional arrays of structs, strings, sequences of bytes, and
bounded sequences of numbers. Anything else is refused when it is read, not when it is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from dexkit.errors import UsageError

__all__ = [
    "ALL",
    "MAX_BYTES",
    "MAX_ELEMENTS",
    "PRIMITIVES",
    "SERVICES",
    "STRUCTS",
    "Field",
    "IdlError",
    "Primitive",
    "Struct",
    "load",
    "max_size",
    "parse",
]

MAX_ELEMENTS = 1024
"""Longest sequence that is encoded or decoded. The largest known has 35 elements
(docs/sources/unitree-dex.md#a1); the bound is only there so that a hostile sample cannot ask for
more than a fixed amount of work."""
MAX_BYTES = 1 << 16
"""Longest string or sequence of bytes that is encoded or decoded, for the same reason."""
SERVICES = "unitree_api"
"""The package of requests and responses. They hold text, so they have no columns, and recordings
do not decode them."""


class IdlError(UsageError):
    """An IDL text that this subset does not cover."""


@dataclass(frozen=True)
class Primitive:
    """A number type: its size and its name in each of the languages that describe it.

    :param code: format character of :mod:`struct`.
    :param dtype: numpy type without byte order.
    """

    idl: str
    code: str
    size: int
    ros: str
    classic: str
    dtype: str
    python: str


PRIMITIVES: dict[str, Primitive] = {
    p.idl: p
    for p in (
        Primitive("int8", "b", 1, "int8", "int8", "i1", "int"),
        Primitive("uint8", "B", 1, "uint8", "octet", "u1", "int"),
        Primitive("int16", "h", 2, "int16", "short", "i2", "int"),
        Primitive("uint16", "H", 2, "uint16", "unsigned short", "u2", "int"),
        Primitive("int32", "i", 4, "int32", "long", "i4", "int"),
        Primitive("uint32", "I", 4, "uint32", "unsigned long", "u4", "int"),
        Primitive("float", "f", 4, "float32", "float", "f4", "float"),
        Primitive("int64", "q", 8, "int64", "long long", "i8", "int"),
        Primitive("boolean", "?", 1, "bool", "boolean", "?", "bool"),
    )
}
_CHARACTER = Primitive("string", "s", 1, "string", "string", "S1", "str")
"""An element of a string, which is a sequence of these with a zero at its end."""


@dataclass(frozen=True)
class Field:
    """One member of a struct.

    :param type: a number type or a struct.
    :param array: length of a fixed array, or None.
    :param sequence: whether it is a sequence.
    :param bound: most elements of a sequence of numbers; None for other members.
    """

    name: str
    type: Primitive | Struct
    array: int | None = None
    sequence: bool = False
    doc: str = ""
    bound: int | None = None

    @property
    def is_structs(self) -> bool:
        """Whether it is a fixed array of structs."""
        return self.array is not None and isinstance(self.type, Struct)

    @property
    def is_text(self) -> bool:
        """Whether it is a string."""
        return self.type is _CHARACTER

    @property
    def is_bytes(self) -> bool:
        """Whether it is a string or an unbounded sequence of bytes."""
        return self.sequence and isinstance(self.type, Primitive) and self.bound is None

    @property
    def is_numbers(self) -> bool:
        """Whether it is a bounded sequence of numbers."""
        return self.bound is not None

    @property
    def element_size(self) -> int:
        """Bytes from one element of a sequence to the next."""
        return self.type.size if isinstance(self.type, Primitive) else self.type.end(0)

    @property
    def most(self) -> int:
        """The longest sequence of structs or numbers that is encoded or decoded."""
        return MAX_ELEMENTS if self.bound is None else self.bound

    def places(self) -> list[str]:
        """The names of its values in a path: ``q``, or ``motor_cmd[0]`` to ``motor_cmd[19]``."""
        if not self.is_structs:
            return [self.name]
        return [f"{self.name}[{i}]" for i in range(self.array or 0)]


@dataclass(frozen=True)
class Struct:
    """One message type.

    :param scope: the enclosing modules, outermost first.
    """

    scope: tuple[str, ...]
    name: str
    fields: tuple[Field, ...]
    doc: str = ""

    @property
    def dds_name(self) -> str:
        """Name on the wire: ``unitree_go::msg::dds_::MotorCmd_``."""
        return "::".join((*self.scope, self.name))

    @property
    def ros_name(self) -> str:
        """Name of the ROS 2 type whose DDS type this is: ``unitree_go/msg/MotorCmd``.

        A type outside the modules of ROS 2 is no DDS type of a ROS 2 type; recordings name it in
        the same form: ``inspire/msg/inspire_hand_ctrl``.
        """
        return f"{self.scope[0]}/msg/{self.name.removesuffix('_')}"

    @property
    def is_fixed(self) -> bool:
        """Whether every sample has the same length."""
        return not any(
            f.sequence or (isinstance(f.type, Struct) and not f.type.is_fixed) for f in self.fields
        )

    def end(self, offset: int) -> int:
        """The end of a fixed struct that starts at ``offset``, in bytes of plain CDR."""
        for leaf in self.leaves():
            offset = -(-offset // leaf.type.size) * leaf.type.size + leaf.count * leaf.type.size
        return offset

    def leaves(self) -> Iterator[Leaf]:
        """The numbers of a fixed struct in wire order, nested structs taken apart."""
        for member in self.fields:
            assert not member.sequence
            if isinstance(member.type, Struct):
                for name in member.places():
                    for leaf in member.type.leaves():
                        yield Leaf((name, *leaf.path), leaf.type, leaf.array)
            else:
                yield Leaf((member.name,), member.type, member.array)

    def depends(self) -> list[Struct]:
        """The structs that this one contains, each once, inner ones first."""
        found: list[Struct] = []
        for member in self.fields:
            if isinstance(member.type, Struct):
                found += [s for s in (*member.type.depends(), member.type) if s not in found]
        return found


@dataclass(frozen=True)
class Leaf:
    """A number, or an array of numbers, inside a fixed struct."""

    path: tuple[str, ...]
    type: Primitive
    array: int | None

    @property
    def count(self) -> int:
        """The count of its numbers."""
        return 1 if self.array is None else self.array


def max_size(struct: Struct) -> int:
    """Bytes of the longest sample, encapsulation header included."""
    size = 4
    for member in struct.fields:
        if member.is_bytes:
            size += -size % 4 + 4 + MAX_BYTES
        elif member.sequence:
            size += -size % 4 + 4 + member.most * member.element_size
        else:
            size = Struct((), "", (member,)).end(size)
    return size + (-size % 4)


_TOKEN = re.compile(r"\s+|(?P<doc>//[^\n]*)|(?P<token>[A-Za-z_]\w*|\d+|[@{}<>\[\];(),]|::)")


def _tokens(text: str) -> Iterator[tuple[str, str, int]]:
    """(kind, text, line) of each token; kind is ``doc`` or ``token``."""
    at, line = 0, 1
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise IdlError(f"IDL line {line}: cannot read {text[at : at + 12]!r}")
        if match.lastgroup is not None:
            yield match.lastgroup, match.group(), line
        line += match.group().count("\n")
        at = match.end()


class _Parser:
    def __init__(self, text: str) -> None:
        # comments are kept aside: by the line that they stand on
        self._docs: dict[int, str] = {}
        self._tokens: list[tuple[str, int]] = []
        for kind, token, line in _tokens(text):
            if kind == "doc":
                self._docs[line] = token.removeprefix("//").strip()
            else:
                self._tokens.append((token, line))
        self._at = 0
        self.structs: dict[str, Struct] = {}

    def _peek(self) -> str:
        return self._tokens[self._at][0] if self._at < len(self._tokens) else ""

    def _line(self) -> int:
        return self._tokens[min(self._at, len(self._tokens) - 1)][1]

    def _next(self, expected: str | None = None) -> str:
        token = self._peek()
        if not token or (expected is not None and token != expected):
            raise IdlError(
                f"IDL line {self._line()}: expected {expected or 'more'}, found {token or 'end'!r}"
            )
        self._at += 1
        return token

    def definitions(self, scope: tuple[str, ...]) -> None:
        while self._peek() not in ("", "}"):
            if self._peek() == "module":
                self._next()
                name = self._next()
                self._next("{")
                self.definitions((*scope, name))
                self._next("}")
                self._next(";")
            else:
                self._struct(scope)

    def _struct(self, scope: tuple[str, ...]) -> None:
        if not scope:
            raise IdlError(f"IDL line {self._line()}: a struct outside a module")
        doc = self._docs.get(self._line() - 1, "")
        # an unannotated struct would be appendable to some DDS versions and final to others
        self._next("@")
        self._next("final")
        self._next("struct")
        name = self._next()
        self._next("{")
        fields = []
        while self._peek() != "}":
            fields.append(self._member(scope))
        self._next("}")
        self._next(";")
        if not fields:
            raise IdlError(f"IDL line {self._line()}: {name} has no members")
        struct = Struct(scope, name, tuple(fields), doc)
        self._check(struct)
        self.structs[struct.dds_name] = struct

    def _member(self, scope: tuple[str, ...]) -> Field:
        line = self._line()
        sequence = self._peek() == "sequence"
        if sequence:
            self._next()
            self._next("<")
        kind = self._type(scope)
        bound = None
        if sequence:
            if self._peek() == ",":
                self._next()
                bound = self._length(self._next())
            self._next(">")
        text = kind is _CHARACTER
        name = self._next()
        array = None
        if self._peek() == "[":
            self._next()
            array = self._length(self._next())
            self._next("]")
        self._next(";")
        numbers = kind in PRIMITIVES.values() and kind is not PRIMITIVES["boolean"]
        plain = isinstance(kind, Struct) or kind is PRIMITIVES["uint8"]
        if (
            (sequence and not (numbers if bound else plain))
            or ((sequence or text) and array is not None)
            or (bound is not None and not 0 < bound <= MAX_ELEMENTS)
        ):
            raise IdlError(
                f"IDL line {line}: only sequences of structs or bytes, and sequences of at most "
                f"{MAX_ELEMENTS} numbers, are supported"
            )
        return Field(name, kind, array, sequence or text, self._docs.get(line, ""), bound)

    def _length(self, text: str) -> int:
        if not text.isdecimal() or len(text) > 9:
            raise IdlError(f"IDL line {self._line()}: {text!r} is no length")
        return int(text)

    def _type(self, scope: tuple[str, ...]) -> Primitive | Struct:
        token = self._next()
        if token in PRIMITIVES:
            return PRIMITIVES[token]
        if token == "string":
            return _CHARACTER
        name = "::".join((*scope, token))
        if name not in self.structs:
            raise IdlError(f"IDL line {self._line()}: unknown type {token!r}")
        return self.structs[name]

    def _check(self, struct: Struct) -> None:
        at, varied = 0, False
        numbers = any(member.is_numbers for member in struct.fields)
        for member in struct.fields:
            where = f"{struct.name}.{member.name}"
            if numbers:
                # each begins where the one before it happens to end
                if isinstance(member.type, Struct) or member.is_bytes or member.type.size > 4:
                    raise IdlError(f"{where}: only numbers of 4 bytes beside a sequence of numbers")
                continue
            inner = member.type
            if varied and not member.is_bytes:
                raise IdlError(f"{where}: a member after a string or bytes")
            varied = varied or member.is_bytes
            if member.is_bytes and any(f.sequence and not f.is_bytes for f in struct.fields):
                raise IdlError(f"{where}: bytes beside a sequence of structs")
            if isinstance(inner, Struct):
                if not inner.is_fixed:
                    raise IdlError(f"{where}: nested sequences")
                if any(f.is_structs for f in inner.fields):
                    raise IdlError(f"{where}: nested arrays of structs")
                # Elements of a sequence start right after a uint32. When each also ends on a
                # multiple of 4, all have one layout and can be packed as a block. So have those
                # of an array, except that the first may start anywhere.
                many = member.sequence or member.is_structs
                if many and any(leaf.type.size > 4 for leaf in inner.leaves()):
                    raise IdlError(f"{where}: elements with numbers of 8 bytes")
                if many and (inner.end(0) % 4 or (member.is_structs and inner.end(at) % 4)):
                    raise IdlError(f"{where}: elements of uneven layout")
            at = 0 if member.sequence else Struct((), "", (member,)).end(at)


def parse(text: str) -> dict[str, Struct]:
    """Read IDL; returns the structs by DDS name, in the order of the text.

    :raises IdlError: the text is wrong or outside the supported subset.
    """
    parser = _Parser(text)
    parser.definitions(())
    if parser._peek():
        raise IdlError(f"IDL line {parser._line()}: unexpected {parser._peek()!r}")
    return parser.structs


@cache
def load() -> dict[str, Struct]:
    """All structs of the package's ``.idl`` files by DDS name."""
    structs: dict[str, Struct] = {}
    for file in sorted((Path(__file__).parent / "idl").glob("*.idl")):
        structs.update(parse(file.read_text(encoding="ascii")))
    return structs


ALL = load()
"""Every struct of ``idl/*.idl`` by DDS name."""
STRUCTS = {name: kind for name, kind in ALL.items() if kind.scope[0] != SERVICES}
"""Those of hands and robots, which consist of numbers: all but the requests and responses."""
