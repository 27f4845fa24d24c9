"""State topics other than a Dex hand's that Unitree's clients wait for, and who publishes them.

From xr_teleoperate up to 1.5, the examples of unitree_sdk2 and unitree_sdk2_python, LeRobot and
unitree_lerobot (docs/sources/unitree-dex.md#a9).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

__all__ = ["AWAITED", "Awaited", "awaited"]

_GO, _HG = "unitree_go::msg::dds_::", "unitree_hg::msg::dds_::"
_STRING = "std_msgs::msg::dds_::String_"


@dataclass(frozen=True)
class Awaited:
    """One state topic.

    :param types: DDS types that it has, by robot; a client of one does not match the other.
    :param publisher: who publishes it.
    :param simulation: it comes from a simulator only, so on domain 1 and never from a robot.
    :param emulators: commands of dexkit that publish it.
    :param clients: who waits for it.
    """

    topic: str
    types: tuple[str, ...]
    publisher: str
    simulation: bool = False
    emulators: tuple[str, ...] = ()
    clients: str = ""


_BODY = "the robot itself (its motor control runs from power-up)"
_SPORT = "the robot's motion service (sport mode)"
_FTP = "Inspire's driver for the RH56DFTP (one process a hand)"
_BRAINCO = "Unitree's brainco_hand_service"

_ALL = (
    Awaited(
        "rt/lowstate",
        (_HG + "LowState_", _GO + "LowState_"),
        _BODY,
        emulators=("dexkit emulate g1", "dexkit emulate h1"),
        clients="xr_teleoperate, unitree_lerobot, LeRobot, the SDK's examples",
    ),
    Awaited(
        "rt/lf/lowstate",
        (_HG + "LowState_", _GO + "LowState_"),
        _BODY,
        clients="an example of the Python SDK",
    ),
    Awaited(
        "rt/secondary_imu",
        (_HG + "IMUState_",),
        "the torso's IMU of a G1, H2 or R1",
        clients="the SDK's low-level examples",
    ),
    Awaited(
        "rt/sportmodestate", (_GO + "SportModeState_",), _SPORT, clients="the SDK's Go2 examples"
    ),
    Awaited(
        "rt/lf/sportmodestate",
        (_GO + "SportModeState_",),
        _SPORT,
        clients="the SDK's examples for A2, As2, Go2 and Go2-W",
    ),
    Awaited(
        "rt/wirelesscontroller",
        (_GO + "WirelessController_",),
        "the robot, while its remote control is on",
        emulators=("dexkit emulate g1", "dexkit emulate h1"),
        clients="the SDK's joystick example",
    ),
    Awaited(
        "rt/audio_msg",
        (_STRING,),
        "the robot's voice service",
        clients="the SDK's audio examples",
    ),
    Awaited(
        "rt/hispeed_state",
        ("geometry_msgs::msg::dds_::Point32_",),
        "the column of a G1-D",
        clients="the SDK's G1-D height example",
    ),
    Awaited(
        "rt/inspire/state",
        (_GO + "MotorStates_",),
        "Unitree's service for the Inspire RH56DFX (both hands in one message)",
        clients="xr_teleoperate --ee=inspire_dfx (inspire1 before 1.3), unitree_lerobot",
    ),
    *(
        Awaited(
            f"rt/inspire_hand/{what}/{side}",
            (f"inspire::inspire_hand_{what}",),
            _FTP,
            clients="xr_teleoperate --ee=inspire_ftp",
        )
        for what in ("state", "touch")
        for side in ("l", "r")
    ),
    *(
        Awaited(
            f"rt/brainco/{side}/state",
            (_GO + "MotorStates_",),
            _BRAINCO,
            clients="xr_teleoperate --ee=brainco, unitree_lerobot",
        )
        for side in ("left", "right")
    ),
    Awaited(
        "rt/sim_state",
        (_STRING,),
        "Unitree's simulator (unitree_sim_isaaclab)",
        simulation=True,
        clients="xr_teleoperate --sim, unitree_lerobot",
    ),
    Awaited(
        "rt/rewards_state",
        (_STRING,),
        "Unitree's simulator (unitree_sim_isaaclab)",
        simulation=True,
        clients="unitree_lerobot",
    ),
)

AWAITED: dict[str, Awaited] = {one.topic: one for one in _ALL}
"""By topic."""


def awaited(topics: Iterable[str]) -> list[Awaited]:
    """Those of some topics that are known, in the order of :data:`AWAITED`."""
    wanted = set(topics)
    return [one for one in _ALL if one.topic in wanted]
