"""Recognise misspelt hand topics, and shorten type names."""

from __future__ import annotations

import difflib
import re
from typing import Any

from dexkit.messages import message_types
from dexkit.models import Dialect, ModeByte
from dexkit.topics import HAND_TOPICS, roles, split_prefix

__all__ = ["closest_topic", "is_asked", "is_driven", "is_hand_topic", "is_limp", "short"]

_KNOWN_TYPES = frozenset(kind.name for kind in message_types())
_ALIKE = 0.86  # ratio of difflib above which a name is a slip of the pen
_FOC = 1  # status in RIS_Mode_t (dexkit.wire.ris.RIS_MODE)
# other hands of the vendor's stack; not slips of the pen
_OTHERS = re.compile(r"(rt)?/?(lf/)?(dex\d+|inspire\w*|brainco\w*)/")


def is_hand_topic(topic: str, type_name: str) -> bool:
    """Whether a topic is a hand's and its samples hold motors, with the right type or another."""
    return any(role.kind != "touch" for role in roles(split_prefix(topic)[1], type_name))


def is_driven(motor: Any, dialect: Dialect) -> bool:
    """Whether a motor's command makes it follow ``q``: it has a position gain and is not locked."""
    if dialect.mode_byte is ModeByte.STATUS and motor.mode != _FOC:
        return False
    if dialect.mode_byte is ModeByte.RIS and (motor.mode >> 4) & 7 != _FOC:
        return False
    return is_asked(motor, dialect)


def is_asked(motor: Any, dialect: Dialect) -> bool:
    """Whether a motor's command has a position gain, where the dialect has gains at all."""
    return not dialect.gains_are_used or bool(motor.kp)


def is_limp(motor: Any, dialect: Dialect) -> bool:
    """Whether a motor's command is to be limp: nothing brakes or locks it, and it has no gains."""
    if not dialect.gains_are_used or any((motor.kp, motor.kd, motor.dq, motor.tau)):
        return False
    if dialect.mode_byte is ModeByte.STATUS:
        return bool(motor.mode)
    return dialect.mode_byte is not ModeByte.RIS or (motor.mode >> 4) & 7 == _FOC


def _plain(topic: str) -> str:
    """A topic's name without the differences that are the most frequent mistakes."""
    text = re.sub(r"/+", "/", topic.lower()).strip("/")
    return text.removeprefix("rt/")


def closest_topic(topic: str) -> tuple[str, str] | None:
    """The hand topic that an unknown name is nearest to, and the difference."""
    if split_prefix(topic)[1] in HAND_TOPICS:
        return None
    names = sorted(HAND_TOPICS)
    plain = _plain(topic)
    for name in names:
        if _plain(name) == plain:
            return name, _slip(topic)
    known = _OTHERS.match(topic.lower())
    if known and not any(f"/{known[3]}/" in name for name in HAND_TOPICS):
        return None
    best = difflib.get_close_matches(plain, [_plain(name) for name in names], 1, _ALIKE)
    for name in names:
        if best and _plain(name) == best[0]:
            return name, "it is spelt differently"
    return None


def _slip(topic: str) -> str:
    if topic != topic.lower():
        return "capitals matter"
    if topic.startswith("/"):
        return "that is how ROS 2 writes it; on DDS it has the prefix rt/ and no leading slash"
    if not topic.startswith("rt/"):
        return "the prefix rt/ is missing"
    return "a slash too many"


def short(type_name: str) -> str:
    """A type without its name space, e.g. ``unitree_go MotorCmds_``."""
    package, _, rest = type_name.partition("::")
    name = rest.rpartition("::")[2]
    return f"{package} {name}" if type_name in _KNOWN_TYPES or name else type_name
