"""Bend two fingers of a Dex3-1 with Unitree's SDK: python move_dex3.py left 1 lo"""

import sys
import time

from unitree_sdk2py.core.channel import (
    ChannelFactoryInitialize,
    ChannelPublisher,
    ChannelSubscriber,
)
from unitree_sdk2py.idl.default import unitree_hg_msg_dds__HandCmd_
from unitree_sdk2py.idl.unitree_hg.msg.dds_ import HandCmd_, HandState_

side, domain, interface = sys.argv[1:]
ChannelFactoryInitialize(int(domain), interface)
states = ChannelSubscriber(f"rt/dex3/{side}/state", HandState_)
states.Init()
commands = ChannelPublisher(f"rt/dex3/{side}/cmd", HandCmd_)
commands.Init()
begin = [motor.q for motor in states.Read().motor_state]  # waits for the hand
bend = -0.8 if side == "left" else 0.8  # rad; fingers close toward negative q on the left
goal = begin[:3] + [bend] * 4  # the thumb's three joints stay, then middle and index finger
message = unitree_hg_msg_dds__HandCmd_()  # has no CRC
awake = time.clock_gettime(time.CLOCK_BOOTTIME)
for part in (min(step / 100, 1.0) for step in range(200)):  # one second there, one to settle
    last, awake = awake, time.clock_gettime(time.CLOCK_BOOTTIME)
    if awake - last > 1.0:  # stopped or asleep: nobody has asked for the rest of the motion
        sys.exit("this program was suspended")
    for i, motor in enumerate(message.motor_cmd):
        motor.mode = 0x10 | i  # bits 0 to 3: which motor; 1 in bits 4 to 6: follow the command
        motor.q, motor.kp, motor.kd = begin[i] + part * (goal[i] - begin[i]), 1.5, 0.2
    commands.Write(message)
    time.sleep(0.01)
print(" ".join(f"{motor.q:.3f}" for motor in states.Read().motor_state))
