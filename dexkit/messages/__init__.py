"""Messages of Unitree's and Inspire's hands: dataclasses, CDR codec without CycloneDDS, schemas.

    >>> from dexkit.messages import message_type
    >>> from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_
    >>> mt = message_type("unitree_go::msg::dds_::MotorCmds_")
    >>> data = mt.encode(MotorCmds_([MotorCmd_(mode=1, q=1.5, kp=5.0, kd=0.05)]))
    >>> mt.decode(data).cmds[0].q
    1.5

The layouts are written down once, in ``idl/*.idl``; ``python -m tools.generate`` writes
the modules :mod:`dexkit.messages.unitree_go`, :mod:`dexkit.messages.unitree_hg` and
:mod:`dexkit.messages.inspire` from them.
"""

from __future__ import annotations

from dexkit.messages.columns import Columns
from dexkit.messages.registry import MessageType, decode, encode, message_type, message_types

__all__ = ["Columns", "MessageType", "decode", "encode", "message_type", "message_types"]
