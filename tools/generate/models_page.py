"""models.md and its drawings: joints, limits, topics and rates of every model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from dexkit.model_facts import (
    describe,
    gain_groups,
    indices,
    names,
    short_type,
    speed,
    torque_units,
    width,
)
from dexkit.models import MODELS
from dexkit.robots import ROBOTS
from tools.generate.model_drawing import draw_hand, draw_robot

__all__ = ["drawing", "drawings", "page"]

_INTRO = """\
# The models

Every hand and robot that dexkit knows, as it is on DDS. This page and its drawings are made from
`dexkit/models/` and `dexkit/robots.py`, which name the source of each figure and say what is
inferred or uncertain; `dexkit models NAME` prints the same in a terminal, `dexkit models --json`
for programs. The drawings are schematic: they show order, names and directions, not dimensions.
Nothing here was measured on a real hand or robot.
"""

_JOINTS = """\
A joint closes toward larger (+) or smaller (-) q, or does neither. Speeds and torques are the
limits that dexkit uses; where sources disagree, the code says which was taken."""


def drawing(name: str) -> str:
    """The drawing of a model, hand or robot, as SVG."""
    return (draw_hand(MODELS[name]) if name in MODELS else draw_robot(ROBOTS[name])).svg()


def page() -> str:
    """The page as Markdown, in docs/."""
    models = [describe(name, plugins=False) for name in names()]
    lines = [_INTRO, *_overview(models), _JOINTS, ""]
    for data in models:
        lines += _hand(data) if data["kind"] == "hand" else _robot(data)
    return "\n".join(lines).rstrip() + "\n"


def drawings() -> dict[str, str]:
    """The drawings, as SVG, by their path in docs/."""
    return {f"images/model-{name}.svg": drawing(name) for name in names()}


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    def line(cells: Iterable[object]) -> str:
        return f"| {' | '.join(str(cell) for cell in cells)} |"

    return [line(head), line("---" for _ in head), *(line(row) for row in rows), ""]


def _overview(models: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    for data in models:
        rates = data["rates_hz"]
        link = f"[`{data['name']}`]({_anchor(data['title'])})"
        if data["kind"] == "hand":
            first = data["dialects"][0]
            count = f"{len(data['sides']['left']['joints'])} a side"
            topics = (_sides(first, "command_topic"), _sides(first, "state_topic"))
            types = (first["command_type"], first["state_type"])
        else:
            count = f"{len(data['joints'])} in {data['slots']} slots"
            topics = (data["command_topic"], data["state_topic"])
            types = (data["command_type"], data["state_type"])
        rows.append(
            (
                link,
                data["title"],
                count,
                "<br>".join(f"`{topic}`" for topic in topics),
                "<br>".join(f"`{short_type(name)}`" for name in types),
                f"{rates['state']:g} Hz",
            )
        )
    return _table(("model", "what", "joints", "command, state", "types", "states"), rows)


def _sides(dialect: dict[str, Any], key: str) -> str | None:
    """One text for both sides' topics, or None where there are none."""
    left, right = (dialect["sides"][side][key] for side in ("left", "right"))
    if left is None or left == right:
        return left  # type: ignore[no-any-return]
    short = str(left).removesuffix("/l")
    return f"{short}/{{l,r}}" if short != left else short.replace("/left", "/{left,right}")


def _head(data: dict[str, Any]) -> list[str]:
    image = f"![{data['title']}, schematic](images/model-{data['name']}.svg)"
    return [f"## {data['title']}", "", image, ""]


def _anchor(heading: str) -> str:
    """The link to a heading, as GitHub makes it."""
    kept = "".join(c for c in heading.lower() if c.isalnum() or c in " -_")
    return f"#{kept.replace(' ', '-')}"


