"""An operator at the hand, through the model of Unitree's teleoperation client: a closed loop.

In all other phases the commands do not depend on the hand's answers. Here they depend on the
states, as with the genuine client: a hand whose state is late is commanded slowly. The operator's
motion is the profile ``check`` of :mod:`dexkit.teleop.profiles`, kept clear of an object; the
phase's parameters are enough to compute the operator's goal at any time (:func:`operator_of`).

The client gets the newest state each time its receiving thread would have read one. That a silent
side stops the other's states, too, is not part of this phase.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.stimulus_record import Phase
from dexkit.conformance.stimuli.script import Plan, Script, Send, Steps
from dexkit.hand import Side
from dexkit.models import Dialect
from dexkit.teleop import Operator, client_for, profile

if TYPE_CHECKING:
    pass

__all__ = ["OPERATOR", "operate", "operator_of"]

OPERATOR = "operator"
"""Name of the phase."""
PROFILE = "check"
_CLEAR = 0.1  # of the stroke: room left to the object
_DEEPEST = 0.5  # how far the profile closes a hand of several joints
_POLL = 0.001  # s between two reads while the client waits for a state


def _most(plan: Plan[Side], side: Side) -> float:
    """Largest closing of a side, 0 to 1, for :class:`~dexkit.teleop.Operator`."""
    touch = plan.objects.get(side)
    if touch is None:
        return 1.0
    if not plan.dialect.is_gripper:  # percent of closing
        return min(1.0, max(0.0, (touch / 100 - _CLEAR) / _DEEPEST))
    return min(1.0, max(0.0, 1.0 - touch / plan.dialect.q_open - _CLEAR))


def operator_of(phase: Phase, dialect: Dialect) -> Operator:
    """The operator of a phase, from its parameters in the recording."""
    hands = [s for s in phase.sides if isinstance(s, Side)]
    most = {s: float(phase.params.get(f"most_{s}", 1.0)) for s in hands}
    return Operator(profile(phase.params["profile"], dialect.model), dialect, most=most)


def operate(script: Script[Side], codec: MotorCodec) -> Steps:
    """Play the phase ``operator``: Unitree's client in a closed loop with the hand."""
    plan = script.plan
    if not plan.dialect.has_client:
        return  # no client of Unitree's speaks it, and none of the requirements applies
    script._report("an operator at Unitree's client: full strokes, steps, slow motion")
    phase = script._begin(OPERATOR, plan.sides, profile=PROFILE)
    phase.params.update({f"most_{s}": f"{_most(plan, s):.6g}" for s in plan.sides})
    operator = operator_of(phase, plan.dialect)
    client = client_for(plan.dialect, plan.sides)
    period = round(1e9 * client.period)
    tick = begin = script._obs.now_ns

    def receive() -> float:
        now, q = (script._obs.now_ns - begin) / 1e9, script._obs.q
        client.receive(now, {s: q[s] for s in plan.sides if s in q})
        return now

    while script._elapsed(phase) < operator.profile.duration:
        now = receive()
        commands = client.step(now, {}, operator.inputs(now, plan.sides))
        payloads = codec.encode(
            {s: [Motor(**m._asdict()) for m in motors] for s, motors in commands.items()}
        )
        # the next turn, without making up for turns that were missed
        tick = max(tick + period, script._obs.now_ns)
        while True:
            wakes = max(client.receiver.wakes_at, now + _POLL)
            wake = tick if math.isinf(wakes) else min(tick, begin + round(wakes * 1e9))
            yield from script._do(Send(payloads, wake))
            payloads = []
            if script._obs.now_ns >= tick:
                break
            now = receive()
    script._end(phase)
    script._next_ns = script._obs.now_ns
    last = script._obs.q
    script._goal.update({s: last[s] for s in plan.sides if s in last})
