"""Battery, feet, remote control and head of a robot's state."""

from __future__ import annotations

import struct

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.robot import RobotContext, wrong_rows

_STICKS = struct.Struct("<4x5f")  # in wireless_remote, after head and keys


@check("H1-HEAD-01")
def frame_head(ctx: RobotContext) -> Outcome:
    """The frame's first bytes."""
    low = ctx.low
    bad = (low["head"] != (0xFE, 0xEF)).any(axis=1) | (low["level_flag"] != 0xFF)
    if not bad.any():
        return ctx.passed("FE EF FF")
    row = int(np.argmax(bad))
    reported = " ".join(f"{int(v):02X}" for v in (*low["head"][row], low["level_flag"][row]))
    return wrong_rows(ctx, bad, reported, f"head and level_flag are {reported}")


@check("H1-BMS-01")
def battery(ctx: RobotContext) -> Outcome:
    """Charge and voltages."""
    low = ctx.low
    soc, volts = low["bms_state.soc"], low["power_v"]
    cells = low["bms_state.cell_vol"].sum(axis=1) / 1e3
    bad = ~((soc >= 1) & (soc <= 100))
    bad |= ~((volts >= ctx.tolerance("min_v")) & (volts <= ctx.tolerance("max_v")))
    bad |= (cells > 0) & ~(np.abs(cells - volts) <= ctx.tolerance("max_part") * volts)
    row = int(np.argmax(bad))
    reported = f"{soc[row]:.0f} %, {volts[row]:.1f} V"
    if not bad.any():
        return ctx.passed(reported)
    return wrong_rows(ctx, bad, reported, f"{reported}, cells of {cells[row]:.1f} V together")


@check("H1-FOOT-01")
def foot_forces(ctx: RobotContext) -> Outcome:
    """The smallest foot force."""
    force = ctx.low["foot_force"].min(axis=1)
    bad = force < ctx.tolerance("min_force")
    if not bad.any():
        return ctx.passed(f"{force.min(initial=0.0):.0f}")
    return wrong_rows(ctx, bad, f"{force.min():.0f}", f"a foot force of {force.min():.0f}")


@check("H1-REMOTE-01")
def remote(ctx: RobotContext) -> Outcome:
    """The remote's sticks."""
    low = ctx.low
    same = low.constant("wireless_remote")  # constant in most recordings
    values = low["wireless_remote"] if same is None else same
    rows = np.ascontiguousarray(np.nan_to_num(values)).astype(np.uint8)
    kinds, which = np.unique(rows.view(f"V{rows.shape[1]}"), return_inverse=True)
    sticks = np.array([_STICKS.unpack_from(kind.tobytes()) for kind in kinds])
    bad = ~(np.abs(sticks) <= ctx.tolerance("max_stick")).all(axis=1)
    if not bad.any():
        return ctx.passed(f"{np.abs(sticks).max(initial=0.0):.2f}")
    worst = sticks[int(np.argmax(bad))]
    reported = ", ".join(f"{v:.3g}" for v in worst)
    wrong = np.broadcast_to(bad[which.reshape(-1)], len(low))
    return wrong_rows(ctx, wrong, "out of range", f"sticks at {reported}")
