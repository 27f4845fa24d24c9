"""Samples of hands for the collector and the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from dexkit.hand import Side
from dexkit.messages import message_type, unitree_hg
from dexkit.models import DEX3_1
from dexkit.watch import Collector

ORIGIN = 1_700_000_000_000_000_000
STATE = "unitree_hg::msg::dds_::HandState_"
COMMAND = "unitree_hg::msg::dds_::HandCmd_"


def ns(seconds: float) -> int:
    return ORIGIN + round(seconds * 1e9)


def dex3_state(
    q: Sequence[float], faults: dict[int, int] | None = None, pressure: float = 0.0
) -> bytes:
    motors = [
        unitree_hg.MotorState_(mode=0x10 | i, q=value, tau_est=0.1 * i, temperature=(30 + i, 0))
        for i, value in enumerate(q)
    ]
    for joint, bits in (faults or {}).items():
        motors[joint].motorstate = bits
    sensors = [unitree_hg.PressSensorState_(pressure=(pressure,) * 12) for _ in DEX3_1.sensors]
    return message_type(STATE).encode(unitree_hg.HandState_(motors, sensors, power_v=24.0))


def dex3_command(q: Sequence[float], status: int = 1) -> bytes:
    motors = [
        unitree_hg.MotorCmd_(mode=status << 4 | i, q=value, kp=1.5) for i, value in enumerate(q)
    ]
    return message_type(COMMAND).encode(unitree_hg.HandCmd_(motors))


def half_closed(side: Side, part: float) -> list[float]:
    """Positions of a Dex3-1, from open to closed."""
    out = []
    for joint in DEX3_1.joints[side]:
        end = joint.q_max if joint.closing > 0 else joint.q_min
        out.append(part * end if joint.closing else 0.0)
    return out


def closing_hands(
    duration: float = 4.0,
    rate: float = 100.0,
    faults: Callable[[float], dict[int, int]] = lambda t: {},
    most: int | None = None,
) -> Collector:
    """Two Dex3-1 that close and open, with commands, as a recording."""
    collector = Collector(most)
    times = [i / rate for i in range(int(duration * rate))]
    for side in Side:
        states, commands = [], []
        for t in times:
            part = 0.45 - 0.4 * math.cos(2 * math.pi * t / duration)
            bits = faults(t) if side is Side.RIGHT else {}
            states.append(dex3_state(half_closed(side, part), bits, pressure=part * 1e4))
            commands.append(dex3_command(half_closed(side, min(1.0, part + 0.1))))
        stamps = [ns(t) for t in times]
        for payloads, kind, type_name in ((states, "state", STATE), (commands, "cmd", COMMAND)):
            collector.take(f"rt/dex3/{side}/{kind}", type_name, payloads, stamps, stamps)
    return collector
