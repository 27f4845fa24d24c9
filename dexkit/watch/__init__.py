"""Observe DDS topics for viewers: rates, ages, gaps, and each hand's values.

:class:`~dexkit.watch.collector.Collector` takes samples and answers for any moment, without input
or output of its own. :class:`~dexkit.watch.listener.Listener` feeds it from a DDS domain,
:func:`~dexkit.traces.watched.feed` from a recording.
"""

from __future__ import annotations

from dexkit.watch.collector import Collector, Picture, SubjectView, TopicView
from dexkit.watch.marks import Mark

__all__ = ["Collector", "Mark", "Picture", "SubjectView", "TopicView"]
