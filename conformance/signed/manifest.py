"""The manifest of a signed archive: its files with digests, and the judged hand, as JSON.

The signature is over the bytes of the manifest. Through the digests it covers all other files.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dexkit import documents
from dexkit.conformance.report.labels import device_kind
from dexkit.conformance.requirements import Kind
from dexkit.conformance.results import Overall, RunResult
from dexkit.errors import ArchiveError
from dexkit.escaping import one_line
from dexkit.signatures import MINISIGN, SSH_KEYGEN
from dexkit.stored_zip import LARGEST_MEMBER, is_safe_name

__all__ = [
    "FORMAT",
    "INCOMPLETE",
    "LARGEST",
    "MANIFEST",
    "SIGNATURES",
    "VERSION",
    "File",
    "Judged",
    "Manifest",
]

FORMAT = "dexkit-signed-result"
VERSION = 1
LARGEST = 64 * 1024
"""Bytes of a manifest; one with all that it can hold has less than half of them."""
MANIFEST = "manifest.json"
INCOMPLETE = "incomplete"
"""Word for a part of the requirements of which no MUST failed: no pass, as the others may fail."""
SIGNATURES = {"manifest.json.sig": SSH_KEYGEN, "manifest.json.minisig": MINISIGN}
"""Names of the signature, by the tool that makes it."""
ROLES = ("result", "recording", "page")
_LONGEST = 1000  # characters of a text
_SHA256 = re.compile(r"[0-9a-f]{64}")
_ABOUT = (
    "model",
    "dialect",
    "sides",
    "hand",
    "backend",
    "device",
    "nature",
    "requirements",
    "recorded_at",
    "dexkit",
)


@dataclass(frozen=True)
class File:
    """One file of an archive.

    :param role: ``result``, ``recording`` or ``page``.
    :param size: bytes.
    :param sha256: hexadecimal digits, lower case.
    """

    role: str
    name: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Judged:
    """The judged subject, as stated in the result.

    :param about: model, dialect, sides, hand, backend, device; ``nature``: emulated, simulated,
        recorded or empty; ``requirements``: how many of how many; recorded_at; ``dexkit``: the
        version that judged. Empty where the result does not say.
    :param overall: pass, fail or inconclusive; :data:`INCOMPLETE` instead of a pass where only a
        part of the requirements was judged.
    :param grades: likewise of each kind of requirement; or "not judged".
    """

    about: Mapping[str, str]
    overall: str
    grades: Mapping[str, str]

    @classmethod
    def from_result(cls, result: RunResult) -> Judged:
        """Read it from a result; long texts are cut."""
        count = sum(result.counts().values())
        known = {
            **result.subject,
            "nature": device_kind(result),
            "requirements": f"{count} of {result.catalogue}" if result.partial else str(count),
            "recorded_at": result.recorded_at,
            "dexkit": result.environment.get("dexkit", ""),
        }
        return cls(
            about={name: one_line(known.get(name, ""), _LONGEST) for name in _ABOUT},
            overall=_word(result.overall, result.partial),
            grades={str(kind): _grade_word(result, kind) for kind in Kind},
        )


def _grade_word(result: RunResult, kind: Kind) -> str:
    grade = result.grade(kind)
    return _word(grade.overall, result.partial) if grade.judged else "not judged"


def _word(overall: Overall, is_part: bool) -> str:
    return INCOMPLETE if is_part and overall is Overall.PASS else str(overall)


@dataclass(frozen=True)
class Manifest:
    """A manifest.

    :param dexkit: the version that wrote it.
    """

    files: Sequence[File]
    judged: Judged
    dexkit: str

    def file(self, role: str) -> File | None:
        """The file of that role."""
        return next((f for f in self.files if f.role == role), None)

    def encode(self) -> bytes:
        """The manifest as it is in an archive."""
        document = {
            "format": FORMAT,
            "version": VERSION,
            "dexkit": self.dexkit,
            "files": [
                {"role": f.role, "name": f.name, "size": f.size, "sha256": f.sha256}
                for f in self.files
            ],
            "judged": {
                **{name: self.judged.about[name] for name in _ABOUT},
                "overall": self.judged.overall,
                "grades": {str(kind): self.judged.grades[str(kind)] for kind in Kind},
            },
        }
        return (json.dumps(document, indent=2) + "\n").encode("ascii")

    @classmethod
    def decode(cls, data: bytes, origin: str = MANIFEST) -> Manifest:
        """Read a manifest.

        :raises ArchiveError: it is none, of an unknown version, or too large.
        """
        if len(data) > LARGEST:
            raise ArchiveError(f"{origin} is larger than {LARGEST >> 10} KB")
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError as why:
            raise ArchiveError(f"{origin} is not UTF-8 text (at byte {why.start})") from None
        document = documents.parse_json(text, origin, error=ArchiveError)
        if not isinstance(document, dict) or document.get("format") != FORMAT:
            raise ArchiveError(f"{origin} is not the manifest of a signed result")
        version = document.get("version")
        if version != VERSION or isinstance(version, bool):
            raise ArchiveError(
                f"{origin} is version {one_line(version, 40)} of {FORMAT}",
                hint="a newer dexkit may be able to read it",
            )
        _has(document, ("format", "version", "dexkit", "files", "judged"), origin)
        judged = document["judged"]
        _has(judged, (*_ABOUT, "overall", "grades"), f"{origin}: judged")
        _has(judged["grades"], tuple(map(str, Kind)), f"{origin}: grades")
        return cls(
            files=_files(document["files"], origin),
            judged=Judged(
                {name: _text(judged[name], f"{origin}: {name}") for name in _ABOUT},
                _text(judged["overall"], f"{origin}: overall"),
                {k: _text(v, f"{origin}: {k}") for k, v in judged["grades"].items()},
            ),
            dexkit=_text(document["dexkit"], f"{origin}: dexkit"),
        )


def _files(entries: Any, origin: str) -> tuple[File, ...]:
    """The files that a manifest lists.

    :raises ArchiveError: a role or name occurs twice or is not allowed; no result or recording.
    """
    if not isinstance(entries, list) or len(entries) > len(ROLES):
        raise ArchiveError(f"{origin}: files must be a list of at most {len(ROLES)}")
    found: list[File] = []
    taken = {name.casefold() for name in (MANIFEST, *SIGNATURES)}
    for entry in entries:
        _has(entry, ("role", "name", "size", "sha256"), f"{origin}: files")
        role, name, size, sha256 = (entry[k] for k in ("role", "name", "size", "sha256"))
        if role not in ROLES or any(f.role == role for f in found):
            raise ArchiveError(f"{origin}: {one_line(role, 40)!r} is not a role, or occurs twice")
        if not isinstance(name, str) or not is_safe_name(name) or name.casefold() in taken:
            raise ArchiveError(f"{origin}: {one_line(name, 120)!r} cannot be the name of a file")
        if type(size) is not int or not 0 <= size <= LARGEST_MEMBER:
            raise ArchiveError(f"{origin}: {one_line(size, 40)} is not a size in bytes")
        if not isinstance(sha256, str) or not _SHA256.fullmatch(sha256):
            raise ArchiveError(f"{origin}: {one_line(sha256, 80)!r} is not a SHA-256 digest")
        taken.add(name.casefold())
        found.append(File(role, name, size, sha256))
    if not {"result", "recording"} <= {f.role for f in found}:
        raise ArchiveError(f"{origin} lists no result, or no recording")
    return tuple(found)


def _has(document: Any, names: Sequence[str], where: str) -> None:
    """Check that a document is an object with just these members.

    :raises ArchiveError: it is not.
    """
    if not isinstance(document, dict) or document.keys() != set(names):
        raise ArchiveError(f"{where} must have just the members {', '.join(names)}")


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST:
        raise ArchiveError(f"{where} must be a text of at most {_LONGEST} characters")
    return value
