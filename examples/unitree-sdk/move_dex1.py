"""Close a Dex1-1 to a third of its opening with Unitree's SDK: python move_dex1.py left 1 lo"""

import sys
import time

from unitree_sdk2py.core.channel import (
    ChannelFactoryInitialize,
    ChannelPublisher,
    ChannelSubscriber,
)
from unitree_sdk2py.idl.default import unitree_go_msg_dds__MotorCmd_
from unitree_sdk2py.idl.unitree_go.msg.dds_ import MotorCmds_, MotorStates_

side, domain, interface = sys.argv[1:]
ChannelFactoryInitialize(int(domain), interface)
states = ChannelSubscriber(f"rt/dex1/{side}/state", MotorStates_)
states.Init()
commands = ChannelPublisher(f"rt/dex1/{side}/cmd", MotorCmds_)
commands.Init()
begin, goal = states.Read().states[0].q, 1.8  # rad: 0 is closed, 5.4 open; waits for the gripper
motor = unitree_go_msg_dds__MotorCmd_()
awake = time.clock_gettime(time.CLOCK_BOOTTIME)
for part in (min(step / 200, 1.0) for step in range(400)):  # one second there, one to settle
    last, awake = awake, time.clock_gettime(time.CLOCK_BOOTTIME)
    if awake - last > 1.0:  # stopped or asleep: nobody has asked for the rest of the motion
        sys.exit("this program was suspended")
    motor.q, motor.kp, motor.kd = begin + part * (goal - begin), 5.0, 0.05  # mode 0, no CRC
    commands.Write(MotorCmds_([motor]))
    time.sleep(0.005)
print(f"{states.Read().states[0].q:.3f}")
