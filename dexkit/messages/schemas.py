"""Schema texts for recordings: ``ros2msg`` and ``omgidl``."""

from __future__ import annotations

from dexkit.messages.layout import Field, Primitive, Struct

__all__ = ["omgidl", "ros2msg"]

_SEPARATOR = "=" * 80


def _ros_member(member: Field) -> str:
    if isinstance(member.type, Primitive):
        kind = member.type.ros
    else:
        package, _, name = member.type.ros_name.split("/")
        kind = f"{package}/{name}"
    if member.sequence and not member.is_text:
        kind += "[]" if member.bound is None else f"[<={member.bound}]"
    elif member.array is not None:
        kind += f"[{member.array}]"
    comment = f"  # {member.doc}" if member.doc else ""
    return f"{kind} {member.name}{comment}"


def ros2msg(struct: Struct) -> str:
    """The concatenated message definition: the type itself, then each type it needs.

    The form is that of the ``ros2msg`` schema encoding of mcap: definitions parted by a line
    of 80 ``=`` and a line ``MSG: package/Name``.
    """
    parts = ["\n".join(map(_ros_member, struct.fields)) + "\n"]
    for inner in struct.depends():
        package, _, name = inner.ros_name.split("/")
        body = "\n".join(map(_ros_member, inner.fields))
        parts.append(f"{_SEPARATOR}\nMSG: {package}/{name}\n{body}\n")
    return "".join(parts)


def _idl_member(member: Field) -> str:
    kind = member.type.classic if isinstance(member.type, Primitive) else member.type.dds_name
    if member.sequence and not member.is_text:
        bound = "" if member.bound is None else f", {member.bound}"
        return f"  sequence<{kind}{bound}> {member.name};"
    array = f"[{member.array}]" if member.array is not None else ""
    return f"  {kind} {member.name}{array};"


def omgidl(struct: Struct) -> str:
    """One self-contained IDL text: the type and each type it needs, inside their modules.

    Numbers carry their classic names (``octet``, ``unsigned long``), which every IDL reader
    knows.
    """
    lines = [f"module {name} {{" for name in struct.scope]
    for inner in (*struct.depends(), struct):
        lines += ["@final", f"struct {inner.name} {{", *map(_idl_member, inner.fields), "};"]
    lines += ["};"] * len(struct.scope)
    return "\n".join(lines) + "\n"
