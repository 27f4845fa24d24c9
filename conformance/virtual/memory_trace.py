"""A recording in memory, in the form that the kit reads recordings in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from dexkit.traces import ChannelInfo, SampleArray, TraceEndpoint
from dexkit.traces.clock_steps import ClockStep

__all__ = ["MemoryTrace"]


@dataclass
class MemoryTrace:
    """A recording that was never in a file."""

    endpoints: list[TraceEndpoint] = field(default_factory=list)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    mixed_types: dict[str, str] = field(default_factory=dict)
    clock_steps: list[ClockStep] = field(default_factory=list)
    truncated: bool = False
    rows: dict[tuple[str, str], list[tuple[int, int, bytes]]] = field(default_factory=dict)

    def put(self, topic: str, type_name: str, log_ns: int, sent_ns: int, data: bytes) -> None:
        """Record one sample."""
        rows = self.rows.get((topic, type_name))
        if rows is None:
            rows = self.rows[topic, type_name] = []
        rows.append((log_ns, sent_ns, data))

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel."""
        return [
            ChannelInfo(topic, kind, "", len(rows), rows[0][0], rows[-1][0], {}, topic)
            for (topic, kind), rows in self.rows.items()
        ]

    def load(
        self, topics: Iterable[str] | None = None, *, decode: bool = False
    ) -> dict[str, SampleArray]:
        """Samples by topic; nothing is decoded here."""
        wanted = None if topics is None else set(topics)
        found: dict[str, SampleArray] = {}
        for (topic, kind), rows in self.rows.items():
            if wanted is None or topic in wanted:
                found[topic] = SampleArray(
                    topic,
                    kind,
                    np.array([r[0] for r in rows], dtype=np.int64),
                    np.array([r[1] for r in rows], dtype=np.int64),
                    [r[2] for r in rows],
                )
        return found
