"""The drawings: joints by index and name, how they close, and the tactile elements.

Places come from the layouts beside this module, everything else from the models.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dexkit.errors import UsageError
from dexkit.hand import JointSpec, Side
from dexkit.models import Dialect, HandModel
from dexkit.robots import RobotModel
from tools.generate import hand_layouts, robot_layouts
from tools.generate.hand_layouts import Finger, HandLayout
from tools.generate.robot_layouts import RobotLayout
from tools.generate.svg_sheet import Point, Sheet

__all__ = ["WIDTH", "draw_hand", "draw_robot"]

WIDTH = 880
_MARGIN = 24.0
_RADIUS = 11.0
_STRIP = 104.0  # height of the legend
_STYLES = {1: "plus", -1: "minus", 0: "none"}
_SIGNS = {1: "+", -1: "−", 0: ""}


def draw_hand(model: HandModel) -> Sheet:
    """Both hands of a model, side by side.

    :raises UsageError: a hand of several joints that has no layout.
    """
    if len(model.joints[Side.LEFT]) == 1:
        return _draw_gripper(model)
    layout = hand_layouts.LAYOUTS.get(model.name)
    if layout is None:
        raise UsageError(f"the {model.title} has no layout, so it cannot be drawn")
    return _draw_fingers(model, layout)


def _sheet(height: float, title: str, what: str, view: str) -> Sheet:
    sheet = Sheet(
        WIDTH, round(height), f"{title}: {what}", f"Schematic, not to scale: {title}, {view}."
    )
    sheet.text((_MARGIN, 38), title, size=20, bold=True)
    sheet.text((_MARGIN, 60), view, "muted", size=12)
    sheet.text((WIDTH - _MARGIN, 37), "schematic, not to scale", "muted", size=12, anchor="end")
    return sheet


def _degrees(joint: JointSpec) -> str:
    """A joint's range in whole degrees."""
    low, high = (round(math.degrees(q)) for q in (joint.q_min, joint.q_max))
    return f"{low}..{high}°".replace("-", "−")


# -- hands with fingers ---------------------------------------------------------------------


class _Place:
    """From a layout's own coordinates to the sheet's.

    :param mirror: 1, or -1 to turn left into right.
    """

    def __init__(self, origin: Point, mirror: float) -> None:
        self._origin, self._mirror = origin, mirror

    def __call__(self, point: Point) -> Point:
        return self._origin[0] + self._mirror * point[0], self._origin[1] + point[1]


def _draw_fingers(model: HandModel, layout: HandLayout) -> Sheet:
    bottom = layout.top + layout.palm[1] / 2
    sheet = _sheet(
        bottom + 70 + _STRIP,
        model.title,
        "joints by index",
        "both palms toward you, fingers stretched",
    )
    topics = model.dialects[0]
    for side, x in zip(Side, layout.centres, strict=True):
        place = _Place((x, layout.top), 1.0 if side is Side.LEFT else -1.0)
        sheet.rect((x, layout.top), layout.palm, "solid", radius=30)
        limbs = [[place(f.along(-f.root)), place(f.end)] for f in layout.fingers]
        _flesh(sheet, limbs, layout.width)
        sheet.rect((x, layout.top), _shrunk(layout.palm), "flesh", radius=29)
        for finger in layout.fingers:
            _finger(sheet, place, finger, model, side)
            tip = place(finger.end)
            above = (tip[0], tip[1] - layout.width / 2 - 8)
            sheet.text(above, finger.name, "muted", size=12, anchor="middle")
        palm = [i for i, s in enumerate(model.sensors) if s.place.startswith("palm")]
        for packet, at in zip(palm, layout.palm_sensors, strict=True):
            _taxels(sheet, place(at), len(model.sensors[packet].slots), packet)
        sheet.text((x, bottom + 28), f"{side} hand", bold=True, size=14, anchor="middle")
        sheet.text((x, bottom + 46), _topics(topics, side), "muted", size=12, anchor="middle")
    _legend(sheet, model)
    return sheet


def _topics(dialect: Dialect, side: Side) -> str:
    """``rt/dex3/left/cmd, …/state``: both topics, what they have in common once."""
    command, state = (topic.split("/") for topic in dialect.topics(side))
    same = next(i for i, (a, b) in enumerate(zip(command, state, strict=True)) if a != b)
    return f"{'/'.join(command)}, …/{'/'.join(state[same:])}"


def _flesh(sheet: Sheet, limbs: Sequence[Sequence[Point]], width: float) -> None:
    """Limbs as one shape: all edges lie under all insides."""
    for points in limbs:
        sheet.limb(points, width + 3, "edge")
    for points in limbs:
        sheet.limb(points, width, "bone")


