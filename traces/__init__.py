"""Recordings of DDS traffic: write them, read them, play them.

A recording is an mcap file whose channels are DDS topics and whose payloads are the samples as
they were on the wire. See docs/traces.md.
"""

from __future__ import annotations

from dexkit.traces.names import dds_topic, dds_type
from dexkit.traces.player import Player, PlayStats
from dexkit.traces.reader import (
    ChannelInfo,
    SampleArray,
    Trace,
    TraceEndpoint,
    TraceMessage,
    open_trace,
)
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
