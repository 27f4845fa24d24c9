"""Signed archives, damaged or made by a hostile signer, as ``dexkit verify`` reads them.

A signature stands as good here: what is signed may be as hostile as what is not. Most changed files
get right sizes and digests again.
"""

from __future__ import annotations

import contextlib
import json
import random
import tempfile
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from dexkit import signatures
from dexkit.conformance.result_file import read_json
from dexkit.conformance.signed.manifest import MANIFEST, SIGNATURES, File, Judged, Manifest
from dexkit.conformance.signed.sign import RECORDING_DIGEST
from dexkit.digests import digest_of
from dexkit.messages import message_type
from dexkit.stored_zip import Content, pack
from dexkit.traces.recorder import Recorder
from tools.campaign.children import scratch_root
from tools.campaign.fuzz.case import FuzzCase, Target
from tools.campaign.fuzz.ground import Ground, command_line
from tools.campaign.fuzz.messages import filled
from tools.campaign.fuzz.recordings import TIME, TYPES, damage
from tools.campaign.mutate import damaged_json, mutator

__all__ = ["cases"]

_ARCHIVE = "signed.zip"
_SIGNATURE = next(n for n, tool in SIGNATURES.items() if tool == signatures.SSH_KEYGEN)
_KEY = b"ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA a\n"
_WORDS = (
    "result", "recording", "page", MANIFEST, "result.json", "run.mcap", "page.html", "../x", "pass",
    "fail", "inconclusive", "MUST", "dex1-1", "left", "right", "not judged", "0" * 64, "\u202e",
)  # fmt: skip


@cache
def _members() -> Mapping[str, bytes]:
    """The files of a valid archive, by name; its recording is of one topic, and short."""
    rng = random.Random(1)
    with tempfile.TemporaryDirectory(dir=scratch_root()) as name:
        folder = Path(name)
        with Recorder(folder / "run.mcap") as recorder:
            topic, kind = next(iter(TYPES.items()))
            for i in range(40):
                data = message_type(kind).encode(filled(kind, rng))
                recorder.put(topic, kind, data, TIME + 10_000_000 * i, TIME + 10_000_000 * i)
        files = ("--json", folder / "result.json", "--report", folder / "page.html")
        command_line(("check", folder / "run.mcap", *files))
        found = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        judged = Judged.from_result(read_json(folder / "result.json"))
    roles = {"result.json": "result", "run.mcap": "recording", "page.html": "page"}
    listed = [File(role, name, *_size_and_digest(found[name])) for name, role in roles.items()]
    return {MANIFEST: Manifest(listed, judged, "1").encode(), _SIGNATURE: b"good", **found}


def _size_and_digest(data: bytes) -> tuple[int, str]:
    digest = digest_of([data])
    return digest.size, digest.sha256


def _packed(members: Mapping[str, bytes]) -> bytes:
    contents = []
    for name, data in members.items():
        crc = zlib.crc32(data)
        contents.append(Content(name, len(data), crc, lambda data=data: [data]))  # type: ignore[misc]
    return b"".join(pack(contents))


def _with_right_digests(members: Mapping[str, bytes]) -> dict[str, bytes]:
    """The files with each other's sizes and digests, as a hostile signer puts them there."""
    found = dict(members)
    result = json.loads(found["result.json"])
    if isinstance(result, dict) and isinstance(result.get("subject"), dict):
        result["subject"][RECORDING_DIGEST] = digest_of([found["run.mcap"]]).sha256
        found["result.json"] = json.dumps(result).encode()
    document = json.loads(found[MANIFEST])
    for file in document["files"]:
        file["size"], file["sha256"] = _size_and_digest(found[file["name"]])
    return {**found, MANIFEST: json.dumps(document).encode()}


def _verified(rng: random.Random, scratch: Path) -> Target:
    members = _members()
    whole = _packed(members)
    ground = Ground(scratch, {_ARCHIVE: whole, "key.pub": _KEY}, {"x": b"x"})
    bytewise = mutator([whole], rng)
    # headers and the directory, of which most bytes of the archive are not
    small = _packed({name: data[:40] for name, data in members.items()})
    headers = mutator([small], rng)
    result = json.loads(members["result.json"])
    manifest = json.loads(members[MANIFEST])

    def change() -> bytes:
        chance = rng.random()
        if chance < 0.15:
            return bytewise()
        if chance < 0.35:
            return headers()
        changed = dict(members)
        if chance < 0.6:
            changed[MANIFEST] = damaged_json(manifest, rng, _WORDS).encode()
            return _packed(changed)
        if chance < 0.8:
            changed["result.json"] = damaged_json(result, rng, _WORDS).encode()
        elif chance < 0.9:
            changed["run.mcap"] = damage(rng, changed["run.mcap"])
        else:
            name = rng.choice((_SIGNATURE, "page.html", "other"))
            changed[name] = rng.randbytes(rng.choice((0, 10, 20_000)))
        if rng.random() < 0.8:
            with contextlib.suppress(ValueError, RecursionError):  # no JSON any more
                changed = _with_right_digests(changed)
        return _packed(changed)

    def commands(ground: Ground, top: str, number: int) -> None:
        options = [] if number % 4 == 0 else ["--no-rejudge"]
        key = ground.sources / "key.pub"
        ground.dexkit("verify", ground.sources / _ARCHIVE, "--public-key", key, *options)

    check, require = signatures.check, signatures.require
    signatures.check = lambda *given: signatures.Checked(True, key="k")
    signatures.require = lambda tool: tool

    def close() -> None:
        signatures.check, signatures.require = check, require
        ground.close()

    return Target(
        lambda: _ARCHIVE.encode() + b"\n" + change(),
        lambda data: ground.run(data, commands),
        close=close,
    )


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    return [
        FuzzCase(
            "archive",
            "signed archives, verified",
            _verified,
            size=60,
            aim=50_000,
            weight=4.0,
            hang=10.0,
        )
    ]
