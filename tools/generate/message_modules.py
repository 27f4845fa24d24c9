"""dexkit/messages/unitree_*.py: dataclasses and CDR codec of each IDL package."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from dexkit.messages.layout import Field, Leaf, Primitive, Struct, load
from tools.generate import ROOT

__all__ = ["files", "render"]

# what generated codecs may take from dexkit.messages.codec, in the order of an import
_CODEC_NAMES = (
    *("HEADER", "ArrayLengthError", "Buffer", "check_count", "check_end"),
    *("pack_bytes", "pack_numbers", "pack_text"),
    *("take_bytes", "take_numbers", "take_text", "truncated"),
)
_ELEMENTS_LINES = {
    False: [],
    True: [
        "from dexkit.messages.layout import MAX_ELEMENTS",
        "",
        "# blank objects, filled by plain assignments: faster than calling the constructor",
        "new = object.__new__",
    ],
}


def _padded(leaves: Iterable[Leaf | None], offset: int) -> tuple[str, int]:
    """``struct`` format of leaves that start at ``offset``, and where it ends.

    None stands for the uint32 length of a sequence.
    """
    codes: list[str] = []
    for leaf in leaves:
        size = leaf.type.size if leaf else 4
        pad = -offset % size
        count = leaf.count if leaf else 1
        codes += ["x"] * pad + [leaf.type.code if leaf else "I"] * count
        offset += pad + size * count
    text = ""
    for code, run in groupby(codes):
        n = len(list(run))
        text += (str(n) if n > 1 else "") + code
    return text, offset


def _member_leaves(member: Field) -> list[Leaf]:
    return list(Struct((), "", (member,)).leaves())


def _segments(struct: Struct) -> list[tuple[list[Field], Field | None]]:
    """Split at what holds many structs: (fixed members, the sequence or array that follows)."""
    out: list[tuple[list[Field], Field | None]] = []
    fixed: list[Field] = []
    for member in struct.fields:
        if member.sequence or member.is_structs:
            out.append((fixed, member))
            fixed = []
        else:
            fixed.append(member)
    if fixed or not out:
        out.append((fixed, None))
    return out


def _annotation(member: Field) -> str:
    if member.is_bytes:
        return "str" if member.is_text else "bytes"
    name = member.type.python if isinstance(member.type, Primitive) else member.type.name
    if member.sequence or member.is_structs:
        return f"list[{name}]"
    return name if member.array is None else f"tuple[{name}, ...]"


def _default(member: Field) -> str:
    if member.is_bytes:
        return '""' if member.is_text else 'b""'
    if member.sequence:
        return "field(default_factory=list)"
    if isinstance(member.type, Struct):
        if member.is_structs:
            name = member.type.name
            return f"field(default_factory=lambda: [{name}() for _ in range({member.array})])"
        return f"field(default_factory={member.type.name})"
    zero = {"float": "0.0", "int": "0", "bool": "False"}[member.type.python]
    if member.array is None:
        return zero
    return f"({zero},)" if member.array == 1 else f"({zero},) * {member.array}"


def _dataclass(struct: Struct) -> list[str]:
    lines = ["@dataclass(slots=True)", f"class {struct.name}:"]
    lines += [f'    """{struct.doc}', "", f"    DDS type ``{struct.dds_name}``.", '    """', ""]
    for member in struct.fields:
        comment = f"  # {member.doc}" if member.doc else ""
        lines.append(f"    {member.name}: {_annotation(member)} = {_default(member)}{comment}")
    return lines


def _values(leaves: list[Leaf], owner: str) -> str:
    """Arguments for ``pack``: ``m.mode, m.q, *m.reserve``."""
    return ", ".join(f"{'*' if x.array else ''}{owner}.{'.'.join(x.path)}" for x in leaves)


def _array_checks(leaves: list[Leaf], owner: str, indent: str) -> list[str]:
    tests = [f"len({owner}.{'.'.join(x.path)}) != {x.array}" for x in leaves if x.array]
    if not tests:
        return []
    return [f"{indent}if {' or '.join(tests)}:", f"{indent}    raise ArrayLengthError"]


def _fold(leaves: list[Leaf], owner: str, members: Iterable[Field]) -> dict[str, str]:
    """Expression that rebuilds each member from the flat tuple ``owner``."""
    at = 0
    pieces: list[tuple[Leaf, str]] = []
    for leaf in leaves:
        text = f"{owner}[{at}]" if leaf.array is None else f"{owner}[{at}:{at + leaf.count}]"
        pieces.append((leaf, text))
        at += leaf.count

    def build(member: Field, depth: int) -> str:
        if isinstance(member.type, Primitive):
            return pieces.pop(0)[1]
        inner = ", ".join(build(m, depth + 1) for m in member.type.fields)
        return f"{member.type.name}({inner})"

    return {m.name: build(m, 0) for m in members}


def _assignments(leaves: list[Leaf], struct: Struct) -> tuple[str, list[str]]:
    """Names for the numbers of one element, and the lines that put them into its members.

    Named numbers and plain assignments to a blank object are a third faster than a flat tuple,
    slices of it and a call of the constructor; it is what most of decoding consists of.
    """
    names = [f"x{i}" for i in range(sum(leaf.count for leaf in leaves))]
    left = iter(names)

    def build(member: Field) -> str:
        if isinstance(member.type, Struct):
            return f"{member.type.name}({', '.join(build(m) for m in member.type.fields)})"
        if member.array is None:
            return next(left)
        items = ", ".join(next(left) for _ in range(member.array))
        return f"({items},)" if member.array == 1 else f"({items})"

    lines = [f"{member.name} = {build(member)}" for member in struct.fields]
    return ", ".join(names) + ("," if len(names) == 1 else ""), lines


def _text_codec(struct: Struct) -> list[str]:
    """Codec of a struct that ends with strings and sequences of bytes, after fixed members."""
    fixed = [member for member in struct.fields if not member.is_bytes]
    varied = [member for member in struct.fields if member.is_bytes]
    leaves = [leaf for m in fixed for leaf in _member_leaves(m)]
    code, size = _padded(leaves, 0)
    stem = f"_{struct.name.rstrip('_')}"
    bound = _fold(leaves, "v", fixed)
    encode, decode = [], []
    for member in varied:
        # not the bare name: a member may be called like an argument
        name, kind = f"x_{member.name}", "text" if member.is_text else "bytes"
        encode += [
            f"    {name} = pack_{kind}(m.{member.name})",
            "    out += bytes(-len(out) % 4)",
            f'    out += len({name}).to_bytes(4, "little") + {name}',
        ]
        decode.append(f'    {name}, at = take_{kind}("{struct.name}.{member.name}", data, at, big)')
        bound[member.name] = name
    arguments = ", ".join(bound[m.name] for m in struct.fields)
    return [
        f'{stem}_0 = (Struct("<{code}"), Struct(">{code}"))',
        "",
        "",
        f"def encode_{struct.name}(m: {struct.name}) -> bytes:",
        f'    """Encapsulation header and little-endian data of a {struct.name}."""',
        *_array_checks(leaves, "m", "    "),
        f"    out = bytearray(HEADER + {stem}_0[0].pack({_values(leaves, 'm')}))",
        *encode,
        "    return bytes(out)",
        "",
        "",
        f"def decode_{struct.name}(data: Buffer, big: bool) -> {struct.name}:",
        f'    """The {struct.name} after the encapsulation header of ``data``."""',
        f"    if len(data) < {4 + size}:",
        f'        raise truncated("{struct.name}", {4 + size}, len(data))',
        f"    v = {stem}_0[big].unpack_from(data, 4)",
        f"    at = {4 + size}",
        *decode,
        "    if at != len(data):",
        f'        check_end("{struct.name}", data, at)',
        f"    return {struct.name}({arguments})",
    ]


def _numbers_codec(struct: Struct) -> list[str]:
    """Codec of a struct of numbers and of sequences of them: each begins where its alignment is."""
    stem = f"_{struct.name.rstrip('_')}"
    constants, encode, decode = [], [], []
    for index, member in enumerate(struct.fields):
        assert isinstance(member.type, Primitive)
        name = f"x_{member.name}"
        if member.is_numbers:
            encode += [
                "    out += bytes(-len(out) % 4)",
                f'    out += pack_numbers("{member.type.code}", m.{member.name}, {member.bound})',
            ]
            decode.append(
                f'    {name}, at = take_numbers("{struct.name}.{member.name}", '
                f'"{member.type.code}", {member.bound}, data, at, big)'
            )
            continue
        leaves = _member_leaves(member)
        code, size = _padded(leaves, 0)
        part = f"{stem}_{index}"
        constants.append(f'{part} = (Struct("<{code}"), Struct(">{code}"))')
        if member.type.size > 1:
            encode.append(f"    out += bytes(-len(out) % {member.type.size})")
            decode.append(f"    at += -at % {member.type.size}")
        encode += [
            *_array_checks(leaves, "m", "    "),
            f"    out += {part}[0].pack({_values(leaves, 'm')})",
        ]
        decode += [
            f"    if len(data) < at + {size}:",
            f'        raise truncated("{struct.name}", at + {size}, len(data))',
            f"    {name} = {part}[big].unpack_from(data, at){'' if member.array else '[0]'}",
            f"    at += {size}",
        ]
    arguments = ", ".join(f"x_{member.name}" for member in struct.fields)
    return [
        *([*constants, "", ""] if constants else []),
        f"def encode_{struct.name}(m: {struct.name}) -> bytes:",
        f'    """Encapsulation header and little-endian data of a {struct.name}."""',
        "    out = bytearray(HEADER)",
        *encode,
        "    return bytes(out)",
        "",
        "",
        f"def decode_{struct.name}(data: Buffer, big: bool) -> {struct.name}:",
        f'    """The {struct.name} after the encapsulation header of ``data``."""',
        "    at = 4",
        *decode,
        "    if at != len(data):",
        f'        check_end("{struct.name}", data, at)',
        f"    return {struct.name}({arguments})",
    ]


def _codec(struct: Struct) -> list[str]:
    if any(member.is_bytes for member in struct.fields):
        return _text_codec(struct)
    if any(member.is_numbers for member in struct.fields):
        return _numbers_codec(struct)
    constants: list[str] = []
    encode: list[str] = []
    decode: list[str] = []
    pieces: list[str] = []  # what encode joins, as long as it is simple
    offset = 0
    bound: dict[str, str] = {}
    stem = f"_{struct.name.rstrip('_')}"
    segments = _segments(struct)
    fixed_only = len(segments) == 1 and segments[0][1] is None

    for index, (members, many) in enumerate(segments):
        leaves = [leaf for m in members for leaf in _member_leaves(m)]
        wire: list[Leaf | None] = list(leaves)
        if many and many.sequence:
            wire.append(None)
        elif many:
            # the first of an array may lie otherwise than the rest; it goes with what precedes
            first = Field(f"{many.name}[0]", many.type)
            members = [*members, first]
            leaves += _member_leaves(first)
            wire = list(leaves)
            encode += [
                f"    if len(m.{many.name}) != {many.array}:",
                "        raise ArrayLengthError",
            ]
        code, end = _padded(wire, offset)
        size = end - offset
        part = f"{stem}_{index}"
        constants.append(f'{part} = (Struct("<{code}"), Struct(">{code}"))')
        values = _values(leaves, "m")
        if many and many.sequence:
            values = f"{values}, len(m.{many.name})" if values else f"len(m.{many.name})"
        encode += _array_checks(leaves, "m", "    ")
        pieces.append(f"{part}[0].pack({values})")
        at = "4" if index == 0 else "at"
        if index == 0:
            need = 4 + (struct.end(0) if struct.is_fixed else size)
            decode.append(f"    if len(data) < {need}:")
            decode.append(f'        raise truncated("{struct.name}", {need}, len(data))')
        elif not struct.is_fixed:
            decode.append(f"    if len(data) < at + {size}:")
            decode.append(f'        raise truncated("{struct.name}", at + {size}, len(data))')
        decode.append(f"    v = {part}[big].unpack_from(data, {at})")
        for name, text in _fold(leaves, "v", members).items():
            if fixed_only or many is None:
                bound[name] = text
            elif many.is_structs and name == f"{many.name}[0]":
                decode.append(f"    {many.name} = [{text}]")
            else:
                decode.append(f"    {name} = {text}")
                bound[name] = name
        decode.append(f"    at = {4 + size}" if index == 0 else f"    at += {size}")
        offset = end % 4
        if many is None:
            continue
        assert isinstance(many.type, Struct)
        element = many.type
        inner = list(element.leaves())
        e = f"e{index}"  # loop variables keep one type each in the whole function
        code, stride = _padded(inner, 0)
        item = f"{stem}_{many.name}"
        constants.append(f'{item} = (Struct("<{code}"), Struct(">{code}"))')
        if many.sequence:
            encode += [
                f"    if len(m.{many.name}) > MAX_ELEMENTS:",
                "        raise ArrayLengthError",
            ]
        encode += [
            f"    pack = {item}[0].pack",
            f"    {many.name} = []",
            f"    for {e} in m.{many.name}{'' if many.sequence else '[1:]'}:",
            *_array_checks(inner, e, "        "),
            f"        {many.name}.append(pack({_values(inner, e)}))",
        ]
        pieces.append(f"*{many.name}")
        names, assign = _assignments(inner, element)
        if many.sequence:
            count = sum(leaf.count for leaf in leaves)
            decode += [
                f"    end = at + {stride} * v[{count}]",
                f"    if end > len(data) or v[{count}] > MAX_ELEMENTS:",
                f'        check_count("{struct.name}.{many.name}", v[{count}], end, len(data))',
                f"    {many.name} = []",
            ]
        else:
            decode.append(f"    end = at + {stride * ((many.array or 1) - 1)}")
            if not struct.is_fixed:
                decode += [
                    "    if end > len(data):",
                    f'        raise truncated("{struct.name}", end, len(data))',
                ]
        decode += [
            f"    for {names} in {item}[big].iter_unpack(data[at:end]):",
            f"        {e} = new({element.name})",
            *(f"        {e}.{line}" for line in assign),
            f"        {many.name}.append({e})",
            "    at = end",
        ]
        bound[many.name] = many.name

    arguments = ", ".join(bound[m.name] for m in struct.fields)
    return [
        *constants,
        "",
        "",
        f"def encode_{struct.name}(m: {struct.name}) -> bytes:",
        f'    """Encapsulation header and little-endian data of a {struct.name}."""',
        *encode,
        *(
            [f"    return HEADER + {pieces[0]}"]
            if fixed_only
            else [f'    return b"".join((HEADER, {", ".join(pieces)}))']
        ),
        "",
        "",
        f"def decode_{struct.name}(data: Buffer, big: bool) -> {struct.name}:",
        f'    """The {struct.name} after the encapsulation header of ``data``."""',
        *decode,
        "    if at != len(data):",
        f'        check_end("{struct.name}", data, at)',
        f"    return {struct.name}({arguments})",
    ]


def render(package: str, structs: Iterable[Struct]) -> str:
    """The Python module of one IDL package."""
    mine = [s for s in structs if s.scope[0] == package]
    bodies = ["\n".join(("", "", *_dataclass(s))) for s in mine]
    bodies += ["\n".join(("", "", *_codec(s))) for s in mine]
    text = "\n".join(bodies)
    used = [name for name in _CODEC_NAMES if re.search(rf"\b{name}\b", text)]
    fields = "dataclass, field" if "field(" in text else "dataclass"
    lines = [
        f'"""Messages of ``{package}``: dataclasses and their CDR codec.',
        "",
        f"Generated from idl/{package}.idl by ``python -m tools.generate``; do not edit.",
        "Use the codec through :func:`dexkit.messages.message_type`: it checks the header and the",
        "bounds and turns every failure into a :class:`dexkit.errors.WireError`.",
        '"""',
        "",
        f"# ruff: noqa: E501{', N802' if any(s.name[0].isupper() for s in mine) else ''}",
        "# fmt: off",
        "",
        "from __future__ import annotations",
        "",
        f"from dataclasses import {fields}",
        "from struct import Struct",
        "",
        "from dexkit.messages.codec import (",
        *(f"    {name}," for name in used),
        ")",
        *_ELEMENTS_LINES["MAX_ELEMENTS" in text],
        "",
        "__all__ = [",
        *(f'    "{s.name}",' for s in sorted(mine, key=lambda s: s.name)),
        "]",
    ]
    return "\n".join(lines) + "\n" + text + "\n"


def files() -> dict[Path, str]:
    """One module per IDL package."""
    structs = list(load().values())
    return {
        ROOT / "dexkit" / "messages" / f"{package}.py": render(package, structs)
        for package in sorted({s.scope[0] for s in structs})
    }
