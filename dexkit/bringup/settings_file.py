"""Settings of single hands in the user's JSON files, as ``dexkit bringup`` writes them::

    {"2024061800": {"settings": {"motors": "0.0,0.1,...", "signs": "+,-,...", ...},
                    "found":    {"at": "2026-11-23T16:00:00+00:00", "by": "dexkit 0.1", ...},
                    "answers":  {"motor 0.0 joint": "thumb_1", ...}}}

Keys are the driver's. ``settings`` are names and texts as ``--set`` takes them. ``found`` says
when, by what and on which hand they were found, ``answers`` what the person saw; neither is read
by a driver.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dexkit import __version__, documents
from dexkit.bringup.findings import Findings
from dexkit.errors import UsageError

__all__ = ["SettingsFile"]


class SettingsFile:
    """A file with settings of single hands.

    :param backend: whose ``dexkit bringup`` writes it; for messages.
    """

    def __init__(self, path: Path, backend: str) -> None:
        self.path = path
        self._hint = f"correct it, or remove it and run: dexkit bringup {backend}"

    def _parse(self, text: str) -> dict[str, Any]:
        content = documents.parse_json(text, self.path, hint=self._hint)
        if not isinstance(content, dict):
            raise UsageError(f"{self.path} must hold a JSON object", hint=self._hint)
        return content

    def record(self, key: str) -> dict[str, Any]:
        """The record of a hand; empty if there is none.

        :raises UsageError: the file cannot be read, or the record is no object.
        """
        # through lexists: a file that is there and cannot be read is an error
        if not self.path.exists() and not self.path.is_symlink():
            return {}
        record = self._parse(documents.read_text(self.path, hint=self._hint)).get(key, {})
        if not isinstance(record, dict):
            raise UsageError(f"{self.path}: {key} must be an object", hint=self._hint)
        return record

    def section(self, key: str, name: str) -> dict[str, str]:
        """One part of a hand's record whose values are texts: ``settings`` or ``answers``.

        :raises UsageError: as :meth:`record`, or it holds anything else.
        """
        section = self.record(key).get(name, {})
        if not isinstance(section, dict):
            raise UsageError(f"{self.path}: {key}: {name} must be an object", hint=self._hint)
        for entry, value in section.items():
            if not isinstance(value, str):
                raise UsageError(
                    f"{self.path}: {key}: {name}: {entry} must be text, not {value!r}",
                    hint=self._hint,
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

    def load(self, key: str) -> Findings:
        """Load the findings of a bring-up of a hand; empty if there was none.

        :raises UsageError: the file cannot be read.
        """
        found = self.record(key).get("found", {})
        document = found.get("details", {}) if isinstance(found, dict) else {}
        return Findings.from_document(document, self.section(key, "answers"))

    def store(
        self, key: str, settings: Mapping[str, str], facts: Mapping[str, Any], findings: Findings
    ) -> None:
        """Write settings, findings and answers, with the time and the identity of the hand.

        :param facts: identity of the hand and what answered.
        :raises UsageError: the file cannot be read or written.
        """
        now = datetime.datetime.now(datetime.timezone.utc)
        self.write(
            key,
            {
                "settings": dict(settings),
                "found": {
                    "at": now.isoformat(timespec="seconds"),
                    "by": f"dexkit {__version__} bringup",
                    "hand": dict(facts),
                    "details": findings.to_document(),
                },
                "answers": dict(findings.answers),
            },
        )
