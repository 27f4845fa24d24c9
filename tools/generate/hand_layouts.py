"""Layouts of the drawings of hands with several joints; schematic, not to scale."""

from __future__ import annotations

from dataclasses import dataclass

from dexkit.models import BRAINCO_REVO2, DEX3_1, DEX5_1, INSPIRE_DFX, INSPIRE_FTP

__all__ = ["LAYOUTS", "Finger", "HandLayout"]


@dataclass(frozen=True)
class Finger:
    """Joints of a drawn finger, one behind the other; lengths in px, y downward.

    :param name: of the finger; sensor packets are found by it (``"thumb pad"``).
    :param joints: their indices, from the palm outward.
    :param start: place of the first joint, relative to the palm's centre.
    :param step: from one joint to the next.
    :param tip: from the last joint to the end, in steps.
    :param root: from its beginning, which the palm may hide, to the first joint, in steps.
    """

    name: str
    joints: range
    start: tuple[float, float]
    step: tuple[float, float]
    tip: float
    root: float = 0.4

    def along(self, steps: float) -> tuple[float, float]:
        """The place so many steps behind the first joint."""
        (x, y), (dx, dy) = self.start, self.step
        return x + steps * dx, y + steps * dy

    @property
    def end(self) -> tuple[float, float]:
        """Position of its tip."""
        return self.along(len(self.joints) - 1 + self.tip)


@dataclass(frozen=True)
class HandLayout:
    """Layout of the drawing of a hand with several joints; schematic, not to scale, lengths in px.

    :param centres: x of the left and of the right hand.
    :param top: y of the palm's centre on the sheet.
    :param palm: its size.
    :param width: of a finger.
    :param fingers: of a left hand, the palm toward the reader.
    :param palm_sensors: where the palm's sensor packets are.
    """

    centres: tuple[float, float]
    top: float
    palm: tuple[float, float]
    width: float
    fingers: tuple[Finger, ...]
    palm_sensors: tuple[tuple[float, float], ...] = ()


_DEX3 = HandLayout(
    centres=(256.0, 624.0),
    top=432.0,
    palm=(206.0, 150.0),
    width=76.0,
    fingers=(
        Finger("thumb", range(0, 3), (-122.0, 28.0), (-12.0, -72.0), tip=1.35, root=0.1),
        Finger("middle", range(3, 5), (52.0, -108.0), (0.0, -72.0), tip=1.35),
        Finger("index", range(5, 7), (-38.0, -108.0), (0.0, -72.0), tip=1.35),
    ),
    palm_sensors=((10.0, -40.0), (-24.0, 34.0), (44.0, 34.0)),
)
_DEX5 = HandLayout(
    centres=(240.0, 640.0),
    top=466.0,
    palm=(280.0, 130.0),
    width=62.0,
    fingers=(
        Finger("index", range(0, 4), (-108.0, -90.0), (0.0, -66.0), tip=0.15),
        Finger("middle", range(4, 8), (-36.0, -106.0), (0.0, -66.0), tip=0.15, root=0.7),
        Finger("ring", range(8, 12), (36.0, -90.0), (0.0, -66.0), tip=0.15),
        Finger("little", range(12, 16), (108.0, -66.0), (0.0, -66.0), tip=0.15),
        Finger("thumb", range(16, 20), (-167.0, 26.0), (-9.0, -66.0), tip=0.15, root=0.1),
    ),
)
_BRAINCO = HandLayout(
    centres=(240.0, 640.0),
    top=466.0,
    palm=(280.0, 130.0),
    width=62.0,
    fingers=(
        Finger("Index", range(2, 3), (-108.0, -90.0), (0.0, -150.0), tip=1.0),
        Finger("Middle", range(3, 4), (-36.0, -106.0), (0.0, -150.0), tip=1.0),
        Finger("Ring", range(4, 5), (36.0, -90.0), (0.0, -150.0), tip=1.0),
        Finger("Pinky", range(5, 6), (108.0, -66.0), (0.0, -120.0), tip=1.0),
        Finger("Thumb", range(0, 2), (-167.0, 26.0), (-9.0, -66.0), tip=1.0, root=0.1),
    ),
)
_INSPIRE = HandLayout(
    centres=(240.0, 640.0),
    top=466.0,
    palm=(280.0, 130.0),
    width=62.0,
    fingers=(
        Finger("Index", range(3, 4), (-108.0, -90.0), (0.0, -150.0), tip=1.0),
        Finger("Middle", range(2, 3), (-36.0, -106.0), (0.0, -150.0), tip=1.0),
        Finger("Ring", range(1, 2), (36.0, -90.0), (0.0, -150.0), tip=1.0),
        Finger("Pinky", range(0, 1), (108.0, -66.0), (0.0, -120.0), tip=1.0),
        Finger("Thumb", range(4, 6), (-167.0, 26.0), (-9.0, -66.0), tip=1.0, root=0.1),
    ),
)

LAYOUTS = {
    model.name: layout
    for model, layout in (
        (DEX3_1, _DEX3),
        (DEX5_1, _DEX5),
        (BRAINCO_REVO2, _BRAINCO),
        (INSPIRE_DFX, _INSPIRE),
        (INSPIRE_FTP, _INSPIRE),
    )
}
"""By the model's name."""
