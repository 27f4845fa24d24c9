"""A model as plain data, for ``dexkit models --json`` and the page in the docs.

SI units, named in the keys; what a model does not have is ``None`` or an empty list.

A hand::

    {"name", "title", "kind": "hand", "unit": "rad",
     "sides": {"left" | "right": {"vendor_id", "joints": [JOINT], "rest_q_rad": [...]}},
     "dialects": [{"name", "summary", "command_type", "state_type", "touch_type", "length",
                   "q_open_rad", "torque_units_nm": [...],
                   "sides": {"left" | "right": {"command_topic", "state_topic",
                                                "low_rate_topic", "touch_topic",
                                                "first_index"}}}],
     "rates_hz": {"state", "state_at_least", "low_rate_state", "touch", "command"},
     "command_timeout_s", "client_gains": [{"kp_nm_per_rad", "kd_nms_per_rad"}],
     "shared_motors": [[index, ...]],
     "pressure_sensors": [{"packet", "place", "slots": [...]}],
     "tactile_areas": [{"place", "member", "rows", "columns"}],
     "backends": [{"name", "summary", "needs"}]}

A robot::

    {"name", "title", "kind": "robot", "slots", "mode_machine", "weight_slot",
     "joints": [JOINT and "enable_mode", "on_arm_topic"], "rest_q_rad": [...],
     "command_topic", "state_topic", "arm_topic", "command_type", "state_type", "emulator",
     "rates_hz": {"state", "command", "teleop_command"}, "command_timeout_s",
     "client_gains": [...]}

JOINT::

    {"index", "name", "urdf", "q_min_rad", "q_max_rad", "q_min_deg", "q_max_deg",
     "dq_max_rad_s", "tau_max_nm", "closing": -1 | 0 | 1, "gear_ratio"}

``closing`` is the sign of dq that closes the hand, 0 where neither does. ``index`` is the place
in the message; a robot's ``joints`` and ``client_gains`` leave out the slots without a joint, its
``rest_q_rad`` does not. ``client_gains`` are those that xr_teleoperate sends, joint by joint.

A hand whose ``unit`` of q is ``full travel`` has ``travel`` for ``rad`` in these keys, and no
degrees or torques ("q_min_travel", "q_max_travel", "dq_max_travel_s", "rest_q_travel",
"q_open_travel"). One of position servos has no ``client_gains``, but the "client_dq" that it is
sent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from dexkit.backends import list_backends
from dexkit.errors import UsageError
from dexkit.hand import JointSpec, Side
from dexkit.models import MODELS, Dialect, HandModel
from dexkit.robots import ROBOTS, RobotModel

__all__ = [
    "describe",
    "gain_groups",
    "indices",
    "names",
    "short_type",
    "speed",
    "torque_units",
    "width",
]

_OWN = "dexkit "  # the origin of a built-in backend, before its version


def names() -> list[str]:
    """All models: hands, then robots."""
    return [*MODELS, *ROBOTS]


def describe(name: str, *, plugins: bool = True) -> dict[str, Any]:
    """The model called ``name``, hand or robot.

    :param plugins: whether the backends of other packages are listed as well.
    :raises UsageError: there is none.
    """
    if name in MODELS:
        return _hand(MODELS[name], plugins)
    if name in ROBOTS:
        return _robot(ROBOTS[name])
    raise UsageError(f"no model {name!r}", hint=f"known: {', '.join(names())}")


def _hand(model: HandModel, plugins: bool) -> dict[str, Any]:
    return {
        "name": model.name,
        "title": model.title,
        "kind": "hand",
        "unit": model.unit,
        "sides": {
            str(side): {
                "vendor_id": model.vendor_ids.get(side),
                "joints": [
                    _joint(i, joint, model.unit) for i, joint in enumerate(model.joints[side])
                ],
                f"rest_q_{_short(model.unit)}": list(model.rest_q[side]),
            }
            for side in Side
        },
        "dialects": [_dialect(d, model.unit) for d in model.dialects],
        "rates_hz": {
            "state": model.state_rate,
            "state_at_least": model.min_state_rate,
            "low_rate_state": model.dialects[0].low_rate or None,
            "touch": model.dialects[0].touch_rate or None,
            "command": model.command_rate,
        },
        "command_timeout_s": model.command_timeout,
        **_client(model),
        "shared_motors": [list(group) for group in model.motors if len(group) > 1],
        "pressure_sensors": [
            {"packet": i, "place": sensor.place, "slots": list(sensor.slots)}
            for i, sensor in enumerate(model.sensors)
        ],
        "tactile_areas": [
            {"place": a.place, "member": a.member, "rows": a.rows, "columns": a.columns}
            for a in model.dialects[0].areas
        ],
        "backends": _backends(model.name, plugins),
    }


def _robot(model: RobotModel) -> dict[str, Any]:
    return {
        "name": model.name,
        "title": model.title,
        "kind": "robot",
        "slots": model.slots,
        "mode_machine": model.mode_machine,
        "weight_slot": model.weight_slot,
        "joints": [
            {
                **_joint(i, model.joint(i)),
                "enable_mode": model.enable[i],
                "on_arm_topic": i in model.arm_slots,
            }
            for i in model.used
        ],
        "rest_q_rad": list(model.rest_q),
        "command_topic": model.cmd_topic,
        "state_topic": model.state_topic,
        "arm_topic": model.arm_topic,
        "command_type": model.cmd_type,
        "state_type": model.state_type,
        "emulator": f"dexkit emulate {model.name}",
        "rates_hz": {
            "state": model.state_rate,
            "command": model.command_rate,
            "teleop_command": model.teleop_rate,
        },
        "command_timeout_s": model.command_timeout,
        "client_gains": [_gains(*model.client_gains[i]) for i in model.used],
    }


def _client(model: HandModel) -> dict[str, Any]:
    if model.dialects[0].position_servo:
        return {"client_dq": model.client_command.dq}
    return {"client_gains": [_gains(*pair) for pair in model.gains]}


def _short(unit: str) -> str:
    """A unit in a key: ``travel``."""
    return unit.rpartition(" ")[2]


def _joint(index: int, joint: JointSpec, unit: str = "rad") -> dict[str, Any]:
    short = _short(unit)
    degrees = {
        "q_min_deg": round(math.degrees(joint.q_min), 2),
        "q_max_deg": round(math.degrees(joint.q_max), 2),
    }
    return {
        "index": index,
        "name": joint.name,
        "urdf": joint.urdf or None,
        f"q_min_{short}": joint.q_min,
        f"q_max_{short}": joint.q_max,
        **(degrees if unit == "rad" else {}),
        f"dq_max_{short}_s": joint.dq_max,
        **({"tau_max_nm": joint.tau_max} if unit == "rad" else {}),
        "closing": joint.closing,
        "gear_ratio": joint.gear_ratio,
    }


def _gains(kp: float, kd: float) -> dict[str, float]:
    return {"kp_nm_per_rad": kp, "kd_nms_per_rad": kd}


def _dialect(dialect: Dialect, unit: str) -> dict[str, Any]:
    return {
        "name": dialect.name,
        "summary": dialect.summary,
        "command_type": dialect.cmd_type,
        "state_type": dialect.state_type,
        "touch_type": dialect.touch_type or None,
        "length": dialect.length,
        f"q_open_{_short(unit)}": dialect.q_open if math.isfinite(dialect.q_open) else None,
        "torque_units_nm": list(dialect.torque_units),
        "sides": {
            str(side): {
                "command_topic": dialect.topics(side)[0],
                "state_topic": dialect.topics(side)[1],
                "low_rate_topic": dialect.low_rate_topic.format(side=side) or None,
                "touch_topic": dialect.touch_topic_of(side) or None,
                "first_index": dialect.index[side],
            }
            for side in Side
        },
    }


def _backends(model: str, plugins: bool) -> list[dict[str, str]]:
    return [
        {"name": row.name, "summary": row.backend.summary, "needs": row.backend.needs}
        for row in list_backends()
        if row.backend is not None
        and row.backend.model == model
        and (plugins or row.origin.startswith(_OWN))
    ]


# -- as text, in the terminal and on the page -----------------------------------------------


def indices(values: Sequence[int]) -> str:
    """Indices as text, neighbours together: ``0 to 4, 6``."""
    runs: list[list[int]] = []
    for value in values:
        if runs and value == runs[-1][-1] + 1:
            runs[-1].append(value)
        else:
            runs.append([value])
    return ", ".join(f"{r[0]} to {r[-1]}" if len(r) > 2 else ", ".join(map(str, r)) for r in runs)


def width(joint: dict[str, Any]) -> tuple[float, float]:
    """Least and greatest q of a described joint, in its unit."""
    names = [name for name in joint if name.startswith(("q_min_", "q_max_"))]
    return joint[names[0]], joint[names[1]]


def speed(joint: dict[str, Any]) -> float:
    """The highest speed of a described joint, in its unit a second."""
    found: float = next(v for name, v in joint.items() if name.startswith("dq_max_"))
    return found


def gain_groups(data: dict[str, Any]) -> list[tuple[str, float, float]]:
    """(which joints, kp, kd) of a described model; joints of equal gains together."""
    joints = data["joints"] if data["kind"] == "robot" else data["sides"]["left"]["joints"]
    groups: dict[tuple[float, float], list[int]] = {}
    for joint, gains in zip(joints, data["client_gains"], strict=True):
        pair = (gains["kp_nm_per_rad"], gains["kd_nms_per_rad"])
        groups.setdefault(pair, []).append(joint["index"])
    return [(indices(group), kp, kd) for (kp, kd), group in groups.items()]


def torque_units(dialect: dict[str, Any]) -> list[tuple[str, float]]:
    """(which joints, N·m in a unit of their torques) of a described dialect, none if all are 1."""
    groups: dict[float, list[int]] = {}
    for i, unit in enumerate(dialect["torque_units_nm"]):
        groups.setdefault(unit, []).append(i)
    return [(indices(group), unit) for unit, group in groups.items()]


def short_type(name: str) -> str:
    """A DDS type without its inner namespaces: ``unitree_hg HandCmd_``."""
    return name.replace("::msg::dds_::", " ")
