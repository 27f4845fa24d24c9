"""Tell from motion in which order a Dex3-1's session has its middle and index finger.

Both fingers have the same joints and limits, so that positions alone never say which is which, and
public programs of real hands disagree about the right hand (docs/dex3.md). What motion can say is
whether states are in the order of the commands: a hand or a recorder that has another order than
its client moves the other finger.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from dexkit.hand import Floats, Side
from dexkit.models import HandModel, model
from dexkit.topics import roles
from dexkit.traces.reader import Trace
from dexkit.traces.sessions.streams import COMMAND, HAND, Stream, streams_of

__all__ = ["Order", "OrderFound", "finger_order", "finger_orders", "like_fingers"]

_APART = 0.2  # rad RMS by which the fingers' commands must differ
_CLEARER = 3.0  # how many times better one order must fit than the other


class Order(str, Enum):
    """What motion says about the order of states and commands."""

    SAME = "same"
    EXCHANGED = "exchanged"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class OrderFound:
    """The order, and why.

    :param text: a sentence for the user, with the figures.
    """

    order: Order
    text: str


def like_fingers(hand: HandModel) -> tuple[list[int], list[int]] | None:
    """The joints of the two fingers that positions cannot tell apart; None where there are not just
    two: their joints have the same limits.
    """
    fingers: dict[str, list[int]] = {}
    joints = hand.joints[Side.LEFT]
    for i, joint in enumerate(joints):
        fingers.setdefault(joint.name.partition("_")[0], []).append(i)
    alike: dict[tuple[tuple[float, float], ...], list[list[int]]] = {}
    for found in fingers.values():
        limits = tuple((joints[i].q_min, joints[i].q_max) for i in found)
        alike.setdefault(limits, []).append(found)
    several = [f for f in alike.values() if len(f) > 1]
    return (several[0][0], several[0][1]) if list(map(len, several)) == [2] else None


def finger_order(
    fingers: tuple[list[int], list[int]],
    command_t: Floats,
    command_q: Floats,
    state_t: Floats,
    state_q: Floats,
) -> OrderFound:
    """Compare states with commands, and with commands whose two fingers are exchanged.

    :param fingers: their joints (:func:`like_fingers`).
    :param command_t: seconds, ascending, shape (n,); ``command_q`` rad, shape (n, 7); likewise the
        states.
    """
    if len(command_t) < 2 or len(state_t) < 2:
        return OrderFound(Order.UNKNOWN, "cannot be told: there are no commands and states")
    within = (state_t >= command_t[0]) & (state_t <= command_t[-1])
    asked = np.stack([np.interp(state_t[within], command_t, q) for q in command_q.T], axis=1)
    seen = state_q[within]
    whole = np.isfinite(asked).all(axis=1) & np.isfinite(seen).all(axis=1)
    asked, seen = asked[whole], seen[whole]
    first, second = fingers
    if not len(seen) or _rms(asked[:, first] - asked[:, second]) < _APART:
        return OrderFound(
            Order.UNKNOWN, "cannot be told: middle and index finger are commanded alike"
        )
    own = _rms(asked[:, first + second] - seen[:, first + second])
    other = _rms(asked[:, second + first] - seen[:, first + second])
    figures = f"{own:.2f} rad from the commands, {other:.2f} from those with the fingers exchanged"
    if own * _CLEARER < other:
        return OrderFound(
            Order.SAME,
            f"states are in the order of the commands ({figures}); which finger is which, motion "
            "cannot tell",
        )
    if other * _CLEARER < own:
        return OrderFound(
            Order.EXCHANGED,
            f"states and commands have middle and index finger in different order ({figures}): "
            "the client, the hand or the recorder takes one for the other",
        )
    return OrderFound(Order.UNKNOWN, f"cannot be told: the hand follows neither order ({figures})")


def finger_orders(trace: Trace) -> dict[str, OrderFound]:
    """What motion says about each hand with two like fingers, by part (``right_hand``)."""
    topics = [
        c.topic
        for c in trace.channels
        if c.message_count
        and any(like_fingers(model(r.dialect.model)) for r in roles(c.topic, c.type_name))
    ]
    parts: dict[str, dict[str, Stream]] = {}
    for stream in streams_of(trace, topics) if topics else []:
        if stream.model and stream.part.endswith(HAND):
            parts.setdefault(stream.part, {}).setdefault(stream.kind, stream)
    found = {}
    for part, kinds in parts.items():
        fingers = like_fingers(model(next(iter(kinds.values())).model))
        if fingers is not None and len(kinds) > 1:
            state = next(s for kind, s in kinds.items() if kind != COMMAND)
            command = kinds[COMMAND]
            begin = int(command.times_ns[0])
            found[part] = finger_order(
                fingers,
                (command.times_ns - begin) / 1e9,
                command.q,
                (state.times_ns - begin) / 1e9,
                state.q,
            )
    return found


def _rms(away: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(away))))
