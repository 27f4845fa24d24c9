"""CRCs of frames, packets and messages."""

from __future__ import annotations

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.robot import RobotContext, wrong_rows


@check("H1-CRC-01")
def state_crc(ctx: RobotContext) -> Outcome:
    """The CRC of every state."""
    intact = ctx.recording.intact
    if intact.all():
        return ctx.passed("right", f"{len(intact)} states")
    crc = ctx.low["crc"]
    outcome = wrong_rows(ctx, ~intact, f"{int((~intact).sum())} wrong", "the CRC is wrong")
    return outcome.because("The field is never set.") if not np.any(crc > 0) else outcome
