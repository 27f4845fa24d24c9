"""The Dex family as data: joints, topics, types, rates, time-outs, per side and dialect.

Every other module takes these facts from here. Sources are sections of the fact sheet
"Unitree Dex" (F) and the DDS interface specification (seed 000).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.hand import HandSpec, JointSpec, Side

__all__ = ["DEX1_1", "DIALECTS", "MODELS", "Dialect", "HandModel", "dialect", "model"]


@dataclass(frozen=True)
class Dialect:
    """How a hand model appears on DDS.

    :param cmd_topic: command topic; ``{side}`` is replaced by ``left`` or ``right``.
    :param cmd_type: DDS type name of the command.
    :param index: position of a side's motor in the sequence (all 0 unless both share a topic).
    :param length: motors in the sequence, for a one-joint hand.
    :param q_open: q of a fully open gripper, rad; 0 is closed.
    """

    name: str
    model: str
    cmd_topic: str
    state_topic: str
    cmd_type: str
    state_type: str
    index: dict[Side, int]
    length: int
    q_open: float
    summary: str

    def topics(self, side: Side) -> tuple[str, str]:
        """(command topic, state topic) of a side."""
        return self.cmd_topic.format(side=side), self.state_topic.format(side=side)


@dataclass(frozen=True)
class HandModel:
    """One model of the family.

    :param state_rate: Hz at which the vendor's service publishes state.
    :param min_state_rate: Hz below which clients suffer.
    :param command_rate: Hz at which xr_teleoperate sends commands.
    :param command_timeout: seconds without a command after which the vendor's service brakes.
    :param vendor_ids: motor ids on the vendor's bus.
    """

    name: str
    title: str
    joints: dict[Side, tuple[JointSpec, ...]]
    dialects: tuple[Dialect, ...]
    state_rate: float
    min_state_rate: float
    command_rate: float
    command_timeout: float
    vendor_ids: dict[Side, int]

    def spec(
        self,
        side: Side,
        *,
        io_rate: float,
        exchange_timeout: float = 0.1,
        simulated: bool = False,
    ) -> HandSpec:
        """The specification of a hand of this model."""
        return HandSpec(
            model=self.name,
            side=side,
            joints=self.joints[side],
            io_rate=io_rate,
            exchange_timeout=exchange_timeout,
            simulated=simulated,
        )


# F B.3: 0 closed, rising q opens, 5.4 rad = 9 cm of jaw travel; closing is toward smaller q.
# dq_max: two jaws at 0.2 m/s would need 24 rad/s (F B.3, derived; the real limit is uncertain).
# tau_max: 20 N a jaw x 2 jaws x 0.09 m / 5.4 rad = 0.67 N m at the URDF's effort limit; the
# recordings reach kp * 0.18 = 0.9 N m, and vendor clients feed forward at most a few N m. 15 is
# what the vendor library clamps to (F G, rotor side), so nothing a client sends is cut short.
_DEX1_JOINT = JointSpec("gripper", q_min=0.0, q_max=5.4, dq_max=24.0, tau_max=15.0, closing=-1)

DIALECTS: dict[str, Dialect] = {
    d.name: d
    for d in (
        Dialect(
            name="unitree_go",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=5.4,
            summary="xr_teleoperate and the vendor's dex1_1_service: 0 closed .. 5.4 rad open",
        ),
        Dialect(
            name="unitree_hg",
            model="dex1-1",
            cmd_topic="rt/dex1/{side}/cmd",
            state_topic="rt/dex1/{side}/state",
            cmd_type="unitree_hg::msg::dds_::HandCmd_",
            state_type="unitree_hg::msg::dds_::HandState_",
            index={Side.LEFT: 0, Side.RIGHT: 0},
            length=1,
            q_open=2 * math.pi,
            summary="the DDS interface specification (seed 000): 0 closed .. 2 pi rad open",
        ),
        Dialect(
            name="unitree_actuator",
            model="dex1-1",
            cmd_topic="rt/unitree_actuator/cmd",
            state_topic="rt/unitree_actuator/state",
            cmd_type="unitree_go::msg::dds_::MotorCmds_",
            state_type="unitree_go::msg::dds_::MotorStates_",
            # F A.1: 0 is the right gripper, whatever XR11's enum says
            index={Side.LEFT: 1, Side.RIGHT: 0},
            length=2,
            q_open=5.4,
            summary="xr_teleoperate v1.1: both grippers in one message, 0 right, 1 left",
        ),
    )
}

DEX1_1 = HandModel(
    name="dex1-1",
    title="Dex1-1 gripper",
    joints={Side.LEFT: (_DEX1_JOINT,), Side.RIGHT: (_DEX1_JOINT,)},
    dialects=tuple(d for d in DIALECTS.values() if d.model == "dex1-1"),
    state_rate=500.0,  # F B.2: 2000 us loop
    min_state_rate=200.0,  # F D conflict 7; seed 000 "200+ Hz"
    command_rate=200.0,  # F B.1
    command_timeout=1.0,  # F B.2: timeout_ms_ = 1000
    vendor_ids={Side.LEFT: 1, Side.RIGHT: 0},  # F B.2
)

MODELS: dict[str, HandModel] = {DEX1_1.name: DEX1_1}


def model(name: str) -> HandModel:
    """The model called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return MODELS[name]
    except KeyError:
        raise UsageError(f"no hand model {name!r}", hint=f"known: {', '.join(MODELS)}") from None


def dialect(name: str) -> Dialect:
    """The dialect called ``name``.

    :raises UsageError: there is none.
    """
    try:
        return DIALECTS[name]
    except KeyError:
        raise UsageError(f"no dialect {name!r}", hint=f"known: {', '.join(DIALECTS)}") from None
