"""``dexkit models``: every hand and robot that dexkit knows, as it is on DDS."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import json_option

if TYPE_CHECKING:
    from rich.table import Table

    from dexkit.console import Console

__all__ = ["command"]

_WIDEST = 100  # columns; longer lines are hard to read
_SIDES = ("left", "right")


@click.command(
    "models",
    cls=Command,
)
@click.argument("names", metavar="[NAME]...", nargs=-1)
@json_option("Print JSON, always with every detail.")
def command(names: tuple[str, ...], as_json: bool) -> None:
    """Print the models: joints, limits, topics, types, rates, gains, and backends.

    Without a NAME, an overview. 'make docs' makes drawings; the shape of the
    JSON is in dexkit/model_facts.py: one object with a list "models".
    """
    from dexkit.console import Console
    from dexkit.model_facts import describe
    from dexkit.model_facts import names as all_names

    models = [describe(name) for name in (names or all_names())]
    if as_json:
        click.echo(json.dumps({"models": models}, indent=1))
        return
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    console = Console(width=width)
    if not names:
        _overview(console, models)
        _unusable(console)
        return
    for i, data in enumerate(models):
        if i:
            console.print()
        (_hand if data["kind"] == "hand" else _robot)(console, data)


def _table(
    columns: Sequence[str], rows: Sequence[Sequence[object]], right: Sequence[str] = ()
) -> Table:
    """A table; the columns in ``right`` hold figures."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(
            column,
            justify="right" if column in right else "left",
            overflow="fold",
            no_wrap=column in ("what", "joints"),
        )
    for row in rows:
        table.add_row(*map(str, row))
    return table


def _overview(console: Console, models: Sequence[dict[str, Any]]) -> None:
    rows = []
    for data in models:
        rates = data["rates_hz"]
        if data["kind"] == "hand":
            dialect = data["dialects"][0]
            joints = f"{len(data['sides']['left']['joints'])} a side"
            topics = [_both(dialect, "command_topic"), _both(dialect, "state_topic")]
        else:
            joints = f"{len(data['joints'])} of {data['slots']} slots"
            topics = [data["command_topic"], data["state_topic"]]
        rates_text = f"{_command_rate(rates):g} Hz\n{rates['state']:g} Hz"
        rows.append(
            (f"[bold]{data['name']}[/bold]", data["title"], joints, "\n".join(topics), rates_text)
        )
    console.print(_table(("model", "what", "joints", "command, state", "rates"), rows))
    console.print("\nCommand rates are xr_teleoperate's. All of a model: dexkit models NAME.")


def _unusable(console: Console) -> None:
    """The models of other packages that cannot be used, and why."""
    from dexkit.models import model_plugins

    for plugin in model_plugins():
        if plugin.error is not None:
            console.print(
                f"{plugin.name} of {plugin.origin} cannot be used: {plugin.error}",
                style="red",
                markup=False,
                soft_wrap=True,
            )


def _command_rate(rates: dict[str, Any]) -> float:
    found: float = rates["teleop_command"] if "teleop_command" in rates else rates["command"]
    return found


def _hand(console: Console, data: dict[str, Any]) -> None:
    from dexkit.model_facts import indices, torque_units

    console.print(f"[bold]{data['name']}[/bold]  {data['title']}")
    for dialect in data["dialects"]:
        console.print(f"\n[bold]{dialect['name']}[/bold]  {dialect['summary']}")
        _topics(
            console,
            [
                ("command", _both(dialect, "command_topic"), dialect["command_type"]),
                ("state", _both(dialect, "state_topic"), dialect["state_type"]),
                ("slow state", _both(dialect, "low_rate_topic"), dialect["state_type"]),
                ("touch", _both(dialect, "touch_topic"), dialect["touch_type"]),
            ],
        )
        motors = f"{dialect['length']} motor{'s' if dialect['length'] > 1 else ''} in a message"
        first = {side: dialect["sides"][side]["first_index"] for side in _SIDES}
        if first["left"] != first["right"]:
            count = len(data["sides"]["left"]["joints"])
            mine = {s: indices(range(i, i + count)) for s, i in first.items()}
            motors += f": {mine['left']} left, {mine['right']} right"
        console.print(f"  {motors}")
        for which, unit in torque_units(dialect):
            console.print(f"  torques in units of {unit:g} N m: joints {which}")
    joints = {side: data["sides"][side]["joints"] for side in _SIDES}
    alike = joints["left"] == joints["right"]
    for side in _SIDES[:1] if alike else _SIDES:
        rows = [(*_joint(j), _CLOSES[j["closing"]]) for j in joints[side]]
        console.print(f"\n[bold]{'left and right' if alike else side}[/bold]")
        columns = _columns(data["unit"])
        console.print(_table((*columns, "closes"), rows, columns[:1] + columns[2:]))
    console.print()
    rates = data["rates_hz"]
    low = f", a copy at {rates['low_rate_state']:g} Hz" if rates["low_rate_state"] else ""
    facts = [
        ("states", f"{rates['state']:g} Hz{low}; clients suffer below "
                   f"{rates['state_at_least']:g} Hz"),
        ("commands", f"{rates['command']:g} Hz from xr_teleoperate"),
        *_gains(data),
        ("time-out", f"{data['command_timeout_s']:g} s without a command"),
    ]  # fmt: skip
    if data["shared_motors"]:
        pairs = "; ".join(indices(group) for group in data["shared_motors"])
        facts.append(("one motor", f"for joints {pairs}"))
    ids = [data["sides"][side]["vendor_id"] for side in _SIDES]
    if None not in ids:
        facts.append(("motor id", f"left {ids[0]}, right {ids[1]} on the vendor's bus"))
    serve = [f"dexkit serve {b['name']}" for b in data["backends"]]
    console.print(_facts([*facts, *zip(["backends", *[""] * len(serve)], serve, strict=False)]))
    if data["pressure_sensors"]:
        rows = [
            (s["packet"], s["place"], ", ".join(map(str, s["slots"])))
            for s in data["pressure_sensors"]
        ]
        console.print("\n[bold]pressure[/bold]")
        console.print(_table(("packet", "place", "slots with an element"), rows, ["packet"]))
    if data["tactile_areas"]:
        rows = [(a["place"], f"{a['rows']} x {a['columns']}") for a in data["tactile_areas"]]
        console.print(f"\n[bold]touch[/bold], {rates['touch']:g} Hz")
        console.print(_table(("area", "elements"), rows, []))


