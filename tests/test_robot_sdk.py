"""Unitree's C++ SDK drives the emulated H1 and G1: its commands are obeyed, the states right.

The SDK checks the CRC of each state and drops those where it is wrong, and gives its own to each
command; see :mod:`tests.cpp_sdk` for how it stays on loopback and on a domain of its own.
"""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from dexkit.dds import DdsNode
from dexkit.emulators.robot import EmulatedRobot, Remote, Settings
from dexkit.robots import G1, H1, RobotModel
from tests.cpp_sdk import CppSdk
from tests.dds_helpers import dds_domain, wait_until

__all__ = ["dds_domain"]

if find_spec("unitree_interface") is None:
    pytest.skip("needs the far-unitree-sdk package", allow_module_level=True)

H1_MOTORS = 19  # of 20: the binding leaves out the last slot, the left elbow


def positions(model: RobotModel, motors: int, by: float) -> list[float]:
    """The rest position of every joint, moved by so much toward the middle of its range."""
    q = []
    for slot in range(motors):
        joint, rest = model.joints[slot], model.rest_q[slot]
        middle = 0.0 if joint is None else 0.5 * (joint.q_min + joint.q_max)
        q.append(rest + (by if middle >= rest else -by))
    return q


@pytest.mark.slow
def test_unitree_sdk_moves_the_emulated_h1(
    dds_domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with DdsNode(dds_domain) as node, CppSdk("h1", dds_domain) as sdk:
        with EmulatedRobot(H1, node=node) as robot:
            robot.robot.remote = Remote.parse("A,L2,lx=0.5,ry=-0.25")
            first = sdk.wait(lambda s: any(s["q"]))
            assert first["q"] == pytest.approx(H1.rest_q[:H1_MOTORS])
            assert first["quat"] == [1, 0, 0, 0]
            assert first["accel"] == pytest.approx([0, 0, 9.81])
            assert first["temperature"][0] == 30
            assert first["temperature"][9] == 0  # no motor there

            # The binding sends mode 1 to all motors. An H1's weak motors take that, its strong
            # ones do not: only ankles and arms follow.
            goal = positions(H1, H1_MOTORS, 0.2)
            weak = [slot for slot in H1.used if slot < H1_MOTORS and H1.enable[slot] == 1]
            strong = [slot for slot in H1.used if slot < H1_MOTORS and H1.enable[slot] != 1]
            gains = {"kp": [100.0] * H1_MOTORS, "kd": [3.0] * H1_MOTORS}
            sdk.command(q=goal, **gains)
            there = sdk.wait(lambda s: all(abs(s["q"][i] - goal[i]) < 0.01 for i in weak))
            assert [there["q"][i] for i in strong] == pytest.approx(
                [H1.rest_q[i] for i in strong], abs=1e-6
            )
            assert robot.robot.counters.wrong_mode > 0

            held = robot.robot.remote_message()
            remote = sdk.wait(lambda r: r["keys"], sdk.remote)
            assert remote == {n: getattr(held, n) for n in ("lx", "ly", "rx", "ry", "keys")}
            assert (remote["keys"], remote["lx"], remote["ry"]) == (1 << 8 | 1 << 5, 0.5, -0.25)

            # a torque on top of the position's
            tau = [0.0] * H1_MOTORS
            tau[12] = 20.0
            sdk.command(q=goal, tau=tau, **gains)
            sdk.wait(lambda s: s["q"][12] > goal[12] + 0.15)
            counters = robot.robot.counters
            assert (counters.bad_crc, counters.malformed, counters.bad_number) == (0, 0, 0)

        # a robot that takes any mode byte: all that the binding commands moves
        with EmulatedRobot(H1, node=node, settings=Settings(lenient=True)) as robot:
            used = [*strong, *weak]
            sdk.command(q=goal, **gains)
            sdk.wait(lambda s: all(abs(s["q"][i] - goal[i]) < 0.02 for i in used))
            assert robot.robot.counters.wrong_mode == 0
        # what it would have said of a wrong CRC
        assert "CRC Error" not in "".join(capfd.readouterr())
        good = robot.robot.state(0.0)
        spoiled = good[:-1] + bytes([good[-1] ^ 1])
        with node.writer(H1.state_topic, H1.state_type) as writer:
            wait_until(
                lambda: writer.write_raw(spoiled) and "CRC Error" in "".join(capfd.readouterr())
            )


def test_unitree_sdk_moves_the_emulated_g1(
    dds_domain: int, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        DdsNode(dds_domain) as node,
        CppSdk("g1", dds_domain) as sdk,
        EmulatedRobot(G1, node=node) as robot,
    ):
        motors = len(G1.used)
        first = sdk.wait(lambda s: any(s["q"]))
        assert first["q"] == pytest.approx(G1.rest_q[:motors])
        assert first["mode_machine"] == G1.mode_machine
        assert first["voltage"] == pytest.approx([robot.robot.supply.voltage] * motors, rel=1e-3)

        goal = positions(G1, motors, 0.2)
        sdk.command(q=goal)  # with the gains that the SDK has for a G1
        sdk.wait(lambda s: s["q"] == pytest.approx(goal, abs=0.02))
        back = positions(G1, motors, 0.05)
        sdk.command(q=back)
        sdk.wait(lambda s: s["q"] == pytest.approx(back, abs=0.02))

        # torque alone, on a joint that no gain holds: it turns until its stop holds it
        elbow = G1.slot("left_elbow")
        kp, kd, tau = [40.0] * motors, [1.0] * motors, [0.0] * motors
        kp[elbow] = kd[elbow] = 0.0
        tau[elbow] = 3.0
        sdk.command(q=back, kp=kp, kd=kd, tau=tau)
        top = G1.joint(elbow).q_max
        state = sdk.wait(lambda s: s["q"][elbow] == pytest.approx(top) and s["dq"][elbow] == 0)
        assert state["tau_est"][elbow] == pytest.approx(3.0)

        counters = robot.robot.counters
        wait_until(lambda: counters.commands > 100)
        assert counters.bad_crc == counters.bad_machine == counters.wrong_mode == 0
    assert "CRC Error" not in "".join(capfd.readouterr())
