"""What is found in an episode, and the verdict that follows from it."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

import msgspec

__all__ = ["Curve", "Finding", "Judgement", "Shot", "Use", "use_of"]


class Use(str, Enum):
    """What to do with an episode, from good to bad."""

    KEEP = "keep"
    REVIEW = "review"
    """Somebody should look at it: it may be as it was meant."""
    DROP = "drop"
    """A policy that is trained on it learns what the robot did not do."""

    def __str__(self) -> str:
        return self.value


class Finding(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Something in an episode that spoils it, may spoil it, or is worth to know.

    :param check: name of the check: ``frozen``.
    :param use: what follows for the episode; ``keep`` for a remark.
    :param text: what is wrong, in plain words, with the figure.
    :param part: ``left_hand``, ``camera head``; empty where it is about the whole episode.
    :param joints: their places in the part; empty where it is about all of it.
    :param begin_s: where, s after the start of the episode; None where it is about all of it.
    :param value: the figure that it rests on, in ``unit``; ``limit`` is what was allowed.
    """

    check: str
    use: Use
    text: str
    part: str = ""
    joints: tuple[int, ...] = ()
    begin_s: float | None = None
    end_s: float | None = None
    value: float | None = None
    limit: float | None = None
    unit: str = ""


class Curve(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The picture of a moment: a joint's positions around a finding, thinned out.

    :param finding: index of the finding.
    :param t: s after the start of the episode; ``state`` and ``action`` at these times, None where
        there is no value.
    """

    finding: int
    joint: str
    unit: str
    t: list[float]
    state: list[float | None] = []
    action: list[float | None] = []


class Shot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a camera saw at the moment of a finding.

    :param finding: index of the finding.
    :param seconds: after the start of the episode.
    :param jpeg: the picture, small, in base64.
    """

    finding: int
    camera: str
    seconds: float
    jpeg: str


class Judgement(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """The verdict on an episode.

    :param figures: by name, what was measured in every episode, for the distributions of a set.
    :param judged: names of the checks for which the episode has the data.
    :param key: digest of the motion; equal for equal data.
    :param shape: the motion in few numbers, to find the same motion in another episode.
    :param kind: digest of its parts, joints and rate; only episodes of one kind are compared.
    :param cameras: names of those that it has.
    :param sums: by feature of a dataset: lowest, highest, mean and standard deviation of each
        element, and the number of frames.
    """

    use: Use = Use.KEEP
    findings: list[Finding] = []
    curves: list[Curve] = []
    shots: list[Shot] = []
    figures: dict[str, float] = {}
    judged: list[str] = []
    key: str = ""
    shape: list[float] = []
    kind: str = ""
    cameras: list[str] = []
    sums: dict[str, list[list[float]]] = {}

    @property
    def reasons(self) -> list[Finding]:
        """The findings that ask for more than to keep it, worst first."""
        order = [Use.DROP, Use.REVIEW]
        found = [f for f in self.findings if f.use in order]
        return sorted(found, key=lambda f: order.index(f.use))


def use_of(findings: Iterable[Finding]) -> Use:
    """The verdict that findings amount to: the worst of them."""
    order = list(Use)
    return max((f.use for f in findings), key=order.index, default=Use.KEEP)