def _hand(data: dict[str, Any]) -> list[str]:
    lines = _head(data)
    lines += _table(
        ("dialect", "topics", "types", "motors", "what"),
        [_dialect_row(dialect) for dialect in data["dialects"]],
    )
    left, right = (data["sides"][side]["joints"] for side in ("left", "right"))
    if data["unit"] != "rad":
        unit = data["unit"]
        head: Sequence[str] = ("index", "joint", f"range, {unit}", "closes", f"{unit}/s")
        rows: list[Sequence[object]] = [
            (j["index"], f"`{j['name']}`", _rad(j), _closes(j), f"{speed(j):.4g}") for j in left
        ]
    elif left == right:
        head = ("index", "joint", "range, rad", "range, °", "closes", "rad/s", "N m")
        rows = [
            (j["index"], f"`{j['name']}`", _rad(j), _deg(j), _closes(j), *_limits(j)) for j in left
        ]
    else:
        head = ("index", "joint", "left, rad", "left, °", "closes", "right, rad", "right, °",
                "closes", "rad/s", "N m")  # fmt: skip
        rows = [
            (
                *(j["index"], f"`{j['name']}`", _rad(j), _deg(j), _closes(j)),
                *(_rad(k), _deg(k), _closes(k), *_limits(j)),
            )
            for j, k in zip(left, right, strict=True)
        ]
    lines += _table(head, rows)
    rates = data["rates_hz"]
    low = rates["low_rate_state"]
    copy = f", a copy at {low:g} Hz" if low else ""
    lines += [
        f"- States: {rates['state']:g} Hz{copy}; below {rates['state_at_least']:g} Hz clients "
        "suffer.",
        f"- Commands: xr_teleoperate sends {rates['command']:g} Hz, {_gains(data)}.",
        f"- Time-out of commands: {data['command_timeout_s']:g} s.",
    ]
    lines += [
        f"- Torques in units of {unit:g} N m: joints {which}."
        for which, unit in torque_units(data["dialects"][0])
    ]
    if data["shared_motors"]:
        pairs = "; ".join(indices(group) for group in data["shared_motors"])
        lines.append(f"- Joints that share a motor: {pairs}.")
    ids = {side: data["sides"][side]["vendor_id"] for side in ("left", "right")}
    if None not in ids.values():
        lines.append(f"- Motor ids of the vendor: left {ids['left']}, right {ids['right']}.")
    serve = ", ".join(f"`{b['name']}`" for b in data["backends"])
    lines += [f"- `dexkit serve`: {serve}.", ""]
    if data["pressure_sensors"]:
        rows = [
            (s["packet"], s["place"], ", ".join(map(str, s["slots"])))
            for s in data["pressure_sensors"]
        ]
        lines += _table(("packet", "place", "slots with an element"), rows)
    if data["tactile_areas"]:
        lines += [f"Touch, {rates['touch']:g} Hz:", ""]
        lines += _table(
            ("area", "elements", "list of the message"),
            [
                (a["place"], f"{a['rows']} x {a['columns']}", f"`{a['member']}`")
                for a in data["tactile_areas"]
            ],
        )
    return lines


def _dialect_row(dialect: dict[str, Any]) -> tuple[str, ...]:
    keys = "command_topic", "state_topic", "low_rate_topic", "touch_topic"
    topics = [_sides(dialect, key) for key in keys]
    types = [dialect[key] for key in ("command_type", "state_type", "touch_type")]
    return (
        f"`{dialect['name']}`",
        "<br>".join(f"`{topic}`" for topic in topics if topic),
        "<br>".join(f"`{short_type(name)}`" for name in types if name),
        str(dialect["length"]),
        dialect["summary"],
    )


def _robot(data: dict[str, Any]) -> list[str]:
    lines = _head(data)
    rows: list[Sequence[object]] = [
        ("command", f"`{data['command_topic']}`", f"`{short_type(data['command_type'])}`"),
        ("command of the arms", f"`{data['arm_topic']}`", f"`{short_type(data['command_type'])}`"),
        ("state", f"`{data['state_topic']}`", f"`{short_type(data['state_type'])}`"),
    ]
    lines += _table(("", "topic", "type"), rows)
    lines += _table(
        ("slot", "joint", "rad", "°", "rad/s", "N m", "enable", f"on `{data['arm_topic']}`"),
        [
            (
                *(j["index"], f"`{j['name']}`", _rad(j), _deg(j), *_limits(j)),
                *(f"`0x{j['enable_mode']:02X}`", "yes" if j["on_arm_topic"] else ""),
            )
            for j in data["joints"]
        ],
    )
    rates = data["rates_hz"]
    used = {j["index"] for j in data["joints"]}
    empty = indices([i for i in range(data["slots"]) if i not in used])
    lines += [
        f"- States: {rates['state']:g} Hz. Commands: {rates['command']:g} Hz of the SDK's "
        f"examples, {rates['teleop_command']:g} Hz of xr_teleoperate, {_gains(data)}.",
        f"- Time-out of commands: {data['command_timeout_s']:g} s, then the robot damps.",
        f"- Slots without a joint: {empty}; `q` of slot {data['weight_slot']} is the weight of "
        f"`{data['arm_topic']}`, 0 to 1.",
    ]
    if data["mode_machine"] is not None:
        lines.append(f"- `mode_machine` is {data['mode_machine']}; commands repeat it.")
    return [*lines, f"- Emulated by `{data['emulator']}`.", ""]


def _gains(data: dict[str, Any]) -> str:
    if "client_gains" not in data:
        return f"dq {data['client_dq']:g} and no gains"
    groups = gain_groups(data)
    if len(groups) == 1:
        return f"kp {groups[0][1]:g} N m/rad and kd {groups[0][2]:g} N m s/rad"
    texts = [f"kp {kp:g}, kd {kd:g} to joints {which}" for which, kp, kd in groups]
    return "; ".join(texts) + " (N m/rad, N m s/rad)"


def _rad(joint: dict[str, Any]) -> str:
    low, high = width(joint)
    return f"{low:.5g} .. {high:.5g}"


def _deg(joint: dict[str, Any]) -> str:
    return f"{joint['q_min_deg']:.4g} .. {joint['q_max_deg']:.4g}"


def _closes(joint: dict[str, Any]) -> str:
    return {1: "+", -1: "-", 0: "neither"}[joint["closing"]]


def _limits(joint: dict[str, Any]) -> tuple[str, str]:
    return f"{speed(joint):g}", f"{joint['tau_max_nm']:g}"
