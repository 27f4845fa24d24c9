"""Convert ROS 2 topic and type names to their DDS spelling.

A ROS 2 topic ``/dex1/left/cmd`` of type ``unitree_go/msg/MotorCmds`` is the DDS topic
``rt/dex1/left/cmd`` of type ``unitree_go::msg::dds_::MotorCmds_``. Recordings contain either; all
code after the reader uses the DDS spelling.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable

from dexkit.messages.layout import ALL

__all__ = ["CUT", "RECORDER", "SESSION", "USB", "dds_topic", "dds_type", "select_topics"]

USB = "usb/"
"""Beginning of the channels that hold USB transfers and no DDS samples."""

CUT, RECORDER = "dexkit_cut", "dexkit_recorder"
"""Names of the metadata records of a cut and of the recorder."""

SESSION = "rt/session/"
"""Prefix of topics with data of an imported session that no DDS topic carries."""


_OTHERS = {kind.ros_name: name for name, kind in ALL.items() if "dds_" not in kind.scope}
"""DDS types outside the modules of ROS 2, by what recordings call them."""


def dds_topic(name: str) -> str:
    """``/dex1/left/cmd``, ``dex1/left/cmd`` and ``rt/dex1/left/cmd`` as ``rt/dex1/left/cmd``.

    ``usb/...`` is a channel of USB transfers and stays as it is.
    """
    if name.startswith(USB):
        return name
    bare = name.lstrip("/")
    return bare if bare.startswith("rt/") else f"rt/{bare}"


def dds_type(name: str) -> str:
    """``unitree_go/msg/MotorCmds`` and its other spellings as the name on the wire.

    Other names are returned unchanged.
    """
    for separator in ("::", "/", "."):
        if separator in name:
            parts = name.split(separator)
            break
    else:
        return name
    if "dds_" in parts:
        return "::".join(parts)
    if len(parts) == 2:
        parts.insert(1, "msg")
    if "/".join(parts) in _OTHERS:
        return _OTHERS["/".join(parts)]
    if len(parts) == 3 and parts[1] == "msg":
        return f"{parts[0]}::msg::dds_::{parts[2]}_"
    return "::".join(parts)


def select_topics(available: Iterable[str], wanted: Iterable[str]) -> tuple[list[str], list[str]]:
    """Pick topics by name or shell pattern, in any spelling.

    :returns: (topics picked, in the order of ``available``; entries of ``wanted`` that match
        nothing).
    """
    topics = list(available)
    picked: set[str] = set()
    missing = []
    for entry in wanted:
        pattern = dds_topic(entry)
        hits = [t for t in topics if t == pattern or fnmatch.fnmatchcase(t, pattern)]
        picked.update(hits)
        if not hits:
            missing.append(entry)
    return [t for t in topics if t in picked], missing
