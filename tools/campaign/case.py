"""Cases of the campaign, their batches and their findings."""

from __future__ import annotations

import hashlib
import os
import random
import time
import traceback
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from types import SimpleNamespace, TracebackType
from typing import Any, ClassVar

__all__ = ["Batch", "Case", "Finding", "Lane", "Skip", "place_of"]

ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = tuple(
    f"{ROOT}/{n}/" for n in ("dexkit", "drivers", "emulators", "conformance", "traces")
)


class Lane(str, Enum):
    """What a batch of a case mostly does, which decides what it runs beside."""

    COMPUTE = "compute"
    """Uses a whole core; runs at a low priority."""
    LIVE = "live"
    """Has programs and threads that mostly wait; several run beside one another."""
    LONG = "long"
    """One batch as long as the whole run."""


class Skip(Exception):
    """The case cannot be run on this machine; the text gives the reason."""


@dataclass(frozen=True)
class Finding:
    """Something that must not be.

    :param kind: exception type or what else happened, e.g. ``traceback``, ``hang``.
    :param place: innermost function of the project in it, or what it happened to.
    :param detail: what a person needs.
    :param seed: of the campaign; with ``batch`` and ``index`` it gives the input again.
    :param index: number of the input in its batch, -1 where there is none.
    :param data: the input, hexadecimal; empty where there is none.
    """

    case: str
    kind: str
    place: str
    detail: str = ""
    seed: str = ""
    batch: int = 0
    index: int = -1
    data: str = ""

    @property
    def id(self) -> str:
        """Same for findings of one case, kind and place."""
        text = f"{self.case} {self.kind} {self.place}"
        return f"{self.case.replace(':', '-')}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"

    def as_dict(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


@dataclass
class Batch:
    """One piece of work of a case.

    :param number: of the batch; with the seed it decides everything that is random.
    :param sample: do it in miniature.
    :param seconds: how long a case that has no natural end shall go on.
    :param scratch: an empty folder, removed afterwards.
    :param domain: first of ten DDS domains that no other program uses.
    :param only: number of the only input that is of interest.
    :param index: takes the number of each input before it is tried, in ``value``: the parent
        process knows it when this one has died.
    """

    case: str
    seed: str
    number: int
    scratch: Path
    domain: int = 50
    sample: bool = False
    seconds: float = 1.0
    only: int | None = None
    index: Any = field(default_factory=lambda: SimpleNamespace(value=-1))
    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    units: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(f"{self.seed} {self.case} {self.number}")
        self.began = time.monotonic()

    @property
    def left(self) -> float:
        """Seconds until ``seconds`` are over."""
        return self.began + self.seconds - time.monotonic()

    def found(
        self, kind: str, place: str, detail: str = "", *, index: int = -1, data: bytes = b""
    ) -> None:
        """Note a finding; only the first one of a kind and place is kept."""
        finding = Finding(
            self.case, kind, place, detail[-4000:], self.seed, self.number, index, data.hex()
        )
        if finding.id not in [f.id for f in self.findings]:
            self.findings.append(finding)

    def failed(self, error: BaseException, *, index: int = -1, data: bytes = b"") -> None:
        """Note an exception as a finding."""
        text = "".join(traceback.format_exception(type(error), error, error.__traceback__, -12))
        place = place_of(error.__traceback__)
        self.found(type(error).__name__, place, text, index=index, data=data)


class Case(ABC):
    """Something that is tried again and again.

    :cvar name: how it is called, e.g. ``fuzz:rtps``.
    :cvar what: what is tried, in a few words.
    :cvar unit: what is counted.
    :cvar limit: seconds after which a batch counts as hanging.
    """

    name: str
    what: str
    unit: ClassVar[str]
    lane: ClassVar[Lane] = Lane.LIVE
    limit: float = 180.0

    @abstractmethod
    def run(self, batch: Batch) -> None:
        """Do one batch: count in ``batch.units``, report to ``batch.found``.

        :raises Skip: it cannot be run here. Any other exception is the campaign's own failure.
        """

    def repeat(self, batch: Batch, data: bytes) -> None:
        """Try one kept input again. By default the whole batch is run again."""
        self.run(batch)


def place_of(trace: TracebackType | None) -> str:
    """``file:function`` of the innermost call in the project, without a line number.

    A line number would make two findings of one whenever the file is edited.
    """
    frames = list(traceback.extract_tb(trace))
    ours = [f for f in frames if os.path.normpath(f.filename).startswith(_PACKAGES)]
    if not ours:
        ours = [f for f in frames if "/tools/campaign/" not in f.filename] or frames
    if not ours:
        return "unknown"
    last = ours[-1]
    return f"{_short(last.filename)}:{last.name}"


def _short(filename: str) -> str:
    path = Path(filename).resolve()
    if path.is_relative_to(ROOT) and "site-packages" not in path.parts:
        return str(path.relative_to(ROOT))
    return "/".join(path.parts[-2:])
