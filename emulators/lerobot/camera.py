"""Pictures as LeRobot's camera server sends them: a test card that moves.

The emulated robot has no camera. A client needs pictures of the right size at the right rate, each
different from the last.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterator, Sequence
from itertools import cycle

from dexkit.errors import ExtraMissing

__all__ = ["CAMERA", "FPS", "SIZE", "camera_json", "moving_cards"]

CAMERA = "head_camera"
"""The name that LeRobot's server gives to its only camera."""
SIZE = (640, 480)
"""Pixels, as LeRobot's server takes by default."""
FPS = 30.0
"""Pictures a second, likewise."""

_BARS = ("#c0c0c0", "#c0c000", "#00c0c0", "#00c000", "#c000c0", "#c00000", "#0000c0")
_COUNT = 10  # different pictures


def moving_cards() -> Iterator[str]:
    """Yield pictures without end: JPEG in base64, colour bars with a white column that moves
    across.

    :raises ExtraMissing: Pillow is not installed.
    """
    try:
        from PIL import Image, ImageDraw
    except ImportError as error:
        raise ExtraMissing(
            "the camera's pictures need the package pillow", hint="pip install 'dexkit[zmq]'"
        ) from error
    width, height = SIZE
    cards = []
    for number in range(_COUNT):
        picture = Image.new("RGB", SIZE)
        draw = ImageDraw.Draw(picture)
        for i, colour in enumerate(_BARS):
            left = i * width // len(_BARS)
            draw.rectangle((left, 0, width, height), fill=colour)
        x = number * width // _COUNT
        draw.rectangle((x, 0, x + width // _COUNT, height), fill="#ffffff")
        out = io.BytesIO()
        picture.save(out, "JPEG", quality=80)
        cards.append(base64.b64encode(out.getvalue()).decode("ascii"))
    return cycle(cards)


def camera_json(names: Sequence[str], picture: str, taken: float) -> bytes:
    """One message: the same picture from each camera.

    :param taken: seconds since the epoch.
    """
    images = dict.fromkeys(names, picture)
    return json.dumps({"timestamps": dict.fromkeys(names, taken), "images": images}).encode()