def _shrunk(size: Point) -> Point:
    """Without the edge."""
    return size[0] - 1.5, size[1] - 1.5


def _finger(sheet: Sheet, place: _Place, finger: Finger, model: HandModel, side: Side) -> None:
    for k, index in enumerate(finger.joints):
        _joint(sheet, place(finger.along(k)), index, model.joints[side][index])
    last = len(finger.joints) - 1
    places = {"pad": finger.along(last + 0.8 * finger.tip - 0.36), "tip": finger.end}
    for packet, sensor in enumerate(model.sensors):
        whose, _, part = sensor.place.partition(" ")
        if whose == finger.name:
            _taxels(sheet, place(places[part]), len(sensor.slots), packet)


def _joint(sheet: Sheet, at: Point, index: int, joint: JointSpec) -> None:
    """Its index in a disc that shows how it closes, its name and range below."""
    x, y = at
    style = _STYLES[joint.closing]
    sheet.circle((x, y - 8), _RADIUS, style)
    sheet.text((x, y - 4), str(index), "number", size=12, bold=True, anchor="middle")
    if sign := _SIGNS[joint.closing]:
        sheet.text((x + 18, y - 3), sign, style, size=15, bold=True, anchor="middle")
    sheet.text((x, y + 16), joint.name, bold=True, size=11.5, anchor="middle")
    sheet.text((x, y + 29), _degrees(joint), "muted", size=10.5, anchor="middle")


def _taxels(sheet: Sheet, at: Point, count: int, packet: int) -> None:
    """The elements of a packet, and beside them its number."""
    columns = 3 if count == 3 else 2
    rows = math.ceil(count / columns)
    x, y = at[0] - 13, at[1]
    for k in range(count):
        row, column = divmod(k, columns)
        dx, dy = (column - (columns - 1) / 2) * 9.5, (row - (rows - 1) / 2) * 9.5
        sheet.rect((x + dx, y + dy), (7.0, 7.0), "taxel", radius=1.5)
    sheet.rect((at[0] + 18, y), (18, 16), "badge", radius=4)
    sheet.text((at[0] + 18, y + 4), str(packet), "sensor", size=11, bold=True, anchor="middle")


def _legend(sheet: Sheet, model: HandModel) -> None:
    """How a finger closes, seen from the side, and what the colours mean."""
    top = sheet.height - _STRIP
    sheet.line([(_MARGIN, top), (WIDTH - _MARGIN, top)], "leader")
    _curl(sheet, (64.0, top + 84))
    sheet.text((124, top + 34), "A hand closes when its", size=12)
    sheet.text((124, top + 51), "fingers curl toward the", size=12)
    sheet.text((124, top + 68), "palm (seen from the side).", size=12)
    signs = {j.closing for side in Side for j in model.joints[side]}
    texts = {
        1: "closes toward larger q",
        -1: "closes toward smaller q",
        0: "swings sideways: neither opens nor closes",
    }
    y = top + 34
    for sign in (s for s in texts if s in signs):
        sheet.circle((316, y - 4), 8, _STYLES[sign])
        sheet.text((330, y), f"{_SIGNS[sign]} {texts[sign]}".strip(), size=12)
        y += 22
    if model.sensors:
        elements = sum(len(s.slots) for s in model.sensors)
        y = top + 34
        _taxels(sheet, (629, y - 4), 4, 0)
        sheet.text((664, y), "number of the pressure packet", size=12)
        last = len(model.sensors) - 1
        sheet.text((664, y + 17), f"(0 to {last}) and its elements,", size=12)
        sheet.text((664, y + 34), f"{elements} in all; likely places", size=12)


def _curl(sheet: Sheet, base: Point) -> None:
    """A finger from the side, stretched (dashed) and curled."""
    x, y = base
    sheet.line([(x, y - 18), (x, y - 66)], "ghost")
    _flesh(sheet, [[(x, y), (x, y - 18), (x + 16, y - 38), (x + 36, y - 32)]], 9)
    sheet.arrow((x + 5, y - 66), (x + 36, y - 66), (x + 43, y - 44))


# -- grippers -------------------------------------------------------------------------------


def _draw_gripper(model: HandModel) -> Sheet:
    """A hand of one joint as two jaws that meet at q = 0."""
    height = 330.0
    sheet = _sheet(height, model.title, "its joint", "jaws half open; both sides are alike")
    topics = model.dialects[0]
    for side, x in zip(Side, (230.0, 650.0), strict=True):
        _jaws(sheet, (x, 210.0), model.joints[side][0])
        sheet.text((x, 286), f"{side} gripper", bold=True, size=14, anchor="middle")
        motor = f", motor id {model.vendor_ids[side]}" if side in model.vendor_ids else ""
        text = f"{_topics(topics, side)}{motor}"
        sheet.text((x, 304), text, "muted", size=12, anchor="middle")
    return sheet


