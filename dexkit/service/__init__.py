"""The service that puts a hand on Unitree's topics.

:class:`HandService` is the thing to use. Its parts, each testable alone:
:mod:`~dexkit.service.hand_core` (watchdog, faults, commands to send and state to publish),
:mod:`~dexkit.service.dialects` (values from and to messages),
:mod:`~dexkit.service.estimator` (prediction between slow measurements).
"""

from __future__ import annotations

from dexkit.service.counters import HandCounters, TopicCounters
from dexkit.service.diagnose import diagnose
from dexkit.service.dialects import DialectMap, Fill, Remark, StateView, dialect_map
from dexkit.service.estimator import JointEstimator, StateEstimator
from dexkit.service.hand_core import Estimation, HandCore
from dexkit.service.publisher import Publisher
from dexkit.service.realtime import prepare_process, real_time
from dexkit.service.service import HandService

__all__ = [
    "DialectMap",
    "Estimation",
    "Fill",
    "HandCore",
    "HandCounters",
    "HandService",
    "JointEstimator",
    "Publisher",
    "Remark",
    "StateEstimator",
    "StateView",
    "TopicCounters",
    "diagnose",
    "dialect_map",
    "prepare_process",
    "real_time",
]
