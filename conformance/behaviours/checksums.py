"""CRCs of frames, packets and messages."""

from __future__ import annotations

from functools import partial

import numpy as np

from dexkit.conformance.checks import Outcome, check
from dexkit.conformance.checks.robot import RobotContext, wrong_rows
from dexkit.conformance.kit.robot import WRONG_CRCS
from dexkit.conformance.stimuli.phases import Place, stimulus
from dexkit.conformance.stimuli.robot import RobotScript
from dexkit.conformance.stimuli.script import Steps
from dexkit.conformance.usb.context import UsbContext, all_frames


@stimulus("wrong-crc", RobotScript, after="off", leaves=Place.AWAY)
def send_wrong_crcs(script: RobotScript) -> Steps:
    """A goal elsewhere, with wrong CRCs; their kind is ``params["kind"]``."""
    script.report("commands that are wrong: nothing may move")
    for kind in WRONG_CRCS:
        order = script.wish()
        yield from script.bad("wrong-crc", partial(script.put, order, kind), 0.25, kind=kind)


@check("H1-CRC-01")
def state_crc(ctx: RobotContext) -> Outcome:
    """The CRC of every state."""
    intact = ctx.recording.intact
    if intact.all():
        return ctx.passed("right", f"{len(intact)} states")
    crc = ctx.low["crc"]
    outcome = wrong_rows(ctx, ~intact, f"{int((~intact).sum())} wrong", "the CRC is wrong")
    return outcome.because("The field is never set.") if not np.any(crc > 0) else outcome


# ---------------------------------------------------------------------------------------- USB


@check("DEX3USB-CRC-01")
def _frame_crc(c: UsbContext) -> Outcome:
    return all_frames(c, lambda a: a.reading.crc_right, "a wrong CRC")


@check("DEX3USB-CRC-02")
def _motor_crc(c: UsbContext) -> Outcome:
    if not any(a.reading.motors for a in c.hand.answers):
        return c.skipped("no motor packet came")
    return all_frames(
        c, lambda a: all(m.intact for m in a.reading.motors), "a damaged motor packet"
    )


@check("DEX3USB-CRC-03")
def _sensor_crc(c: UsbContext) -> Outcome:
    if not any(a.reading.sensors for a in c.hand.answers):
        return c.skipped("no sensor packet came")
    return all_frames(
        c, lambda a: all(s.intact for s in a.reading.sensors), "a damaged sensor packet"
    )
