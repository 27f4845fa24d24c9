"""Verify a signed archive: signature, digests, members, and the result by judging again.

What anybody can have written is read in the order of trust: the archive's headers, then the bytes
of manifest and signature, then what the manifest says, and only of an archive without a difference
the result and the recording.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from dexkit import __version__, documents, signatures
from dexkit.conformance.result_file import parse_result
from dexkit.conformance.signed.manifest import (
    LARGEST,
    MANIFEST,
    SIGNATURES,
    Judged,
    Manifest,
)
from dexkit.conformance.signed.rejudge import (
    Comparison,
    compare_with_recording,
    self_differences,
)
from dexkit.conformance.signed.sign import RECORDING_DIGEST
from dexkit.digests import Digest, digest_of
from dexkit.errors import ArchiveError, UsageError
from dexkit.escaping import one_line
from dexkit.signatures import PublicKey
from dexkit.stored_zip import Member, member_pieces, read_directory
from dexkit.temporary_folder import TemporaryFolder

__all__ = ["Verified", "verify_archive"]

_LARGEST_SIGNATURE = 16 * 1024
"""Bytes; one of an RSA key of 16384 bits has about 6000."""


@dataclass
class Verified:
    """Result of a verification.

    :param differences: one line each; none: the archive is verified.
    :param notes: what was verified, and how, one line each.
    :param manifest: None where it could not be read.
    :param key: the key that signed: kind and fingerprint.
    :param comparison: of the result with its recording; None where that was not judged again.
    """

    differences: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    manifest: Manifest | None = None
    key: str = ""
    comparison: Comparison | None = None


def verify_archive(archive: Path, key: PublicKey, *, rejudge: bool = True) -> Verified:
    """Verify an archive.

    :param rejudge: judge the recording again, and compare the result.
    :raises ArchiveError: it is no archive that could be verified.
    :raises UsageError: it cannot be read, or the key is of another tool than the signature.
    :raises SigningError: the tool is missing.
    """
    signatures.require(key.tool)
    with documents.open_ordinary(archive) as file:
        return _Verification(file, archive, key).run(rejudge)


class _Verification:
    def __init__(self, file: BinaryIO, origin: Path, key: PublicKey) -> None:
        self._file = file
        self._origin = origin
        self._key = key
        self._members = {m.name: m for m in read_directory(file, origin)}
        self._found = Verified()

    def run(self, rejudge: bool) -> Verified:
        found = self._found
        data = self._bytes(MANIFEST, LARGEST)
        self._signature(data)
        manifest = None
        if data is not None:
            try:
                manifest = Manifest.decode(data)
            except ArchiveError as why:
                if not found.differences:  # well signed, and yet not understood
                    raise
                found.differences.append(str(why))
        if manifest is None:
            return found
        found.manifest = manifest
        self._files(manifest)
        if found.differences:
            found.notes.append("not judged again, because of these differences")
            return found
        document = self._result(manifest, rejudge)
        if document is not None and rejudge:
            self._compare(manifest, document)
        return found

    def _bytes(self, name: str, most: int) -> bytes | None:
        """A small member; None where it is missing, which is noted.

        :raises ArchiveError: it is larger than ``most``.
        """
        member = self._members.get(name)
        if member is None:
            self._found.differences.append(f"{name}: missing")
            return None
        if member.size > most:
            raise ArchiveError(f"{self._origin}: {name} is larger than {most >> 10} KB")
        data = b"".join(member_pieces(self._file, member))
        if digest_of([data]).crc != member.crc:
            self._found.differences.append(f"{name}: its bytes are not those of its checksum")
        return data

    def _signature(self, data: bytes | None) -> None:
        names = [name for name in SIGNATURES if name in self._members]
        if len(names) > 1:
            raise ArchiveError(f"{self._origin} has two signatures: {' and '.join(names)}")
        wanted = next(n for n, tool in SIGNATURES.items() if tool == self._key.tool)
        if names and names[0] != wanted:
            raise UsageError(
                f"{self._origin} is signed by {SIGNATURES[names[0]]}, and the key is one of "
                f"{self._key.tool}",
                hint=f"give the signer's public key of {SIGNATURES[names[0]]}",
            )
        signature = self._bytes(wanted, _LARGEST_SIGNATURE)
        if data is None or signature is None:
            return
        checked = signatures.check(self._key, data, signature, f"{self._origin}: {wanted}")
        self._found.key = checked.key
        if checked.good:
            who = f", {checked.who}" if checked.who else ""
            self._found.notes.append(f"signature: {MANIFEST} is signed by {checked.key}{who}")
        elif checked.intact:
            self._found.differences.append(
                f"{wanted}: signed by {checked.key}, which is not a key that was given "
                f"({checked.words})"
            )
        else:
            self._found.differences.append(
                f"{wanted}: not a signature of {MANIFEST} by that key; one of the two was changed, "
                f"or another key signed ({checked.words})"
            )

    def _files(self, manifest: Manifest) -> None:
        """Compare the members with the manifest."""
        differences = self._found.differences
        before = len(differences)
        for file in manifest.files:
            member = self._members.get(file.name)
            if member is None:
                differences.append(f"{file.name}: missing")
                continue
            real = self._digest(member)
            if real.size != file.size:
                differences.append(
                    f"{file.name}: {real.size} bytes, and {file.size} in the manifest"
                )
            elif real.sha256 != file.sha256:
                differences.append(
                    f"{file.name}: changed: its SHA-256 is {real.sha256}, and {file.sha256} in the "
                    "manifest"
                )
            elif real.crc != member.crc:
                differences.append(f"{file.name}: its bytes are not those of its checksum")
        listed = {f.name for f in manifest.files} | {MANIFEST, *SIGNATURES}
        differences += [f"{n}: not in the manifest" for n in self._members if n not in listed]
        if len(differences) == before:
            names = ", ".join(f.name for f in manifest.files)
            self._found.notes.append(
                f"files: size and SHA-256 of {names} are those of the manifest; no other file"
            )

    def _digest(self, member: Member) -> Digest:
        return digest_of(member_pieces(self._file, member))

    def _result(self, manifest: Manifest, rejudge: bool) -> Any:
        """The document of the result; None where the other files do not agree with it."""
        file = manifest.file("result")
        assert file is not None, "a manifest lists a result"
        name = f"{self._origin}: {file.name}"
        document = documents.parse_json(self._text(file.name, name), name)
        found = parse_result(document, name)
        differences = self._found.differences
        if not rejudge:
            self._found.notes.append(f"{file.name}: not judged again, as was asked for")
            differences += [
                f"{file.name}: {d.path} is not what follows from the result's own verdicts"
                for d in self_differences(document, found)
            ]
        differences += _manifest_differences(manifest.judged, Judged.from_result(found))
        recording, page = manifest.file("recording"), manifest.file("page")
        named = found.subject.get(RECORDING_DIGEST, "")
        if recording is not None and named != recording.sha256:
            differences.append(
                f"{recording.name}: not the recording that the result was judged from, whose "
                f"SHA-256 is {named or 'not in the result'}"
            )
        if page is not None:
            if named not in self._text(page.name, page.name):
                differences.append(f"{page.name}: does not show the digest of the recording")
            self._found.notes.append(
                f"page: {page.name} is not compared with the result, and may show anything beside "
                f"the digest; write your own: dexkit report {file.name} --report PAGE.html"
            )
        return None if differences else document

    def _text(self, name: str, where: str) -> str:
        member = self._members[name]
        if member.size > documents.LARGEST:
            raise ArchiveError(f"{where} is larger than {documents.LARGEST >> 20} MB")
        try:
            return b"".join(member_pieces(self._file, member)).decode("utf-8-sig")
        except UnicodeDecodeError as why:
            raise ArchiveError(f"{where} is not UTF-8 text (at byte {why.start})") from None

    def _compare(self, manifest: Manifest, document: Any) -> None:
        notes = self._found.notes
        result, recording = manifest.file("result"), manifest.file("recording")
        assert result is not None, "a manifest lists a result"
        assert recording is not None, "a manifest lists a recording"
        with TemporaryFolder("verify") as folder:
            path = folder / "recording.mcap"
            documents.write_file(path, member_pieces(self._file, self._members[recording.name]))
            compared = compare_with_recording(document, path)
        self._found.comparison = compared
        self._found.differences += [f"{result.name}: {d}" for d in compared.differences]
        if compared.differences:
            made_by = document["environment"].get("dexkit", "of an unknown version")
            if made_by != __version__:
                self._found.differences.append(
                    f"{result.name}: dexkit {made_by} judged, and this is {__version__}: verify "
                    "with that version"
                )
        else:
            notes.append(
                f"result: {recording.name} was judged again by dexkit {__version__}, with all "
                f"requirements that apply, and gives all of {result.name} but what is stated below"
            )
        notes += compared.remarks
        notes += compared.part()
        notes += [
            f"stated by the signer, not verified: {path} {json.dumps(value, ensure_ascii=False)}"
            for path, value in compared.stated.items()
        ]


def _manifest_differences(said: Judged, real: Judged) -> list[str]:
    """Statements of the manifest that the result contradicts."""
    there, here = (
        {**judged.about, "overall": judged.overall, **judged.grades} for judged in (said, real)
    )
    return [
        f"{MANIFEST}: {name} is {one_line(there[name])!r} there, and {one_line(text)!r} in the "
        "result"
        for name, text in here.items()
        if there[name] != text
    ]
