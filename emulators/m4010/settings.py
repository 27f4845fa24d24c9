"""Settings of an emulated M4010: points that no source documents, and its thermal model.

Only the vendor's library was measured (docs/sources/unitree-dex.md#g), no motor. The default of
each point is the best supported interpretation; docs/emulators.md lists them.
"""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.errors import UsageError
from dexkit.models import DEX1_1
from dexkit.wire import m4010

__all__ = ["Firmware", "Heat"]


@dataclass(frozen=True)
class Firmware:
    """Behaviour of the motor where it is not documented.

    :param baudrate: bits a second that it understands.
    :param command_timeout: seconds without a command until its time-out protection trips, if the
        last command asked for it (the Dex3-1 manual RIS_Mode_t, of the sibling motor).
    :param tripped_brakes: it then brakes; otherwise it goes limp.
    :param other_status_brakes: a status that is neither brake, FOC nor calibration brakes;
        otherwise such a command is ignored.
    :param calibration_enabled: otherwise it answers that calibrating is not enabled.
    :param flash_works: otherwise a calibration cannot be stored.
    :param answer_time: seconds from a command to its answer. Unknown; with 0 a measurement shows
        the cost of the host's side.
    :param byte_gap: seconds between bytes after which a frame begun is dropped.
    """

    baudrate: int = m4010.BAUD_RATE
    command_timeout: float = DEX1_1.command_timeout
    tripped_brakes: bool = True
    other_status_brakes: bool = True
    calibration_enabled: bool = True
    flash_works: bool = True
    answer_time: float = 0.0
    byte_gap: float = 2e-3

    def __post_init__(self) -> None:
        if self.command_timeout <= 0 or self.answer_time < 0 or self.byte_gap <= 0:
            raise UsageError("a time must not be negative, nor a time-out 0")
        if self.baudrate <= 0:
            raise UsageError(f"a baud rate must be positive, not {self.baudrate}")


@dataclass(frozen=True)
class Heat:
    """Supply and heat of the motor. All of it is assumed, none of it published.

    :param supply: V.
    :param copper_loss: W in the winding at 1 N·m of the joint.
    :param winding_capacity: J/K; ``case_capacity`` likewise.
    :param winding_to_case: K/W; ``case_to_air`` likewise.
    :param winding_limit: °C at which it reports an error and brakes; ``case_limit`` likewise.
    :param hysteresis: K below the limit at which the error ends.
    :param voltage_min: V below which it reports undervoltage and brakes.
    """

    ambient: float = 25.0
    supply: float = 24.0
    copper_loss: float = 1.5
    winding_capacity: float = 4.0
    case_capacity: float = 60.0
    winding_to_case: float = 3.0
    case_to_air: float = 8.0
    winding_limit: float = 120.0
    case_limit: float = 85.0
    hysteresis: float = 10.0
    voltage_min: float = 12.0
