"""Check the answers of a Modbus device, for the drivers."""

from __future__ import annotations

from dexkit.errors import HandTimeout, WireError
from dexkit.wire.modbus import Adu, Refusal, Request, parse_answer

__all__ = ["accept"]


def accept(answer: Adu, request: Request) -> tuple[int, ...] | None:
    """Return the registers in the answer to a request; None if it answers another request.

    :raises HandTimeout: the device refuses the request, which costs this exchange.
    """
    try:
        return parse_answer(answer.pdu, request)
    except Refusal as refusal:
        raise HandTimeout(
            f"the hand refuses to {request.function.name.lower().replace('_', ' ')} "
            f"{request.count} registers from {request.address} on: {refusal}",
            hint="is it another model, or its firmware too old?",
        ) from refusal
    except WireError:
        return None
