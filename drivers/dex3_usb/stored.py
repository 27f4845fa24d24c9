"""Settings of single Dex3-1 hands in the user's JSON file (:mod:`dexkit.bringup.settings_file`).

Keys are serial numbers, or ``left`` and ``right`` for hands without one.
"""

from __future__ import annotations

from pathlib import Path

from dexkit.bringup.settings_file import SettingsFile
from dexkit.drivers.dex3_usb.settings import default_path
from dexkit.hand import Side

__all__ = ["Store", "record_key"]


def record_key(serial: str, side: Side) -> str:
    """Return the key of a hand in the file."""
    return serial or str(side)


class Store(SettingsFile):
    """The settings file.

    :param path: by default :func:`~dexkit.drivers.dex3_usb.settings.default_path`.
    """

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path if path is not None else default_path(), "dex3-usb")
