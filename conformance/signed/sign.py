"""Put a result, its recording and its page into a signed archive."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dexkit import __version__, documents, signatures
from dexkit.conformance.result_file import parse_result
from dexkit.conformance.results import RunResult
from dexkit.conformance.signed.manifest import (
    LARGEST,
    MANIFEST,
    SIGNATURES,
    File,
    Judged,
    Manifest,
)
from dexkit.conformance.signed.rejudge import self_differences
from dexkit.digests import Digest, digest_of, file_pieces
from dexkit.errors import ConformanceError, SigningError, UsageError
from dexkit.stored_zip import Content, is_safe_name, pack

__all__ = ["RECORDING_DIGEST", "Signed", "sign_result"]

RECORDING_DIGEST = "recording_sha256"
"""The member of a result's subject that names the recording it was judged from."""


@dataclass(frozen=True)
class Signed:
    """Result of signing.

    :param key: the key that signed: kind and fingerprint.
    :param recording: how the recording was found to be the one that was judged.
    :param page: likewise of the page; empty without one.
    """

    manifest: Manifest
    key: str
    recording: str
    page: str


def sign_result(
    result: Path, recording: Path, page: Path | None, *, key: Path, tool: str, output: Path
) -> Signed:
    """Write a signed archive.

    :param tool: :data:`dexkit.signatures.SSH_KEYGEN` or :data:`~dexkit.signatures.MINISIGN`.
    :raises UsageError: a file cannot be used, or has a name that an archive cannot hold.
    :raises ConformanceError: the recording, or the page, is not that of the result.
    :raises SigningError: the tool is missing, or cannot use the key.
    :raises OutputError: the archive cannot be written.
    """
    signatures.require(tool)
    paths = {"result": result, "recording": recording}
    if page is not None:
        paths["page"] = page
    _check_names(paths)
    document = documents.read_json(result)
    found = parse_result(document, result)
    wrong = self_differences(document, found)
    if wrong:
        raise ConformanceError(
            f"{result} was changed, or an earlier dexkit wrote it: {wrong[0].path} is not what "
            "follows from its verdicts",
            hint=f"judge again: dexkit check {recording} --json RESULT.json",
        )
    digests = {role: digest_of(file_pieces(path)) for role, path in paths.items()}
    how = _match_recording(found, recording, digests["recording"])
    shown = "" if page is None else _match_page(found, page)
    manifest = Manifest(
        files=[File(r, paths[r].name, d.size, d.sha256) for r, d in digests.items()],
        judged=Judged.from_result(found),
        dexkit=__version__,
    )
    data = manifest.encode()
    if len(data) > LARGEST:
        raise ConformanceError(f"the manifest of {result} would be larger than {LARGEST >> 10} KB")
    signature, signer = signatures.sign(tool, data, key)
    name = next(n for n, t in SIGNATURES.items() if t == tool)
    contents = [_of_bytes(MANIFEST, data), _of_bytes(name, signature)]
    contents += [
        Content(paths[role].name, digest.size, digest.crc, partial(_same, paths[role], digest))
        for role, digest in digests.items()
    ]
    documents.write_file(output, pack(contents))
    return Signed(manifest, signer, how, shown)


def _check_names(paths: dict[str, Path]) -> None:
    """Check that each file can be in an archive under its own name.

    :raises UsageError: one cannot.
    """
    taken = {name.casefold() for name in (MANIFEST, *SIGNATURES)}
    for role, path in paths.items():
        if not is_safe_name(path.name) or path.name.casefold() in taken:
            raise UsageError(
                f"the {role} cannot be in an archive under the name {path.name!r}",
                hint="rename it: at most 100 letters, digits and ._+=@,()- and none of the others' "
                "names",
            )
        taken.add(path.name.casefold())


def _match_recording(found: RunResult, recording: Path, digest: Digest) -> str:
    """Describe the evidence that the recording is the judged one.

    :raises ConformanceError: it is another one.
    """
    named = found.subject.get(RECORDING_DIGEST, "")
    if named != digest.sha256:
        raise ConformanceError(
            f"{recording} is not the recording that the result was judged from: its SHA-256 is "
            f"{digest.sha256}, that of the result's recording {named or 'is not in the result'}",
            hint="give the recording that was judged with --recording, or judge this one: "
            f"dexkit check {recording} --json RESULT.json",
        )
    return "the result names its SHA-256 digest"


def _match_page(found: RunResult, page: Path) -> str:
    """Describe the evidence that the page is about the same recording.

    :raises ConformanceError: it is not.
    """
    text = documents.read_text(page)
    if found.subject[RECORDING_DIGEST] not in text:
        raise ConformanceError(
            f"{page} does not show the digest of the recording that the result was judged from",
            hint="write the page of this result: dexkit report RESULT.json --report PAGE.html",
        )
    return "it shows the digest of the recording; nothing else on it is compared"


def _of_bytes(name: str, data: bytes) -> Content:
    digest = digest_of([data])
    return Content(name, digest.size, digest.crc, lambda: [data])


def _same(path: Path, before: Digest) -> Iterator[bytes]:
    """The pieces of a file, which must be what was measured before.

    :raises SigningError: it was changed in between, or cannot be read.
    """
    left, sha = before.size, hashlib.sha256()
    for piece in file_pieces(path, error=SigningError):
        left -= len(piece)
        sha.update(piece)
        yield piece
    if left or sha.hexdigest() != before.sha256:
        raise SigningError(f"{path} was changed while it was signed", hint="sign again")
