"""Read a URDF as a skeleton for a hand or a robot: its joints, and its boxes, cylinders, spheres.

Meshes are not read: a link that has only a mesh is drawn as a bar to what hangs on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from dexkit.documents import read_bytes
from dexkit.errors import UsageError
from dexkit.hand import JointSpec
from dexkit.kinematics import BASE, Box, Segment, Skeleton, Vector, rotation

__all__ = ["read_urdf"]

_LARGEST = 4 * 2**20  # bytes; that of a whole robot has less than a tenth
_MOST_LINKS = 2000
_MOVING = ("revolute", "continuous", "prismatic")


def read_urdf(path: Path, joints: Sequence[JointSpec], mount: Vector = (0.0, 0.0, 0.0)) -> Skeleton:
    """The skeleton in a URDF.

    A joint is found by its name in the model's URDF (:attr:`~dexkit.hand.JointSpec.urdf`), or by
    the name that dexkit gives it, with or without ``_joint``. Joints that the model does not have
    stay at 0; a joint that mimics another follows it.

    :param joints: of the model, in the order of q.
    :param mount: rpy with which it is drawn.
    :raises UsageError: no URDF, or it has none of the joints.
    """
    root = _parse(path)
    names = _names(joints)
    by_child: dict[str, Element] = {}
    links = {e.get("name", ""): e for e in root.iter("link")}
    for joint in root.findall("joint"):
        child = joint.find("child")
        if child is not None and joint.find("parent") is not None:
            by_child[child.get("link", "")] = joint
    moved = {e.get("name", ""): e for e in by_child.values() if e.get("type") in _MOVING}
    segments: list[Segment] = []
    places: dict[str, int] = {}
    found = 0
    for link in _in_order(by_child, links, path):
        joint = by_child[link]
        parent = joint.find("parent")
        assert parent is not None
        at = places.get(parent.get("link", ""), BASE)
        index, factor, offset = _driver(joint, moved, names)
        found += index is not None
        origin, rpy = _origin(joint, path)
        places[link] = len(segments)
        segments.append(
            Segment(
                link,
                at,
                origin,
                rpy,
                axis=_axis(joint, path),
                joint=index,
                prismatic=joint.get("type") == "prismatic",
                factor=factor,
                offset=offset,
            )
        )
    if not found:
        wanted = ", ".join(j.urdf or j.name for j in joints[:4])
        raise UsageError(
            f"{path} has none of the hand's joints",
            hint=f"wanted: {wanted}{', ...' if len(joints) > 4 else ''}; "
            f"it has: {', '.join(list(moved)[:8]) or 'no joint that moves'}",
        )
    boxes = list(_boxes(links, places, path))
    drawn = {b.segment for b in boxes}
    boxes += [b for b in _bars(segments) if b.segment not in drawn]
    return Skeleton(tuple(segments), tuple(boxes), mount=mount, note=f"from {path.name}")


def _parse(path: Path) -> Element:
    data = read_bytes(path, _LARGEST)
    try:
        root: Element = fromstring(data, forbid_dtd=True)
    except DefusedXmlException:
        raise UsageError(
            f"{path} has a document type or entities, which a URDF does not need",
            hint="xacro writes a URDF without them",
        ) from None
    except (ParseError, ValueError, LookupError) as error:  # the others: of its encoding
        raise UsageError(f"{path} is no XML: {error}") from None
    if root.tag != "robot":
        raise UsageError(f"{path} is no URDF: it holds a {root.tag}, not a robot")
    if len(root.findall("link")) > _MOST_LINKS:
        raise UsageError(f"{path} has more than {_MOST_LINKS} links")
    return root


def _names(joints: Sequence[JointSpec]) -> dict[str, int]:
    names: dict[str, int] = {}
    for i, joint in enumerate(joints):
        for name in (joint.urdf, joint.name, f"{joint.name}_joint"):
            if name:
                names.setdefault(name, i)
    return names


def _driver(
    joint: Element, moved: dict[str, Element], names: dict[str, int]
) -> tuple[int | None, float, float]:
    """Index in q of what moves a joint, with factor and offset; a chain of mimics is followed."""
    factor, offset, seen = 1.0, 0.0, 0
    if joint.get("type") not in _MOVING:
        return None, 1.0, 0.0
    while joint.get("name") not in names:
        mimic = joint.find("mimic")
        other = moved.get(mimic.get("joint", "")) if mimic is not None else None
        seen += 1
        if mimic is None or other is None or seen > len(moved):
            return None, 1.0, 0.0
        offset += factor * _float(mimic.get("offset", "0"), joint)
        factor *= _float(mimic.get("multiplier", "1"), joint)
        joint = other
    return names[joint.get("name", "")], factor, offset


def _in_order(by_child: dict[str, Element], links: dict[str, Element], path: Path) -> Iterator[str]:
    """Links that hang on a joint, parents first."""
    children: dict[str, list[str]] = {}
    for child, joint in by_child.items():
        parent = joint.find("parent")
        assert parent is not None
        children.setdefault(parent.get("link", ""), []).append(child)
    waiting = [name for name in [*links, *children] if name not in by_child]
    waiting = list(dict.fromkeys(waiting))
    given = 0
    while waiting:
        for child in children.get(waiting.pop(0), []):
            given += 1
            waiting.append(child)
            yield child
    if given < len(by_child):
        raise UsageError(f"{path}: its links form a loop")


def _origin(element: Element, path: Path) -> tuple[Vector, Vector]:
    origin = element.find("origin")
    if origin is None:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    return _vector(origin.get("xyz", "0 0 0"), path), _vector(origin.get("rpy", "0 0 0"), path)


def _axis(joint: Element, path: Path) -> Vector:
    element = joint.find("axis")
    x, y, z = _vector(element.get("xyz", "1 0 0"), path) if element is not None else (1.0, 0.0, 0.0)
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length) if length > 0 else (1.0, 0.0, 0.0)


def _boxes(links: dict[str, Element], places: dict[str, int], path: Path) -> Iterator[Box]:
    for name, link in links.items():
        for visual in link.findall("visual") or link.findall("collision"):
            size = _size(visual, path)
            if size is None:
                continue
            centre, rpy = _origin(visual, path)
            x, y, z = rotation(rpy)[:, 0].tolist()
            yield Box(places.get(name, BASE), centre, size, along=(x, y, z))


def _size(visual: Element, path: Path) -> Vector | None:
    shape = visual.find("geometry/*")
    if shape is None:
        return None
    if shape.tag == "box":
        return _vector(shape.get("size", ""), path)
    radius = 2 * _float(shape.get("radius", "0"), shape)
    if shape.tag == "sphere":
        return radius, radius, radius
    if shape.tag == "cylinder":
        return radius, radius, _float(shape.get("length", "0"), shape)
    return None


def _bars(segments: Sequence[Segment]) -> Iterator[Box]:
    reach = max((math.dist((0, 0, 0), s.origin) for s in segments), default=0.0)
    width = min(max(0.25 * reach, 0.006), 0.06)
    parents = {s.parent for s in segments}
    for i, segment in enumerate(segments):
        x, y, z = segment.origin
        length = math.dist((0, 0, 0), segment.origin)
        if length > 0.2 * width:
            yield Box(
                segment.parent,
                (x / 2, y / 2, z / 2),
                (length + width / 2, width, width),
                along=segment.origin,
            )
        if i not in parents:  # a tip, as long as the link before it
            yield Box(
                i,
                (x / 2, y / 2, z / 2),
                (max(length, width), width, width),
                along=segment.origin if length > 0 else (1.0, 0.0, 0.0),
            )


def _vector(text: str, path: Path) -> Vector:
    parts = text.split()
    try:
        x, y, z = (float(part) for part in parts)
    except ValueError:
        raise UsageError(f"{path}: {text[:60]!r} is not three numbers") from None
    if not all(math.isfinite(v) and abs(v) < 1e4 for v in (x, y, z)):
        raise UsageError(f"{path}: {text[:60]!r} is not a position or angle")
    return x, y, z


def _float(text: str, element: Element) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{text[:60]!r} of a {element.tag} is not a number")
    return value
