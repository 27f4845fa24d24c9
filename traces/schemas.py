"""Parse the schema texts of recordings into one form, to compare layouts.

A recording carries the layout its payloads had when they were written. Layouts have changed
(docs/sources/unitree-dex.md#a3), and plain CDR does not identify them, so a payload of an old
layout decodes to wrong values without an error. Therefore the recorded schema, in whichever of
``ros2msg``, ``ros2idl`` and ``omgidl`` it is, is compared with dexkit's own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from dexkit.errors import TraceUnsupported
from dexkit.traces.names import dds_type

__all__ = ["ENCODINGS", "Array", "Field", "Node", "Sequence", "Struct", "differences", "parse"]

#: Schema encodings that can be read.
ENCODINGS = ("ros2msg", "ros2idl", "omgidl")

# A schema text is a few kilobytes; far above that it is not a schema.
_MAX_TEXT = 1_000_000
# Longest word or name in one. Scopes are prefixed to names, so long ones would cost their square.
_MAX_WORD = 256
# Differences that are reported, and names quoted in one.
_MAX_DIFFERENCES = 8
_MAX_DEPTH = 16

_ROS_PRIMITIVES = {
    "bool": "bool",
    "byte": "u8",
    "char": "u8",
    "uint8": "u8",
    "int8": "i8",
    "uint16": "u16",
    "int16": "i16",
    "uint32": "u32",
    "int32": "i32",
    "uint64": "u64",
    "int64": "i64",
    "float32": "f32",
    "float64": "f64",
    "string": "string",
    "wstring": "wstring",
}

_IDL_PRIMITIVES = {
    "boolean": "bool",
    "octet": "u8",
    "char": "u8",
    "uint8": "u8",
    "int8": "i8",
    "unsigned short": "u16",
    "uint16": "u16",
    "short": "i16",
    "int16": "i16",
    "unsigned long": "u32",
    "uint32": "u32",
    "long": "i32",
    "int32": "i32",
    "unsigned long long": "u64",
    "uint64": "u64",
    "long long": "i64",
    "int64": "i64",
    "float": "f32",
    "double": "f64",
    "string": "string",
    "wstring": "wstring",
}

# u8 and i8 (and so on) occupy the same bytes: a difference in sign alone is reported, but does not
# shift the following fields. unitree_ros2 has a signed motor temperature, the SDKs an unsigned.
_SAME_BYTES = str.maketrans({"i": "u"})


@dataclass(frozen=True)
class Array:
    """``length`` elements, no length on the wire."""

    element: Node
    length: int


@dataclass(frozen=True)
class Sequence:
    """A length on the wire, then so many elements."""

    element: Node


@dataclass(frozen=True)
class Field:
    """One field of a struct."""

    name: str
    type: Node


@dataclass(frozen=True)
class Struct:
    """Fields in wire order."""

    name: str
    fields: tuple[Field, ...]


Node = str | Array | Sequence | Struct


def parse(encoding: str, name: str, text: str) -> Struct:
    """Read a schema text.

    :param encoding: one of :data:`ENCODINGS`.
    :param name: the schema's name, in any spelling.
    :raises TraceUnsupported: the encoding is unknown, or the text cannot be understood.
    """
    if len(name) > _MAX_WORD:
        raise TraceUnsupported(f"the schema's name is {len(name)} characters long")
    if len(text) > _MAX_TEXT:
        raise TraceUnsupported(f"the schema of {name} is {len(text)} characters long")
    if encoding == "ros2msg":
        structs = _parse_msg(name, text)
    elif encoding in ENCODINGS:
        structs = _IdlParser(text).parse()
    else:
        raise TraceUnsupported(f"schema encoding {encoding!r} is not one of {', '.join(ENCODINGS)}")
    return _resolve(dds_type(name), structs)


def differences(recorded: Struct, ours: Struct) -> tuple[list[str], list[str]]:
    """Compare two layouts.

    :returns: (differences that move or resize bytes, so that payloads cannot be read as ours;
        differences in names or sign only).
    """
    breaking: list[str] = []
    harmless: list[str] = []
    _compare("", recorded, ours, breaking, harmless)
    return _first_few(breaking), _first_few(harmless)


def _first_few(found: list[str]) -> list[str]:
    """The first differences and the number of the others; a schema may differ in 100,000 fields."""
    more = len(found) - _MAX_DIFFERENCES
    return [*found[:_MAX_DIFFERENCES], f"and {more} more"] if more > 0 else found


def _compare(path: str, theirs: Node, ours: Node, breaking: list[str], harmless: list[str]) -> None:
    if isinstance(theirs, Struct) and isinstance(ours, Struct):
        their_names = [f.name for f in theirs.fields]
        our_names = [f.name for f in ours.fields]
        where = f"{path or theirs.name}: "
        if len(their_names) != len(our_names):
            known = set(their_names)
            missing = [n for n in our_names if n not in known]
            extra = [n for n in their_names if n not in our_names]
            what = [f"lacks {', '.join(_first_few(missing))}"] if missing else []
            what += [f"has {', '.join(_first_few(extra))}"] if extra else []
            breaking.append(where + (" and ".join(what) or "has another number of fields"))
            return
        if their_names != our_names and sorted(their_names) == sorted(our_names):
            breaking.append(f"{where}fields in the order {', '.join(their_names)}")
            return
        for theirs_f, ours_f in zip(theirs.fields, ours.fields, strict=True):
            here = f"{path}.{ours_f.name}" if path else ours_f.name
            if theirs_f.name != ours_f.name:
                harmless.append(f"{here} is called {theirs_f.name}")
            _compare(here, theirs_f.type, ours_f.type, breaking, harmless)
    elif isinstance(theirs, Array) and isinstance(ours, Array):
        if theirs.length != ours.length:
            breaking.append(f"{path} has {theirs.length} elements, not {ours.length}")
        else:
            _compare(f"{path}[]", theirs.element, ours.element, breaking, harmless)
    elif isinstance(theirs, Sequence) and isinstance(ours, Sequence):
        _compare(f"{path}[]", theirs.element, ours.element, breaking, harmless)
    elif isinstance(theirs, str) and isinstance(ours, str):
        if theirs == ours:
            return
        if theirs.translate(_SAME_BYTES) == ours.translate(_SAME_BYTES):
            harmless.append(f"{path} is {theirs}, read as {ours}")
        else:
            breaking.append(f"{path} is {theirs}, not {ours}")
    else:
        breaking.append(f"{path} is {_describe(theirs)}, not {_describe(ours)}")


def _describe(node: Node) -> str:
    if isinstance(node, str):
        return node
    if isinstance(node, Array):
        return f"an array of {_describe(node.element)}"
    if isinstance(node, Sequence):
        return f"a sequence of {_describe(node.element)}"
    return node.name


@dataclass(frozen=True)
class _Ref:
    """A type named but not yet looked up; candidates from the innermost scope outward."""

    candidates: tuple[str, ...]


_Structs = dict[str, list[tuple[str, object]]]


def _resolve(name: str, structs: _Structs) -> Struct:
    done: dict[str, Struct] = {}

    def struct(name: str, depth: int) -> Struct:
        if name not in structs:
            raise TraceUnsupported(f"the schema text does not define {name}")
        if name not in done:
            fields = tuple(Field(n, node(raw, depth + 1)) for n, raw in structs[name])
            done[name] = Struct(name, fields)
        return done[name]

    def node(raw: object, depth: int) -> Node:
        if depth > _MAX_DEPTH:
            raise TraceUnsupported(
                f"the schema nests deeper than {_MAX_DEPTH} levels, or contains itself"
            )
        if isinstance(raw, str):
            return raw
        if isinstance(raw, Array):
            return Array(node(raw.element, depth + 1), raw.length)
        if isinstance(raw, Sequence):
            return Sequence(node(raw.element, depth + 1))
        assert isinstance(raw, _Ref)
        for candidate in raw.candidates:
            if candidate in structs:
                return struct(candidate, depth)
        raise TraceUnsupported(f"the schema text does not define {raw.candidates[-1]}")

    return struct(name, 0)


def _parse_msg(name: str, text: str) -> _Structs:
    """``.msg`` definitions: the first is ``name``, others follow ``MSG: pkg/Type`` lines."""
    structs: _Structs = {}
    current = dds_type(name)
    structs[current] = []
    for number, original in enumerate(text.splitlines(), 1):
        line = original.split("#", 1)[0].strip()
        if not line or set(line) == {"="}:
            continue
        if line.startswith("MSG:"):
            current = dds_type(_check_word(line[4:].strip()))
            structs[current] = []
            continue
        parts = line.split(None, 1)
        if len(parts) != 2:
            raise TraceUnsupported(f"the schema of {name} has {line[:60]!r} in line {number}")
        type_text, rest = parts
        match = re.match(r"\w+", rest)
        if match is None:
            raise TraceUnsupported(f"the schema of {name} has {line[:60]!r} in line {number}")
        if rest[match.end() :].lstrip().startswith("="):
            continue  # a constant
        package = current.split("::", 1)[0]
        structs[current].append(
            (_check_word(match.group()), _msg_type(_check_word(type_text), package))
        )
    return structs


def _msg_type(text: str, package: str) -> object:
    match = re.fullmatch(r"([\w/]+)(?:<=\d+)?(\[(<=)?(\d*)\])?", text)
    if match is None:
        raise TraceUnsupported(f"the schema has a field of type {text[:60]!r}")
    base, brackets, bounded, size = match.groups()
    element: object = _ROS_PRIMITIVES.get(base)
    if element is None:
        element = _Ref((dds_type(base if "/" in base else f"{package}/msg/{base}"),))
    if brackets is None:
        return element
    if bounded or not size:
        return Sequence(element)  # type: ignore[arg-type]  # resolved later
    return Array(element, _length(size))  # type: ignore[arg-type]


def _check_word(text: str) -> str:
    if len(text) > _MAX_WORD:
        raise TraceUnsupported(f"the schema has a name of {len(text)} characters")
    return text


def _length(digits: str) -> int:
    if len(digits) > 9:
        raise TraceUnsupported(f"the schema has an array of {digits[:12]}... elements")
    return int(digits)


# A single pass without backtracking: an unclosed comment ends with the text.
_TOKEN = re.compile(
    r"//[^\n]*|/\*.*?(?:\*/|\Z)|^[^\S\n]*#[^\n]*|^=+[^\S\n]*$|^IDL:[^\n]*$"  # left out
    r"|(::|[A-Za-z_]\w*|\d[\w.+-]*|\"(?:\\.|[^\"\\])*(?:\"|\\?\Z)|'[^']*(?:'|\Z)|[^\s])",
    re.DOTALL | re.MULTILINE,
)


def _tokens(text: str) -> list[str]:
    found = []
    for match in _TOKEN.finditer(text):
        token = match[1]
        if token is not None:
            found.append(token if token[0] in "\"'" else _check_word(token))
    return found


class _IdlParser:
    """The part of OMG IDL that message definitions use.

    Modules, structs, typedefs, constants and annotations; names are looked up from the
    innermost scope outward. Types are stored under their wire name (:func:`dds_type`).
    """

    def __init__(self, text: str) -> None:
        self._tokens = _tokens(text)
        self._at = 0
        self._scope: list[str] = []
        self._structs: _Structs = {}
        self._typedefs: dict[str, object] = {}
        self._constants: dict[str, int] = {}

    def parse(self) -> _Structs:
        while self._at < len(self._tokens):
            self._definition()
        return self._structs

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _next(self) -> str:
        token = self._peek()
        if not token:
            raise TraceUnsupported("the schema text ends in the middle of a definition")
        self._at += 1
        return token

    def _expect(self, token: str) -> None:
        found = self._next()
        if found != token:
            raise TraceUnsupported(f"the schema has {found[:40]!r} where {token!r} belongs")

    def _skip_annotations(self) -> None:
        while self._peek() == "@":
            self._next()
            self._scoped_name()
            if self._peek() == "(":
                depth = 0
                while True:
                    token = self._next()
                    depth += (token == "(") - (token == ")")
                    if depth == 0:
                        break

    def _definition(self) -> None:
        self._skip_annotations()
        keyword = self._next()
        if keyword == "module":
            if len(self._scope) >= _MAX_DEPTH:
                raise TraceUnsupported("the schema nests its modules too deeply")
            self._scope.append(self._next())
            self._expect("{")
            while self._peek() != "}":
                self._definition()
            self._expect("}")
            self._scope.pop()
        elif keyword == "struct":
            self._struct()
        elif keyword == "typedef":
            base = self._type()
            for name, wrapped in self._declarators(base):
                self._typedefs["::".join([*self._scope, name])] = wrapped
        elif keyword == "const":
            self._type()
            name = self._next()
            self._expect("=")
            value = self._next()
            while self._peek() != ";":
                value = ""
                self._next()
            if value.isdecimal():
                self._constants[name] = _length(value)
        elif keyword == ";":
            return
        else:
            raise TraceUnsupported(f"the schema defines a {keyword[:40]!r}, which dexkit lacks")
        if self._peek() == ";":
            self._next()

    def _struct(self) -> None:
        name = self._next()
        if self._peek() == ";":
            return  # a forward declaration
        self._expect("{")
        fields: list[tuple[str, object]] = []
        while True:
            self._skip_annotations()
            if self._peek() == "}":
                break
            base = self._type()
            fields += self._declarators(base)
            self._expect(";")
        self._expect("}")
        self._structs[dds_type("::".join([*self._scope, name]))] = fields

    def _declarators(self, base: object) -> list[tuple[str, object]]:
        found = []
        while True:
            self._skip_annotations()
            name = self._next()
            sizes = []
            while self._peek() == "[":
                self._next()
                sizes.append(self._size())
                self._expect("]")
            wrapped = base
            for size in reversed(sizes):
                wrapped = Array(wrapped, size)  # type: ignore[arg-type]  # resolved later
            found.append((name, wrapped))
            if self._peek() != ",":
                return found
            self._next()

    def _size(self) -> int:
        token = self._next()
        if token.isdecimal():
            return _length(token)
        if token in self._constants:
            return self._constants[token]
        raise TraceUnsupported(f"the schema has the array size {token[:40]!r}")

    def _scoped_name(self) -> str:
        if self._peek() == "::":
            self._next()
        parts = [self._next()]
        while self._peek() == "::":
            self._next()
            parts.append(self._next())
        return "::".join(parts)

    def _type(self, depth: int = 0) -> object:
        if depth > _MAX_DEPTH:
            raise TraceUnsupported("the schema nests its sequences too deeply")
        token = self._peek()
        if token == "sequence":
            self._next()
            self._expect("<")
            element = self._type(depth + 1)
            if self._peek() == ",":
                self._next()
                self._next()
            self._expect(">")
            return Sequence(element)  # type: ignore[arg-type]  # resolved later
        if token in ("string", "wstring"):
            self._next()
            if self._peek() == "<":
                self._next()
                self._next()
                self._expect(">")
            return token
        if token in ("unsigned", "long"):
            words = [self._next()]
            while self._peek() in ("long", "short"):
                words.append(self._next())
            if self._peek() == "double":
                raise TraceUnsupported(
                    "the schema has a long double, which dexkit does not support"
                )
            name = " ".join(words)
        else:
            name = self._scoped_name()
        if name in _IDL_PRIMITIVES:
            return _IDL_PRIMITIVES[name]
        candidates = [
            "::".join([*self._scope[:depth], name]) for depth in range(len(self._scope), -1, -1)
        ]
        for candidate in candidates:
            if candidate in self._typedefs:
                return self._typedefs[candidate]
        return _Ref(tuple(dds_type(c) for c in candidates))
