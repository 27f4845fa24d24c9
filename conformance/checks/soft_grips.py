"""Grips with another stiffness than the client's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dexkit.conformance.checks import Context
from dexkit.conformance.kit.median import median
from dexkit.models import HandModel


@dataclass(frozen=True)
class _Grip:
    """The end of a grip with another stiffness than the client's.

    :param tau: median abs(tau_est), N m.
    :param asked: the torque that its command asks for, N m.
    """

    tau: float
    asked: float
    kp: float
    begin: float
    end: float

    @property
    def part(self) -> float:
        """Its torque relative to the commanded one."""
        return self.tau / self.asked


def soft_grips_of(ctx: Context) -> list[_Grip]:
    """The soft grips that ask for enough torque to tell."""
    found = []
    for phase in ctx.phases("soft-grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.3)
        given = ctx.given(begin, end)
        tau, q = np.abs(ctx.tau(begin, end)[:, 0]), ctx.q(begin, end)[:, 0]
        if not given.any() or not (np.isfinite(tau) & np.isfinite(q)).any():
            continue
        kp = median(ctx.commands.kp[given, 0])
        asked = kp * (median(q) - median(ctx.commands.q[given, 0]))
        if asked >= ctx.tolerance("min_asked_nm"):
            found.append(_Grip(median(tau), asked, kp, begin, end))
    return found


def softer_grips(ctx: Context) -> list[_Grip]:
    """Those with less stiffness than the client's; with more, a coarse goal has a large effect."""
    hand = ctx.recording.model
    assert isinstance(hand, HandModel)  # a robot grips nothing
    return [grip for grip in soft_grips_of(ctx) if grip.kp < hand.gains[0][0]]


def usual_part(ctx: Context) -> float | None:
    """The force of a grip with the client's stiffness, relative to the commanded one."""
    stiff = []
    for phase in ctx.phases("grip"):
        begin, end = ctx.span(phase)
        begin = max(begin, end - 0.5)
        given = ctx.given(begin, end)
        if given.any() and len(ctx.q(begin, end)):
            away = median(ctx.q(begin, end)[:, 0]) - median(ctx.commands.q[given, 0])
            wanted = median(ctx.commands.kp[given, 0]) * away
            if wanted >= ctx.tolerance("min_asked_nm"):
                stiff.append(median(np.abs(ctx.tau(begin, end)[:, 0])) / wanted)
    return min(stiff) if stiff else None
