"""Programs that judge LeRobot datasets, side by side on the same folders.

    python -m benchmarks.dataset_peers SET... --doctor lerobot-doctor --lint lelint

Each program runs on each set in a process of its own, without network, and is measured; what it
says is brought into one form (:class:`Finding`). With the labels of a set of known faults
(``--labels``) it is also counted who has found what.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["LEVELS", "Finding", "Run"]

LEVELS = ("note", "warning", "failure")
"""How bad a program calls what it found, mildest first."""


@dataclass(frozen=True)
class Finding:
    """One thing that a program said about a set.

    :param check: what it looked for, in the program's words (or a short word for its sentence).
    :param level: one of :data:`LEVELS`.
    :param episode: number or folder name of the episode that it names; empty: about the whole set.
    :param text: its sentence.
    """

    check: str
    level: str
    episode: str
    text: str


@dataclass
class Run:
    """One program on one set.

    :ivar wall_s: seconds from start to end; ``cpu_s``: processor time of it and its children.
    :ivar peak_mib: resident memory of its largest process at most.
    :ivar exit: its exit code; negative: ended by this signal; None: could not be started.
    :ivar trouble: why there are no findings; empty: it judged the set.
    :ivar episodes: how many the set has by its own words; ``recorded_s``: how long they are; None:
        it does not say.
    """

    tool: str
    dataset: Path
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mib: float = 0.0
    exit: int | None = None
    trouble: str = ""
    episodes: int | None = None
    recorded_s: float | None = None
    findings: list[Finding] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """All of it, findings by episode."""
        by_episode: dict[str, list[dict[str, str]]] = {}
        for finding in self.findings:
            said = {"check": finding.check, "level": finding.level, "text": finding.text}
            by_episode.setdefault(finding.episode, []).append(said)
        fields = {k: v for k, v in vars(self).items() if k != "findings"}
        return {**fields, "dataset": str(self.dataset), "findings": by_episode}
