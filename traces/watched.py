"""Feed a collector with a whole recording."""

from __future__ import annotations

from dexkit.traces.reader import Trace
from dexkit.watch.collector import Collector
from dexkit.watch.fields import parts_of

__all__ = ["feed"]


def feed(trace: Trace) -> Collector:
    """A collector that has taken everything in a recording; it holds all values of hands.

    :raises TraceUnreadable: the file cannot be read.
    """
    collector = Collector(most=None)
    shown = {c.topic for c in trace.channels if c.message_count}
    decoded = {c.topic for c in trace.channels if parts_of(c.topic, c.type_name)} & shown
    samples = {
        **(trace.load(sorted(decoded), decode=True) if decoded else {}),
        **(trace.load(sorted(shown - decoded), payloads=False) if shown - decoded else {}),
    }
    collector.origin_ns = trace.first_ns
    for topic, some in sorted(samples.items()):
        readable = topic in decoded and not some.problem
        collector.take(
            topic,
            some.type_name if readable else "",
            some.columns() if readable else [],
            some.log_time_ns,
            some.publish_time_ns,
        )
    for number, endpoint in enumerate(trace.endpoints):
        collector.endpoint(str(number), endpoint.topic, endpoint.kind, "")
    return collector
