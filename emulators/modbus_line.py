"""Answer Modbus requests from the registers of an emulated device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dexkit.errors import WireError
from dexkit.wire import modbus
from dexkit.wire.modbus import Adu, Exceptional, Function, Refusal

__all__ = ["Registers", "rtu_answers", "tcp_answers"]


class Registers(Protocol):
    """Access to a device's 16-bit registers."""

    def read_registers(self, function: Function, address: int, count: int) -> list[int]:
        """Read ``count`` registers from an address.

        :raises Refusal: one of them does not exist.
        """

    def write_registers(self, address: int, values: tuple[int, ...]) -> None:
        """Write registers from an address on.

        :raises Refusal: the device does not accept them.
        """


def _answer(device: Registers, pdu: bytes) -> bytes | None:
    """The PDU that answers a request; None for a request of wrong length."""
    try:
        request = modbus.parse_request(pdu)
        if request.function in (Function.WRITE, Function.WRITE_ONE):
            device.write_registers(request.address, request.values)
            return modbus.answer(request)
        values = device.read_registers(request.function, request.address, request.count)
        return modbus.answer(request, values)
    except Refusal as refusal:
        return modbus.refuse(pdu[0], refusal.code)
    except WireError:
        return None


def tcp_answers(device: Registers) -> Callable[[Adu], bytes | None]:
    """Answer requests on TCP, to any unit: the connection itself selects the device."""

    def answer(adu: Adu) -> bytes | None:
        pdu = _answer(device, adu.pdu)
        if pdu is None:
            pdu = modbus.refuse(adu.pdu[0], Exceptional.ILLEGAL_VALUE)
        return Adu(adu.unit, pdu, adu.transaction).pack_tcp()

    return answer


def rtu_answers(device: Registers, unit: Callable[[], int]) -> Callable[[Adu], bytes | None]:
    """Answer requests on a serial line, to the device's own unit only."""

    def answer(adu: Adu) -> bytes | None:
        if adu.unit != unit():
            return None
        pdu = _answer(device, adu.pdu)
        return None if pdu is None else Adu(adu.unit, pdu).pack_rtu()

    return answer
