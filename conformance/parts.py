"""Which joints of a hand of several play which part: known to stimuli and checks alike."""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.models import DEX3_1, DEX5_1

__all__ = ["PARTS", "Parts"]


@dataclass(frozen=True)
class Parts:
    """Which joints are used for what, by index.

    :param driven: when commands stop: those driven by a velocity.
    :param slow: those then on a slow way to a position.
    :param crossed: the joints that get each other's id; the first is told to move. Their limits
        are equal, so that a hand that goes by the id can move the other one.
    """

    driven: tuple[int, int]
    slow: tuple[int, int]
    crossed: tuple[int, int] = (0, 0)


PARTS = {
    DEX3_1.name: Parts((3, 4), (5, 6), crossed=(4, 6)),
    # first flexing joints of four fingers: none of them shares its motor
    DEX5_1.name: Parts((1, 5), (9, 13)),
}
"""The parts of each model."""
