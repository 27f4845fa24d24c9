"""Write the typed message modules from ``idl/*.idl``: ``python -m dexkit.messages.generate``.

``--check`` writes nothing and fails when a module is not what would be written.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path

from dexkit.messages.layout import Field, Leaf, Primitive, Struct, load

__all__ = ["main", "render"]


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
    """Split at the sequences: (fixed members, the sequence that follows or None)."""
    out: list[tuple[list[Field], Field | None]] = []
    fixed: list[Field] = []
    for member in struct.fields:
        if member.sequence:
            out.append((fixed, member))
            fixed = []
        else:
            fixed.append(member)
    if fixed or not out:
        out.append((fixed, None))
    return out


def _annotation(member: Field) -> str:
    name = member.type.python if isinstance(member.type, Primitive) else member.type.name
    if member.sequence:
        return f"list[{name}]"
    return name if member.array is None else f"tuple[{name}, ...]"


def _default(member: Field) -> str:
    if member.sequence:
        return "field(default_factory=list)"
    if isinstance(member.type, Struct):
        return f"field(default_factory={member.type.name})"
    zero = "0.0" if member.type.python == "float" else "0"
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


def _codec(struct: Struct) -> list[str]:
    constants: list[str] = []
    encode: list[str] = []
    decode: list[str] = []
    pieces: list[str] = []  # what encode joins, as long as it is simple
    offset = 0
    bound: dict[str, str] = {}
    stem = f"_{struct.name.rstrip('_')}"
    segments = _segments(struct)
    fixed_only = len(segments) == 1 and segments[0][1] is None

    for index, (members, sequence) in enumerate(segments):
        leaves = [leaf for m in members for leaf in _member_leaves(m)]
        wire: list[Leaf | None] = [*leaves, *([None] if sequence else [])]
        code, end = _padded(wire, offset)
        size = end - offset
        part = f"{stem}_{index}"
        constants.append(f'{part} = (Struct("<{code}"), Struct(">{code}"))')
        values = _values(leaves, "m")
        if sequence:
            values = f"{values}, len(m.{sequence.name})" if values else f"len(m.{sequence.name})"
        encode += _array_checks(leaves, "m", "    ")
        pieces.append(f"{part}[0].pack({values})")
        at = "4" if index == 0 else "at"
        if index == 0:
            decode.append(f"    if len(data) < {4 + size}:")
            decode.append(f'        raise truncated("{struct.name}", {4 + size}, len(data))')
        else:
            decode.append(f"    if len(data) < at + {size}:")
            decode.append(f'        raise truncated("{struct.name}", at + {size}, len(data))')
        decode.append(f"    v = {part}[big].unpack_from(data, {at})")
        for name, text in _fold(leaves, "v", members).items():
            if fixed_only or sequence is None:
                bound[name] = text
            else:
                decode.append(f"    {name} = {text}")
                bound[name] = name
        decode.append(f"    at = {4 + size}" if index == 0 else f"    at += {size}")
        offset = end % 4
        if sequence is None:
            continue
        assert isinstance(sequence.type, Struct)
        element = sequence.type
        inner = list(element.leaves())
        e = f"e{index}"  # loop variables keep one type each in the whole function
        code, stride = _padded(inner, 0)
        item = f"{stem}_{sequence.name}"
        constants.append(f'{item} = (Struct("<{code}"), Struct(">{code}"))')
        encode += [
            f"    if len(m.{sequence.name}) > MAX_ELEMENTS:",
            "        raise ArrayLengthError",
            f"    pack = {item}[0].pack",
        ]
        encode += [
            f"    {sequence.name} = []",
            f"    for {e} in m.{sequence.name}:",
            *_array_checks(inner, e, "        "),
            f"        {sequence.name}.append(pack({_values(inner, e)}))",
        ]
        pieces.append(f"*{sequence.name}")
        count = sum(leaf.count for leaf in leaves)
        names, assign = _assignments(inner, element)
        decode += [
            f"    end = at + {stride} * v[{count}]",
            f"    if end > len(data) or v[{count}] > MAX_ELEMENTS:",
            f'        check_count("{struct.name}.{sequence.name}", v[{count}], end, len(data))',
            f"    {sequence.name} = []",
            f"    for {names} in {item}[big].iter_unpack(data[at:end]):",
            f"        {e} = new({element.name})",
            *(f"        {e}.{line}" for line in assign),
            f"        {sequence.name}.append({e})",
            "    at = end",
        ]
        bound[sequence.name] = sequence.name

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
    lines = [
        f'"""Messages of ``{package}``: dataclasses and their CDR codec.',
        "",
        f"Generated from idl/{package}.idl by ``python -m dexkit.messages.generate``; do not edit.",
        "Use the codec through :func:`dexkit.messages.message_type`: it checks the header and the",
        "bounds and turns every failure into a :class:`dexkit.errors.WireError`.",
        '"""',
        "",
        "# ruff: noqa: E501, N802",
        "# fmt: off",
        "",
        "from __future__ import annotations",
        "",
        "from dataclasses import dataclass, field",
        "from struct import Struct",
        "",
        "from dexkit.messages.codec import (",
        "    HEADER,",
        "    ArrayLengthError,",
        "    Buffer,",
        "    check_count,",
        "    check_end,",
        "    truncated,",
        ")",
        "from dexkit.messages.layout import MAX_ELEMENTS",
        "",
        "# blank objects, filled by plain assignments: faster than calling the constructor",
        "new = object.__new__",
        "",
        "__all__ = [",
        *(f'    "{s.name}",' for s in sorted(mine, key=lambda s: s.name)),
        "]",
    ]
    for struct in mine:
        lines += ["", "", *_dataclass(struct)]
    for struct in mine:
        lines += ["", "", *_codec(struct)]
    return "\n".join(lines) + "\n"


def main(argv: list[str] | None = None) -> int:
    """Write (or with ``--check`` compare) one module per IDL package."""
    parser = argparse.ArgumentParser(prog="python -m dexkit.messages.generate")
    parser.add_argument("--check", action="store_true", help="only say whether all is up to date")
    options = parser.parse_args(argv)
    structs = list(load().values())
    stale = []
    for package in sorted({s.scope[0] for s in structs}):
        path = Path(__file__).with_name(f"{package}.py")
        text = render(package, structs)
        if path.exists() and path.read_text() == text:
            continue
        stale.append(path.name)
        if not options.check:
            path.write_text(text)
    print(f"{'stale' if options.check else 'written'}: {', '.join(stale) or 'none'}")
    return 1 if options.check and stale else 0


if __name__ == "__main__":
    sys.exit(main())
