"""The command of docs/sources/unitree-dex.md#c10."""

from __future__ import annotations

from dexkit.wire.dex3_usb import CommandFrame, CommandLayout, MotorCmd, pack_command, units

__all__ = ["worked_example"]


def worked_example(layout: CommandLayout) -> bytes:
    """Seven motors in FOC, kp 1.5, kd 0.2; all of ratio 108, head FC FD
    (docs/sources/unitree-dex.md#c10).
    """
    targets = ((0.0, 0.2, 0.5), (-0.3, -0.6), (-0.4, -0.8), (), ())
    buses = [
        [
            MotorCmd(
                id=number,
                status=1,
                timeout=False,
                tor_des=0,
                spd_des=0,
                pos_des=units.POSITION.encode(q, 108),
                k_pos=units.STIFFNESS.encode(1.5, 108),
                k_spd=units.DAMPING.encode(0.2, 108),
            )
            for number, q in enumerate(bus)
        ]
        for bus in targets
    ]
    return pack_command(CommandFrame(buses, head=b"\xfc\xfd"), layout)