def _robot(console: Console, data: dict[str, Any]) -> None:
    from dexkit.model_facts import indices

    console.print(f"[bold]{data['name']}[/bold]  {data['title']}\n")
    _topics(
        console,
        [
            ("command", data["command_topic"], data["command_type"]),
            ("arms", data["arm_topic"], data["command_type"]),
            ("state", data["state_topic"], data["state_type"]),
        ],
    )
    console.print()
    rows = [(*_joint(j), f"0x{j['enable_mode']:02X}") for j in data["joints"]]
    console.print(_table((*_JOINT_COLUMNS, "enable"), rows, _FIGURES))
    console.print()
    rates = data["rates_hz"]
    empty = indices(sorted(set(range(data["slots"])) - {j["index"] for j in data["joints"]}))
    facts = [
        ("states", f"{rates['state']:g} Hz"),
        ("commands", f"{rates['command']:g} Hz from the SDK's examples, "
                     f"{rates['teleop_command']:g} Hz from xr_teleoperate"),
        *_gains(data),
        ("time-out", f"{data['command_timeout_s']:g} s without a command, then it damps"),
        ("arms", f"slots {indices([j['index'] for j in data['joints'] if j['on_arm_topic']])} on "
                 f"{data['arm_topic']}; q of slot {data['weight_slot']} is its weight"),
        ("no joint", f"slot {empty} of {data['slots']}"),
    ]  # fmt: skip
    if data["mode_machine"] is not None:
        facts.append(("mode_machine", f"{data['mode_machine']}; commands repeat it"))
    console.print(_facts([*facts, ("emulator", data["emulator"])]))


_JOINT_COLUMNS = ("#", "joint", "rad", "deg", "rad/s", "N m")
_FIGURES = _JOINT_COLUMNS[:1] + _JOINT_COLUMNS[2:]


def _columns(unit: str) -> tuple[str, ...]:
    return _JOINT_COLUMNS if unit == "rad" else ("#", "joint", unit, f"{unit}/s")


_CLOSES = {1: "+", -1: "-", 0: "neither"}


def _joint(joint: dict[str, Any]) -> tuple[object, ...]:
    from dexkit.model_facts import speed, width

    low, high = width(joint)
    found = [joint["index"], joint["name"], f"{round(low, 4):g} .. {round(high, 4):g}"]
    if "q_min_deg" not in joint:
        return (*found, f"{speed(joint):.4g}")
    found.append(f"{joint['q_min_deg']:.0f} .. {joint['q_max_deg']:.0f}")
    return (*found, f"{speed(joint):g}", f"{joint['tau_max_nm']:g}")


def _both(dialect: dict[str, Any], key: str) -> str:
    """One text for both sides' topics; empty where there are none."""
    left, right = (dialect["sides"][side][key] or "" for side in _SIDES)
    if left == right:
        return left
    short = left.removesuffix("/l")
    return f"{short}/{{l,r}}" if short != left else left.replace("/left", "/{left,right}")


def _topics(console: Console, rows: Sequence[tuple[str, str, str]]) -> None:
    """One line each, whatever the width: a topic that is cut cannot be copied."""
    width = max(len(topic) for _, topic, _ in rows)
    for what, topic, kind in rows:
        if topic:
            console.print(f"  {what:10}  {topic:{width}}  {kind}", soft_wrap=True)


def _gains(data: dict[str, Any]) -> list[tuple[str, str]]:
    from dexkit.model_facts import gain_groups

    if "client_gains" not in data:
        return [("its dq", f"{data['client_dq']:g}, and no gains")]
    groups = gain_groups(data)
    texts = [
        f"kp {kp:g} N m/rad, kd {kd:g} N m s/rad" + ("" if len(groups) == 1 else f": {which}")
        for which, kp, kd in groups
    ]
    return list(zip(["its gains", *[""] * len(texts)], texts, strict=False))


def _facts(rows: Sequence[tuple[str, str]]) -> Table:
    from rich.table import Table

    table = Table.grid(padding=(0, 2, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table
