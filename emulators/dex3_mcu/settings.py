"""Settings of an emulated Dex3-1: points on which the manual is silent or unclear.

The default of each is the best supported interpretation (docs/sources/unitree-dex.md#c);
docs/emulators.md lists them.
"""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import units

__all__ = ["Firmware"]


@dataclass(frozen=True)
class Firmware:
    """Behaviour of the hand's processor and motors where it is not documented.

    :param answer_bad_frame: a frame of a wrong size or CRC is answered with the state, and
        nothing of it is applied: the manual says that each command returns the state. Otherwise
        there is no answer.
    :param queue: answers that wait until the host reads them. The manual's one send, one receive
        needs one; when a frame comes while the queue is full the oldest answer is lost, so that
        a host that missed an answer reads a fresh one next.
    :param unaddressed_motors_answer: a motor without a (good) packet in the frame reports its
        state all the same, as "the current status" that the manual promises; otherwise only
        motors that were addressed do. Motors addressed by a broadcast alone never do.
    :param command_timeout: seconds without a command until a motor's time-out protection trips
        ("default 1s timeout").
    :param tripped_brakes: a motor whose protection tripped brakes, as Unitree's service does on
        a time-out; otherwise it goes limp.
    :param other_status_brakes: a status that is neither lock nor FOC brakes (6, calibration on
        the sibling motor, included); otherwise such a packet is ignored.
    :param model_code: mode[0] of the state, "the model of the hand"; its values are not given.
    :param sensors_polled: a sensor answers a frame that addresses it only, as the sizes "20*7 3+4"
        can be read; otherwise all sensors answer every frame, and such packets are ignored.
    :param frame: bytes of the only command frame that is taken, 1234 or 734; None for both. Others
        are frames of a wrong size.
    :param head: the only first two bytes of a command frame that are taken; None for any. Others
        are frames with a wrong CRC.
    :param answer_time: seconds from a command to its answer. Unknown, below 1 ms at the 1000 Hz of
        the manual; with 0 a measurement shows the cost of the host's side.
    :param no_value: counts of a pressure slot without an element: 3750, which are 30000 Pa, or
        30000 ("30000 represents no value", which may be either; docs/dex3-usb.md).
    """

    answer_bad_frame: bool = True
    queue: int = 1
    unaddressed_motors_answer: bool = True
    command_timeout: float = DEX3_1.command_timeout
    tripped_brakes: bool = True
    other_status_brakes: bool = True
    model_code: int = 0
    sensors_polled: bool = False
    frame: int | None = None
    head: bytes | None = None
    answer_time: float = 0.0
    no_value: int = units.NO_VALUE

    def __post_init__(self) -> None:
        if self.queue < 1:
            raise UsageError("the queue holds at least one answer")
        if self.command_timeout <= 0 or self.answer_time < 0:
            raise UsageError("a time must not be negative, nor a time-out 0")
        if not 0 <= self.model_code <= 0xFF:
            raise UsageError("the model code is one byte")
        if self.no_value not in (units.NO_VALUE, units.NO_VALUE_COUNTS):
            raise UsageError(f"no value is 3750 or 30000 counts, not {self.no_value}")