def _jaws(sheet: Sheet, at: Point, joint: JointSpec) -> None:
    x, y = at
    sheet.rect((x, y + 22), (190, 44), "solid", radius=12)
    _joint_beside(sheet, (x, y + 22), 0, joint)
    for way in (-1.0, 1.0):
        sheet.rect((x + way * 120, y - 60), (24, 96), "ghost", radius=5)
        sheet.rect((x + way * 62, y - 54), (24, 106), "solid", radius=5)
        sheet.rect((x + way * 10.5, y - 60), (19, 96), "ghost", radius=5)
        sheet.arrow((x + way * 104, y - 84), (x + way * 70, y - 84), (x + way * 36, y - 84))
    closed, opened = (joint.q_min, joint.q_max) if joint.closing < 0 else (joint.q_max, joint.q_min)
    sheet.text((x, y - 118), f"q = {closed:g} closed", size=12, anchor="middle")
    for way in (-1.0, 1.0):
        sheet.text((x + way * 140, y - 118), f"{opened:g} rad open", size=12, anchor="middle")


def _joint_beside(sheet: Sheet, at: Point, index: int, joint: JointSpec) -> None:
    x, y = at
    style = _STYLES[joint.closing]
    sheet.circle((x - 72, y), _RADIUS, style)
    sheet.text((x - 72, y + 4), str(index), "number", size=12, bold=True, anchor="middle")
    sheet.text((x - 54, y + 4), joint.name, bold=True, size=12)
    sheet.text((x + 84, y + 4), f"{_SIGNS[joint.closing]} closes", style, size=12, anchor="end")


# -- robots ---------------------------------------------------------------------------------


def draw_robot(model: RobotModel) -> Sheet:
    """A robot from behind, so that its left is left.

    :raises KeyError: a robot that has no layout.
    """
    layout = robot_layouts.LAYOUTS[model.name]
    top = 138.0
    height = top + layout.bottom + 74
    sheet = _sheet(height, model.title, "joints by motor slot", "from behind: its left is left")
    places = {
        side: _Place((WIDTH / 2, top), m) for side, m in ((Side.LEFT, 1.0), (Side.RIGHT, -1.0))
    }
    _trunk(sheet, layout, (WIDTH / 2, top))
    limbs = [[place(p) for p in limb.places] for place in places.values() for limb in layout.limbs]
    _flesh(sheet, limbs, 30)
    for side, place in places.items():
        outward = -1.0 if side is Side.LEFT else 1.0
        for limb in layout.limbs:
            for part, at in zip(limb.joints, limb.places, strict=False):
                _slot(sheet, place(at), model, f"{side}_{part}", outward)
    for name, at in layout.trunk:
        _slot(sheet, places[Side.LEFT](at), model, name, 1.0)
    _robot_legend(sheet, model)
    return sheet


def _trunk(sheet: Sheet, layout: RobotLayout, neck: Point) -> None:
    x, y = neck
    upper, lower, half = layout.torso
    sheet.rect((x, y - 34), (52, 60), "solid", radius=22)
    sheet.rect((x, y + (upper + lower) / 2), (2 * half, lower - upper), "solid", radius=26)


def _slot(sheet: Sheet, at: Point, model: RobotModel, name: str, outward: float) -> None:
    x, y = at
    slot = model.slot(name)
    sheet.circle(at, _RADIUS, "plus" if slot in model.arm_slots else "none")
    sheet.text((x, y + 4), str(slot), "number", size=12, bold=True, anchor="middle")
    anchor = "start" if outward > 0 else "end"
    x += outward * 28
    sheet.text((x, y), name, bold=True, size=11.5, anchor=anchor)
    sheet.text((x, y + 13), _degrees(model.joint(slot)), "muted", size=10.5, anchor=anchor)


def _robot_legend(sheet: Sheet, model: RobotModel) -> None:
    top = sheet.height - 60.0
    sheet.line([(_MARGIN, top), (WIDTH - _MARGIN, top)], "leader")
    y = top + 34
    sheet.circle((36, y - 4), 8, "plus")
    sheet.text((52, y), f"also on {model.arm_topic}", size=12)
    sheet.circle((212, y - 4), 8, "none")
    sheet.text((228, y), f"on {model.cmd_topic} only", size=12)
    empty = [i for i, joint in enumerate(model.joints) if joint is None]
    which = f"slot {empty[0]} has" if len(empty) == 1 else f"slots {empty[0]} to {empty[-1]} have"
    weight = f"{which} no joint; q of slot {model.weight_slot} is the weight of {model.arm_topic}"
    sheet.text((WIDTH - _MARGIN, y), weight, "muted", size=12, anchor="end")
