"""Translate between Dex1 dialects: topics of one dialect are published in another one.

:class:`Bridge` is the thing to use. Its parts, each testable alone:
:mod:`~dexkit.bridge.translate` (what one side's part of a message means in another dialect),
:mod:`~dexkit.bridge.forwarding` (which message follows from which, and when; no threads, no DDS).
"""

from __future__ import annotations

from dexkit.bridge.bridge import Bridge, BridgeEnd
from dexkit.bridge.forwarding import Commands, Direction, States
from dexkit.bridge.translate import PartCodec, translator

__all__ = ["Bridge", "BridgeEnd", "Commands", "Direction", "PartCodec", "States", "translator"]
