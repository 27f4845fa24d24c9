"""The attitude that the hand or the robot measures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dexkit.conformance.checks import Context, Outcome, check
from dexkit.conformance.checks.robot import RobotContext, wrong_rows
from dexkit.conformance.kit.sums import mean
from dexkit.hand import Floats


def _odd(ctx: Context, quaternions: Floats) -> NDArray[np.bool_]:
    """Which quaternions are neither 0 nor of length 1."""
    norm = np.linalg.norm(quaternions, axis=1)
    return np.asarray((norm != 0.0) & ~(np.abs(norm - 1.0) <= ctx.tolerance("max_error")))


@check("DEX3-IMU-01", rests_on=("attitude",))
def attitude(ctx: Context) -> Outcome:
    """Norm of the quaternion, which may also be all 0."""
    assert ctx.states.columns is not None
    columns = ctx.states.columns
    quaternion = columns.constant("imu_state.quaternion")
    if quaternion is None or _odd(ctx, quaternion).any():
        quaternion = columns["imu_state.quaternion"][columns.ok]
    norm = np.linalg.norm(quaternion, axis=1)
    bad = _odd(ctx, quaternion)
    if bad.any():
        i = int(np.argmax(bad))
        return ctx.failed(
            f"norm {norm[i]:.2f}",
            f"the quaternion's norm is {norm[i]:.3f} in {int(bad.sum())} states",
            ctx.at(ctx.states.topic, float(ctx.states.t[columns.ok][i])),
        )
    if not norm.any():
        return replace(ctx.passed("not filled", "the quaternion is 0: no IMU"), absent=True)
    return ctx.passed("norm 1", f"a norm of {norm.min():.3f} to {norm.max():.3f}")


@check("H1-IMU-01")
def unit_quaternion(ctx: RobotContext) -> Outcome:
    """Length of the quaternion."""
    length = np.linalg.norm(ctx.low["imu_state.quaternion"], axis=1)
    bad = ~(np.abs(length - 1.0) <= ctx.tolerance("tolerance"))
    if not bad.any():
        return ctx.passed(f"{mean(length):.3f}")
    first = float(length[np.argmax(bad)])
    return wrong_rows(ctx, bad, f"{first:.3f}", f"its length is {first:.3f}")


@check("H1-IMU-02")
def same_attitude(ctx: RobotContext) -> Outcome:
    """Compare rpy with the quaternion."""
    low = ctx.low
    w, x, y, z = low["imu_state.quaternion"].T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    off = low["imu_state.rpy"] - np.stack([roll, pitch, yaw]).T
    off = np.abs((off + math.pi) % (2 * math.pi) - math.pi).max(axis=1)
    bad = ~(off <= ctx.tolerance("tolerance_rad"))
    if not bad.any():
        return ctx.passed(f"{off.max(initial=0.0):.3f} rad")
    first = float(off[np.argmax(bad)])
    what = f"rpy and quaternion (read as w, x, y, z) differ by {first:.2f} rad"
    return wrong_rows(ctx, bad, f"{first:.2f} rad", what)


@check("H1-IMU-03")
def measured_gravity(ctx: RobotContext) -> Outcome:
    """Accelerometer and gyroscope before the first command."""
    begin, end = ctx.span(ctx.phases()[0])
    rows = ctx.states.between(begin, end)
    low = ctx.low
    force = np.linalg.norm(low["imu_state.accelerometer"][rows], axis=1)
    turning = np.linalg.norm(low["imu_state.gyroscope"][rows], axis=1)
    if not len(force):
        return ctx.skipped("no state before the first command")
    g, rate = mean(force), mean(turning)
    text = f"{g:.2f} m/s^2 and {rate:.3f} rad/s on average"
    good = ctx.tolerance("low") <= g <= ctx.tolerance("high")
    if good and rate <= ctx.tolerance("max_rad_s"):
        return ctx.passed(f"{g:.2f} m/s^2", text)
    return ctx.failed(f"{g:.2f} m/s^2", text, ctx.at(ctx.states.topic, begin, end))
