"""The types of Inspire's Python package, declared anew for CycloneDDS.

Names, types and bounds of the members, extensibility and member ids as
`NaCl-1374/inspire_hand_ws <https://github.com/NaCl-1374/inspire_hand_ws>`_ ``fc75490`` has them
(``inspire_hand_sdk/inspire_sdkpy/inspire_dds``; docs/sources/unitree-dex.md#j3), not taken from
dexkit's .idl.
"""

from __future__ import annotations

from functools import cache
from typing import Any

__all__ = ["inspire_class"]

_TOUCH = {"tip": 9, "top": 96, "palm": 80}
_FINGERS = ("one", "two", "three", "four")
_MEMBERS: dict[str, dict[str, tuple[str, int]]] = {
    "inspire_hand_ctrl": {
        **{f"{what}_set": ("int16", 6) for what in ("pos", "angle", "force", "speed")},
        "mode": ("int8", 0),
    },
    "inspire_hand_state": {
        **dict.fromkeys(("pos_act", "angle_act", "force_act", "current"), ("int16", 6)),
        **dict.fromkeys(("err", "status", "temperature"), ("uint8", 6)),
    },
    "inspire_hand_touch": {
        **{
            f"finger{finger}_{place}_touch": ("int16", count)
            for finger in _FINGERS
            for place, count in _TOUCH.items()
        },
        "fingerfive_tip_touch": ("int16", 9),
        "fingerfive_top_touch": ("int16", 96),
        "fingerfive_middle_touch": ("int16", 9),
        "fingerfive_palm_touch": ("int16", 96),
        "palm_touch": ("int16", 112),
    },
}


@cache
def inspire_class(name: str) -> Any:
    """The class ``inspire_hand_ctrl``, ``inspire_hand_state`` or ``inspire_hand_touch``."""
    from cyclonedds import idl
    from cyclonedds.idl import annotations
    from cyclonedds.idl import types as _types

    types: Any = _types
    fields: dict[str, Any] = {}
    for member, (number, most) in _MEMBERS[name].items():
        kind = getattr(types, number)
        fields[member] = types.sequence[kind, most] if most else kind
    cls: Any = idl.make_idl_struct(name, f"inspire.{name}", fields)
    annotations.final(cls)
    annotations.autoid("sequential")(cls)
    return cls
