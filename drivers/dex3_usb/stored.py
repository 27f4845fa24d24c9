"""Settings of single Dex3-1 hands in the user's JSON file, as ``dexkit bringup`` writes them::

    {"2024061800": {"settings": {"motors": "0.0,0.1,...", "signs": "+,-,...", ...},
                    "found":    {"at": "2026-11-23T16:00:00+00:00", "by": "dexkit 0.1", ...},
                    "answers":  {"motor 0.0 joint": "thumb_1", ...}}}

Keys are serial numbers, or ``left`` and ``right`` for hands without one. ``settings`` are names and
texts as ``--set`` takes them. ``found`` says when, by what and on which hand they were found,
``answers`` what the person saw; neither is read by the driver.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dexkit import documents
from dexkit.drivers.dex3_usb.settings import default_path
from dexkit.errors import UsageError
from dexkit.hand import Side

__all__ = ["Store", "record_key"]

_HINT = "correct it, or remove it and run: dexkit bringup dex3-usb"


def record_key(serial: str, side: Side) -> str:
    """Return the key of a hand in the file."""
    return serial or str(side)


class Store:
    """The settings file.

    :param path: by default :func:`~dexkit.drivers.dex3_usb.settings.default_path`.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path if path is not None else default_path()

    def _parse(self, text: str) -> dict[str, Any]:
        content = documents.parse_json(text, self.path, hint=_HINT)
        if not isinstance(content, dict):
            raise UsageError(f"{self.path} must hold a JSON object", hint=_HINT)
        return content

    def record(self, key: str) -> dict[str, Any]:
        """The record of a hand; empty if there is none.

        :raises UsageError: the file cannot be read, or the record is no object.
        """
        # through lexists: a file that is there and cannot be read is an error
        if not self.path.exists() and not self.path.is_symlink():
            return {}
        record = self._parse(documents.read_text(self.path, hint=_HINT)).get(key, {})
        if not isinstance(record, dict):
            raise UsageError(f"{self.path}: {key} must be an object", hint=_HINT)
        return record

    def section(self, key: str, name: str) -> dict[str, str]:
        """One part of a hand's record whose values are texts: ``settings`` or ``answers``.

        :raises UsageError: as :meth:`record`, or it holds anything else.
        """
        section = self.record(key).get(name, {})
        if not isinstance(section, dict):
            raise UsageError(f"{self.path}: {key}: {name} must be an object", hint=_HINT)
        for entry, value in section.items():
            if not isinstance(value, str):
                raise UsageError(
                    f"{self.path}: {key}: {name}: {entry} must be text, not {value!r}", hint=_HINT
                )
        return section

    def write(self, key: str, record: Mapping[str, Any]) -> None:
        """Replace the parts of a hand's record that are given; the others stay.

        :raises UsageError: the file cannot be read or written.
        """

        def change(text: str | None) -> str:
            content = {} if text is None else self._parse(text)
            known = content.get(key, {})
            content[key] = (known if isinstance(known, dict) else {}) | dict(record)
            return json.dumps(content, indent=2, sort_keys=True) + "\n"

        documents.update_file(self.path, change)
