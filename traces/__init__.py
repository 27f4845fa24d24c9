"""Write, read and replay recordings of DDS traffic.

A recording is an mcap file whose channels are DDS topics and whose payloads are the samples as
they were on the wire. See docs/traces.md.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from dexkit.traces.names import dds_topic, dds_type
from dexkit.traces.reader import (
    ChannelInfo,
    SampleArray,
    Trace,
    TraceEndpoint,
    TraceMessage,
    open_trace,
)

if TYPE_CHECKING:
    from dexkit.traces.player import Player, PlayStats
    from dexkit.traces.recorder import Recorder
    from dexkit.traces.samples import SAMPLES, sample_labels, sample_path

__all__ = [
    "SAMPLES",
    "ChannelInfo",
    "PlayStats",
    "Player",
    "Recorder",
    "SampleArray",
    "Trace",
    "TraceEndpoint",
    "TraceMessage",
    "dds_topic",
    "dds_type",
    "open_trace",
    "sample_labels",
    "sample_path",
]

# loaded on first use: reading a recording needs neither
_LATER = {
    "Player": "player",
    "PlayStats": "player",
    "Recorder": "recorder",
    "SAMPLES": "samples",
    "sample_labels": "samples",
    "sample_path": "samples",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    globals()[name] = found
    return found
