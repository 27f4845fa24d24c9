"""Settings of an emulated MX-64: undocumented points of its firmware, and its mechanics.

Each field of :class:`Firmware` is a point on which the manual is silent or sources disagree
(docs/sources/mx64-ezgripper.md#f); the default is the best supported interpretation, and
docs/emulators.md lists them. :class:`Physics` holds the figures of motor, supply, heat and gripper.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from dexkit.errors import UsageError
from dexkit.wire import mx64

__all__ = ["Firmware", "GripperMechanics", "Physics"]


@dataclass(frozen=True)
class Firmware:
    """Behaviour of the servo's firmware where it is not documented, or varies.

    :param version: Firmware Version(6).
    :param velocity_limit: factory value of Velocity Limit(44): 435 by the e-Manual, lower from
        V42 on by hearsay (docs/sources/mx64-ezgripper.md#f1).
    :param undefined_address_error: error number for a write to no item: 0x07 by the protocol's
        page, 0x04 in a field report (docs/sources/mx64-ezgripper.md#f2).
    :param read_across_gaps: answer a read that spans undefined addresses with zeros there
        instead of an Access Error (docs/sources/mx64-ezgripper.md#f2).
    :param answer_bad_crc: answer a packet with a wrong CRC with error 0x03 instead of silence
        (docs/sources/mx64-ezgripper.md#f3).
    :param boot_time: seconds of silence after a reboot (docs/sources/mx64-ezgripper.md#f5).
    :param refuse_torque_in_shutdown: error number for Torque Enable = 1 in shutdown; 0 takes the
        write and leaves torque off (docs/sources/mx64-ezgripper.md#f6).
    :param sync_write_clamps: an out-of-limit goal in a Sync or Bulk Write is clamped instead of
        ignored (docs/sources/mx64-ezgripper.md#f7).
    :param current_follows_goal: Present Current is what the controller wants instead of what
        flows (docs/sources/mx64-ezgripper.md#f8).
    :param current_noise: standard deviation of Present Current, units.
    :param ping_slot: seconds that each id below the own delays the answer to a broadcast ping
        (docs/sources/mx64-ezgripper.md#f10); ids answer in order in any case.
    :param missing_id_stalls: in a Sync or Bulk Read the servos behind a missing one stay silent
        (they wait for its status); otherwise they answer as if it were not listed.
    :param level_0_answers_sync: at Status Return Level 0, Sync and Bulk Read are answered.
    :param profile_velocity_limited: a Profile Velocity above Velocity Limit(44) is refused.
    :param goal_starts_at_present: Goal Position becomes the present one at Torque Enable = 1.
    :param watchdog_resumes: when the bus watchdog is cleared the servo heads for its goal again;
        otherwise it stays where it was stopped.
    :param fast_reads: Fast Sync and Fast Bulk Read, which no MX is listed to have.
    :param backup: Control Table Backup, which no MX is listed to have.
    :param byte_gap: seconds between bytes after which a packet begun is dropped.
    :param overload_level: part of the 12 V stall current above which load counts
        (docs/sources/mx64-ezgripper.md#f4).
    :param overload_delay: seconds of such load until the overload error
        (docs/sources/mx64-ezgripper.md#f4).
    :param in_position_window: ticks around the goal that count as "in position".
    :param following_error_window: ticks behind the trajectory that count as following error.
    """

    version: int = mx64.FIRMWARE
    velocity_limit: int = 435
    undefined_address_error: int = 0x07
    read_across_gaps: bool = False
    answer_bad_crc: bool = False
    boot_time: float = 0.3
    refuse_torque_in_shutdown: int = 0
    sync_write_clamps: bool = False
    current_follows_goal: bool = False
    current_noise: float = 1.5
    ping_slot: float = 0.0
    missing_id_stalls: bool = True
    level_0_answers_sync: bool = False
    profile_velocity_limited: bool = True
    goal_starts_at_present: bool = True
    watchdog_resumes: bool = False
    fast_reads: bool = False
    backup: bool = False
    byte_gap: float = 1.5e-3
    overload_level: float = 0.6
    overload_delay: float = 5.0
    in_position_window: int = 20
    following_error_window: int = 100


@dataclass(frozen=True)
class GripperMechanics:
    """Mechanics of the EZGripper at the servo's shaft; 0 % is closed, 100 % open.

    Stroke and closing direction are facts (docs/sources/mx64-ezgripper.md#d1,
    docs/sources/mx64-ezgripper.md#d2). Stiffness and friction of the whole gripper are not
    published:
    free motion at some 50 to 90 current units is what the logs of docs/sources/mx64-ezgripper.md#d4
    and docs/sources/mx64-ezgripper.md#b7 show, and the contact stiffness gives a few percent of
    travel at full grip.

    :param closed_at: encoder tick, 0 to 4095, at which the fingers are closed.
    :param start: opening at power-on, percent.
    :param object_pct: opening at which the fingers touch an object; None for no object.
    :param object_stiffness: N·m/rad at the shaft.
    :param coulomb: tendon friction, N·m.
    :param spring: the opening springs, N·m/rad at the shaft.
    :param mirrored: it closes while the encoder's position rises.
    :param stroke: ticks from closed to open.
    :param bare: no gripper at all: a shaft that turns freely, any number of turns. See
        :meth:`none`.
    """

    closed_at: int = 1510
    start: float = 50.0
    object_pct: float | None = None
    object_stiffness: float = 20.0
    closed_stiffness: float = 60.0
    open_stiffness: float = 120.0
    inertia: float = 0.0005
    coulomb: float = 0.15
    viscous: float = 0.02
    spring: float = 0.008
    mirrored: bool = False
    stroke: int = mx64.EZGRIPPER_STROKE
    bare: bool = False

    @classmethod
    def none(cls) -> GripperMechanics:
        """A servo without a gripper, at rest at mid range."""
        mid = mx64.TICKS_PER_TURN // 2
        return cls(mid, start=0.0, inertia=0.0, coulomb=0.0, viscous=0.0, spring=0.0, bare=True)

    def __post_init__(self) -> None:
        if not 0 <= self.closed_at < mx64.TICKS_PER_TURN:
            raise UsageError(f"closed_at is an encoder tick, 0 to 4095, not {self.closed_at}")
        if not 0 <= self.start <= 100:
            raise UsageError(f"start is a percentage of opening, not {self.start}")
        if self.bare and self.object_pct is not None:
            raise UsageError("a servo without a gripper cannot touch an object")
        if self.object_pct is not None and not 0 < self.object_pct < 100:
            raise UsageError(
                f"an object must be between the fingers: 0 < percent < 100, not {self.object_pct}"
            )


@dataclass(frozen=True)
class Physics:
    """Motor, heat and supply.

    Torque constant, gear loss and resistance are chosen so that the maker's figures at 12 V come
    out (stall 6.0 N·m at 4.1 A, 63 rpm without load: docs/sources/mx64-ezgripper.md#b1) with the
    inertia and friction of an identified model (BAM M1). The heat figures fit SAKE's three holds
    (docs/sources/mx64-ezgripper.md#d6: 0.0149, 0.0326 and 0.0647 °C/s at 15, 30 and 45 % of 1600
    units) within 15 %; the cooling time is a guess from the maker's advice to wait 20 minutes.

    :param kt: N·m/A, and V·s/rad, at the output.
    :param gear_loss: part of the motor's torque that friction in the gears takes.
    :param heat_capacity: J/K.
    :param cooling_time: seconds to come within 1/e of the surroundings.
    :param idle_power: W of heat from the electronics; ``drive_power`` more with torque on.
    :param supply_resistance: ohm of supply and cable, for the sag under load.
    :param brown_out_reset: V below which the servo's processor stops; it boots when it returns.
    """

    kt: float = 1.77
    resistance: float = 2.93
    stall_current: float = 4.1
    gear_loss: float = 0.16
    inertia: float = 0.01195
    coulomb: float = 0.0904
    viscous: float = 0.0117
    heat_capacity: float = 296.0
    cooling_time: float = 1200.0
    idle_power: float = 1.2
    drive_power: float = 2.0
    ambient: float = 25.0
    supply_voltage: float = 12.0
    supply_resistance: float = 0.15
    idle_current: float = 0.1
    brown_out_reset: float = 6.5
    gripper: GripperMechanics = field(default_factory=GripperMechanics)
