"""Conformance of a Dex3-1 on its own USB device, below the topics.

The kit is a USB host: :func:`~dexkit.conformance.usb.run.run` plays a script at the hand and
records every transfer; :mod:`dexkit.conformance.kit.judge` judges that recording.
"""

from __future__ import annotations

__all__ = ["RECORD"]

RECORD = "dexkit.usb"
"""Metadata record of a USB run."""
