"""Conformance runs without DDS, devices or waiting: hands in memory on a virtual clock.

The same script drives them and the same checks judge them as in a live run; half a minute of hand
takes a fraction of a second. They prove the checks: the references
(:mod:`~dexkit.conformance.virtual.gripper`, :mod:`~dexkit.conformance.virtual.fingers`,
:mod:`~dexkit.conformance.virtual.robot`, :mod:`~dexkit.conformance.virtual.usb`) meet every
requirement, and each wrong hand in :mod:`dexkit.conformance.faults` changes one thing.
"""

from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.service import Sample, Service, TopicDevice
from dexkit.conformance.virtual.topic_run import run_virtual

__all__ = ["MemoryTrace", "Sample", "Service", "TopicDevice", "run_virtual"]
