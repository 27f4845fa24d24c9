"""Signed archives: what is signed is verified, and every change of it is found and named."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import struct
import subprocess
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit import signatures
from dexkit.cli import report as report_command
from dexkit.conformance.requirements import Kind
from dexkit.conformance.result_file import parse_result, read_json
from dexkit.conformance.results import RunResult, Verdict
from dexkit.conformance.signed import manifest as manifests
from dexkit.conformance.signed import sign as signing
from dexkit.conformance.signed.manifest import MANIFEST, File, Judged, Manifest
from dexkit.digests import digest_of, sha256_of_file
from dexkit.errors import ArchiveError, DexkitError, UsageError
from dexkit.stored_zip import Content, is_safe_name, member_pieces, pack, read_directory
from dexkit.traces import sample_path
from tests import hostile
from tests.each import each
from tests.optional import minisign, ssh_keygen

needs_ssh = pytest.mark.skipif(not ssh_keygen(), reason="ssh-keygen is not installed")
needs_minisign = pytest.mark.skipif(not minisign(), reason="minisign is not installed")
SIGNATURE = "manifest.json.sig"
NAMES = ("result.json", "run.mcap", "page.html", MANIFEST, SIGNATURE)


def dexkit(*arguments: object) -> tuple[int, str, str]:
    code, out, err = hostile.run_command([str(a) for a in arguments])
    assert "Traceback" not in err
    return code, out, err


def ssh_key(path: Path) -> Path:
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "a comment", "-f", str(path)]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)
    return path


@dataclass(frozen=True)
class Signed:
    """A result, its recording and page, a key, and the archive of them."""

    folder: Path
    archive: Path
    key: Path

    @property
    def public(self) -> Path:
        return self.key.with_suffix(".pub")

    @property
    def result(self) -> Path:
        return self.folder / "result.json"


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a result, the recording that it was judged from, and its page."""
    folder = tmp_path_factory.mktemp("judged")
    shutil.copy(sample_path("dex1_hand_dropout"), folder / "run.mcap")
    files = ("--json", folder / "result.json", "--report", folder / "page.html")
    code, _, err = dexkit("check", folder / "run.mcap", *files)
    assert code == 1, err  # a hand that drops out
    return folder


@pytest.fixture(scope="module")
def signed(judged: Path) -> Signed:
    if not ssh_keygen():
        pytest.skip("ssh-keygen is not installed")
    key = ssh_key(judged / "key")
    archive = judged / "signed.zip"
    code, out, err = dexkit(
        "sign", judged / "result.json", "--page", judged / "page.html", "--key", key, "-o", archive
    )
    assert code == 0, err
    assert "the result names its SHA-256 digest" in out
    return Signed(judged, archive, key)


def contents(archive: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(archive) as file:
        return {name: file.read(name) for name in file.namelist()}


def write(path: Path, members: dict[str, bytes]) -> Path:
    """An archive in dexkit's form, with right checksums."""
    listed = []
    for name, data in members.items():
        digest = digest_of([data])
        listed.append(Content(name, digest.size, digest.crc, lambda data=data: [data]))
    path.write_bytes(b"".join(pack(listed)))
    return path


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def verify(archive: Path, key: Path, *more: str) -> tuple[int, str, str]:
    return dexkit("verify", archive, "--public-key", key, *more)


# --------------------------------------------------------------------------- round trip


def test_signed_archive_is_verified(signed: Signed) -> None:
    code, out, err = verify(signed.archive, signed.public)
    assert (code, err) == (0, "")
    listed = subprocess.run(
        ["ssh-keygen", "-l", "-f", signed.public], check=True, capture_output=True, text=True
    )
    assert listed.stdout.split()[1] in out
    results = json.loads(signed.result.read_text())
    assert "with all requirements that apply, and gives all of result.json" in out
    assert 'stated by the signer, not verified: subject.recording "run.mcap"' in out
    for name in ("python", "system"):
        assert f"stated by the signer, not verified: environment.{name} " in out
    assert "page: page.html is not compared with the result" in out
    judged = len({r["id"] for r in results["results"]})
    assert f"its verdict: fail ({judged} requirements); drop-in fail, safety not judged" in out
    assert "not that the hand is good" in out


def test_same_files_and_key_give_the_same_bytes(signed: Signed, tmp_path: Path) -> None:
    page = signed.folder / "page.html"
    code, _, err = dexkit(
        "sign", signed.result, "--page", page, "--key", signed.key, "-o", tmp_path / "again.zip"
    )
    assert code == 0, err
    assert (tmp_path / "again.zip").read_bytes() == signed.archive.read_bytes()


def test_any_zip_tool_can_unpack_it(signed: Signed) -> None:
    found = contents(signed.archive)
    assert set(found) == set(NAMES)
    for name in ("result.json", "run.mcap", "page.html"):
        assert found[name] == (signed.folder / name).read_bytes()
    manifest = json.loads(found[MANIFEST])
    assert manifest["judged"]["model"] == "dex1-1"
    assert manifest["judged"]["overall"] == "fail"


def test_result_page_and_terminal_name_the_digest(signed: Signed) -> None:
    digest = sha256_of_file(signed.folder / "run.mcap")
    assert json.loads(signed.result.read_text())["subject"]["recording_sha256"] == digest
    assert digest in (signed.folder / "page.html").read_text()
    assert digest in dexkit("report", signed.result)[1]
    assert digest in dexkit("report", signed.result, "--markdown", "-")[1]


def test_archive_without_a_page_is_verified_without_judging(
    signed: Signed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(signed.result, tmp_path / "result.json")
    run = signed.folder / "run.mcap"
    code, _, err = dexkit("sign", tmp_path / "result.json", "--recording", run, "--key", signed.key)
    assert code == 0, err
    assert set(contents(tmp_path / "result.zip")) == {*NAMES} - {"page.html"}
    monkeypatch.setattr("dexkit.conformance.signed.verify.compare_with_recording", None)
    code, out, _ = verify(tmp_path / "result.zip", signed.public, "--no-rejudge")
    assert code == 0
    assert "not judged again, as was asked for" in out
    assert "its verdict, stated by the signer and not verified: fail" in out


def test_allowed_signers_file_names_who_signed(signed: Signed, tmp_path: Path) -> None:
    signers = tmp_path / "signers"
    public = signed.public.read_text()
    signers.write_text(f"# a comment\nlab@example.org {public}")
    code, out, _ = verify(signed.archive, signers, "--no-rejudge")
    assert code == 0
    assert ", lab@example.org" in out
    signers.write_text(f'lab@example.org namespaces="git" {public}')
    code, out, _ = verify(signed.archive, signers, "--no-rejudge")
    assert code == 1
    other = ssh_key(tmp_path / "other").with_suffix(".pub").read_text()
    signers.write_text(f"lab@example.org {other}")
    code, out, _ = verify(signed.archive, signers, "--no-rejudge")
    assert code == 1
    assert "which is not a key that was given" in out


@needs_minisign
def test_minisign_signs_and_verifies(signed: Signed, tmp_path: Path) -> None:
    key, public, archive = tmp_path / "m.key", tmp_path / "m.pub", tmp_path / "m.zip"
    for secret, open_ in ((key, public), (tmp_path / "o.key", tmp_path / "o.pub")):
        command = ["minisign", "-G", "-W", "-f", "-s", str(secret), "-p", str(open_)]
        subprocess.run(command, check=True, capture_output=True, stdin=subprocess.DEVNULL)
    tool = ("--tool", "minisign", "--key", key, "-o", archive)
    code, out, err = dexkit("sign", signed.result, *tool)
    assert code == 0, err
    assert "manifest.json.minisig" in contents(archive)
    key_id = f"{int(public.read_text().split()[5], 16):X}"
    assert f"minisign key {key_id}" in out
    code, out, err = verify(archive, public, "--no-rejudge")
    assert (code, err) == (0, "")
    assert f"minisign key {key_id}" in out
    code, out, _ = verify(archive, tmp_path / "o.pub", "--no-rejudge")
    assert code == 1
    code, _, err = verify(archive, signed.public)
    assert code == 2
    assert "is signed by minisign, and the key is one of ssh-keygen" in err
    for name in (MANIFEST, "manifest.json.minisig"):
        found = contents(archive)
        code, out, err = verify(
            write(tmp_path / "x.zip", {**found, name: flipped(found[name])}), public
        )
        assert code == 1 or (code == 2 and name != MANIFEST)
        assert name in out + err
    found = contents(archive)
    good = found["manifest.json.minisig"]
    for bad in (
        good + b"x",
        good + good,
        b"\n" + good,
        good.replace(b"of a dexkit", b"by Unitree"),
    ):
        altered = {**found, "manifest.json.minisig": bad}
        code, _, err = verify(write(tmp_path / "x.zip", altered), public)
        assert (code, "manifest.json.minisig is not one signature of minisign" in err) == (2, True)


def test_a_minisign_key_id_has_no_leading_zeros() -> None:
    ident = bytes.fromhex("0DB2B37F30AEAB65")[::-1]
    for length in (32, 64):  # a public key, a signature
        text = base64.b64encode(b"Ed" + ident + bytes(length)).decode()
        assert signatures._minisign_id(text) == "DB2B37F30AEAB65"


# -------------------------------------------------------------------------- every change


@each("name", NAMES)
def test_one_changed_byte_is_found_and_named(name: str, signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    repaired = write(tmp_path / "a.zip", {**members, name: flipped(members[name])})
    raw = bytearray(signed.archive.read_bytes())
    with signed.archive.open("rb") as file:
        member = next(m for m in read_directory(file, "it") if m.name == name)
    raw[member.offset + member.size // 2] ^= 1
    plain = tmp_path / "b.zip"
    plain.write_bytes(raw)
    for archive in (repaired, plain):
        code, out, err = verify(archive, signed.public)
        if name == SIGNATURE and code == 2:  # a byte that no signature has
            assert f"{SIGNATURE} is not one signature of ssh-keygen and nothing else" in err
            continue
        assert (code, err) == (1, "")
        assert out.startswith("NOT VERIFIED")
        assert f"  {name}: " in out or (archive == repaired and name == MANIFEST)
        if name == MANIFEST:
            assert f"{SIGNATURE}: not a signature of {MANIFEST}" in out


@each("name", NAMES)
def test_missing_member_is_named(name: str, signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    del members[name]
    code, out, err = verify(write(tmp_path / "a.zip", members), signed.public)
    assert (code, err) == (1, "")
    assert f"  {name}: missing\n" in out


def test_extra_member_is_named(signed: Signed, tmp_path: Path) -> None:
    members = {**contents(signed.archive), "more.html": b"better verdicts"}
    code, out, err = verify(write(tmp_path / "a.zip", members), signed.public)
    assert (code, err) == (1, "")
    assert "  more.html: not in the manifest\n" in out


def test_every_difference_has_its_line(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    del members["page.html"]
    members["run.mcap"] += b"x"
    members["result.json"] = flipped(members["result.json"])
    members["more"] = b""
    code, out, _ = verify(write(tmp_path / "a.zip", members), signed.public)
    assert code == 1
    starts = [line.split(":")[0] for line in out.splitlines()[1:]]
    assert {"  page.html", "  run.mcap", "  result.json", "  more"} <= set(starts)


def test_wrong_key_is_named(signed: Signed, tmp_path: Path) -> None:
    other = ssh_key(tmp_path / "other")
    code, out, err = verify(signed.archive, other.with_suffix(".pub"))
    assert (code, err) == (1, "")
    assert "which is not a key that was given" in out


def test_signature_for_another_purpose_does_not_count(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    (tmp_path / MANIFEST).write_bytes(members[MANIFEST])
    command = ["ssh-keygen", "-Y", "sign", "-q", "-n", "git", "-f", str(signed.key)]
    subprocess.run([*command, str(tmp_path / MANIFEST)], check=True, capture_output=True)
    members[SIGNATURE] = (tmp_path / SIGNATURE).read_bytes()
    code, out, _ = verify(write(tmp_path / "a.zip", members), signed.public)
    assert code == 1
    assert f"  {SIGNATURE}: " in out


def resigned(signed: Signed, path: Path, members: dict[str, bytes], **changes: Any) -> Path:
    """An archive with other files that its owner has signed by hand, as if they were right."""
    document = json.loads(members[MANIFEST])
    for file in document["files"]:
        digest = digest_of([members[file["name"]]])
        file |= {"size": digest.size, "sha256": digest.sha256}
    document["judged"] |= changes
    data = json.dumps(document).encode()
    signature, _ = signatures.sign(signatures.SSH_KEYGEN, data, signed.key)
    return write(path, {**members, MANIFEST: data, SIGNATURE: signature})


def test_edited_verdict_is_found_though_well_signed(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    document = json.loads(members["result.json"])
    failed = next(r for r in document["results"] if r["verdict"] == "fail")
    failed["verdict"] = "pass"
    members["result.json"] = json.dumps(document).encode()
    code, out, _ = verify(resigned(signed, tmp_path / "a.zip", members), signed.public)
    assert code == 1
    assert "manifest.json: overall is 'fail' there, and " in out
    code, out, _ = verify(tmp_path / "a.zip", signed.public, "--no-rejudge")
    assert code == 1
    assert "counts.fail is not what follows from the result's own verdicts" in out
    # with all summaries as they follow
    (tmp_path / "r.json").write_bytes(members["result.json"])
    found = read_json(tmp_path / "r.json")
    members["result.json"] = json.dumps(found.as_dict()).encode()
    about = Judged.from_result(found)
    archive = resigned(
        signed, tmp_path / "b.zip", members, overall=about.overall, grades=about.grades
    )
    code, out, _ = verify(archive, signed.public)
    assert code == 1
    assert f'{failed["id"]} {failed["side"]}): "pass" in the result, "fail" when judged' in out
    assert verify(archive, signed.public, "--no-rejudge")[0] == 0  # which says so


def forged(signed: Signed, path: Path, found: RunResult | dict[str, Any]) -> Path:
    """An archive of another result, signed by its owner, with a manifest that agrees."""
    document = found if isinstance(found, dict) else found.as_dict()
    members = contents(signed.archive)
    members["result.json"] = json.dumps(document).encode()
    about = Judged.from_result(parse_result(json.loads(members["result.json"]), "it"))
    changes = {**about.about, "overall": about.overall, "grades": about.grades}
    return resigned(signed, path, members, **changes)


def test_failures_that_were_taken_out_are_found(signed: Signed, tmp_path: Path) -> None:
    found = read_json(signed.result)
    bad = {r.requirement.id for r in found.results if r.verdict in (Verdict.FAIL, Verdict.BLOCKED)}
    kept = [r for r in found.results if r.requirement.id not in bad]
    count = len({r.requirement.id for r in kept})
    lie = replace(found, results=kept, catalogue=count)
    assert lie.grade(Kind.DROP_IN).sentence().startswith("drop-in: PASS: ")
    code, out, _ = verify(forged(signed, tmp_path / "a.zip", lie), signed.public)
    assert code == 1
    assert f"catalogue: {count} in the result, {found.catalogue} when judged again" in out
    honest = replace(found, results=kept)
    code, out, _ = verify(forged(signed, tmp_path / "b.zip", honest), signed.public)
    assert code == 0
    assert "a part only: " in out
    named = next(line for line in out.splitlines() if "left out, fail when judged: " in line)
    assert all(r.requirement.id in named for r in found.results if r.verdict is Verdict.FAIL)
    assert "drop-in incomplete" in out
    assert "drop-in pass" not in out
    assert "all requirements together: FAIL: a MUST is not met" in out


FORGED_TEXTS = {
    "score": lambda d: d["score"].update(sentence="In a trial it caught 99 % of wrong hands."),
    "notes": lambda d: d["notes"].append("inspected by the vendor"),
    "observed": lambda d: d["results"][0].update(observed="perfect"),
    "certified": lambda d: d["subject"].update(certified="yes"),
}


@each("name", FORGED_TEXTS)
def test_forged_text_is_found(name: str, signed: Signed, tmp_path: Path) -> None:
    document = json.loads(signed.result.read_text())
    FORGED_TEXTS[name](document)
    code, out, _ = verify(forged(signed, tmp_path / "a.zip", document), signed.public)
    assert code == 1
    assert any(name in line and "when judged again" in line for line in out.splitlines())


def test_signature_is_exactly_one(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    good = members[SIGNATURE]
    for bad in (
        good + b"\n",
        good + b"approved by the vendor\n",
        good + good,
        b"\n" + good,
        good.rstrip(b"\n"),
        good.replace(b"\n", b"\r\n"),
        good.replace(b"\n", b"\n\n", 2),
        b"",
    ):
        code, out, err = verify(
            write(tmp_path / "a.zip", {**members, SIGNATURE: bad}), signed.public
        )
        assert (code, out) == (2, "")
        assert f"{SIGNATURE} is not one signature of ssh-keygen and nothing else" in err


def test_document_of_two_meanings_is_refused(signed: Signed, tmp_path: Path) -> None:
    """Two readers may read another value of a key that occurs twice, or of NaN."""
    members = contents(signed.archive)
    for name, why in (("result.json", "is not valid JSON"), (MANIFEST, "is not valid JSON")):
        text = members[name].decode().strip()
        first = text.index(":") + 1
        key = text[text.index('"') : first]
        for bad in (
            f"{{{key} 1,{text[1:]}",
            text[:-1] + ', "x": NaN}',
            text[:-1] + ', "x": 1e999}',
            text + "{}",
        ):
            altered = {**members, name: bad.encode()}
            if name == MANIFEST:
                signature, _ = signatures.sign(signatures.SSH_KEYGEN, bad.encode(), signed.key)
                archive = write(tmp_path / "a.zip", {**altered, SIGNATURE: signature})
            else:
                archive = resigned(signed, tmp_path / "a.zip", altered)
            code, out, err = verify(archive, signed.public)
            assert (code, out) == (2, "")
            assert name in err
            assert why in err
    for place in ((), ("judged",), ("judged", "grades"), ("files", 0)):
        document = json.loads(members[MANIFEST])
        found = document
        for step in place:
            found = found[step]
        found["certified"] = "yes"
        data = json.dumps(document).encode()
        signature, _ = signatures.sign(signatures.SSH_KEYGEN, data, signed.key)
        archive = write(tmp_path / "a.zip", {**members, MANIFEST: data, SIGNATURE: signature})
        code, _, err = verify(archive, signed.public)
        assert (code, "must have just the members" in err) == (2, True)


def test_page_of_other_verdicts_is_said_not_to_be_compared(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    digest = json.loads(signed.result.read_text())["subject"]["recording_sha256"]
    members["page.html"] = f"<h1>drop-in pass</h1>{digest}".encode()
    code, out, _ = verify(
        resigned(signed, tmp_path / "a.zip", members), signed.public, "--no-rejudge"
    )
    assert code == 0
    assert "page.html is not compared with the result, and may show anything" in out


def test_manifest_with_additional_statements_is_detected(signed: Signed, tmp_path: Path) -> None:
    members = contents(signed.archive)
    archive = resigned(signed, tmp_path / "a.zip", members, overall="pass")
    code, out, _ = verify(archive, signed.public, "--no-rejudge")
    assert code == 1
    assert "manifest.json: overall is 'pass' there, and 'fail' in the result" in out


# ----------------------------------------------------------------------------- refusals


def test_another_recording_is_refused(judged: Path, tmp_path: Path) -> None:
    if not ssh_keygen():
        pytest.skip("ssh-keygen is not installed")
    key, target = ssh_key(tmp_path / "key"), tmp_path / "a.zip"
    other = sample_path("dex3_pinch")
    arguments = ("--recording", other, "--key", key, "-o", target)
    code, _, err = dexkit("sign", judged / "result.json", *arguments)
    assert code == 2
    assert "is not the recording that the result was judged from" in err
    assert sha256_of_file(other) in err
    # a result of an earlier dexkit names no digest
    document = json.loads((judged / "result.json").read_text())
    del document["subject"]["recording_sha256"]
    old = tmp_path / "old.json"
    old.write_text(json.dumps(document))
    code, _, err = dexkit("sign", old, *arguments)
    assert code == 2
    assert not target.exists()
    assert "is not in the result" in err
    document["results"][0]["verdict"] = "error"
    old.write_text(json.dumps(document))
    code, _, err = dexkit("sign", old, *arguments)
    assert code == 2
    assert "was changed" in err


@needs_ssh
def test_page_of_another_result_is_refused(signed: Signed, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text("<p>a very good hand</p>")
    code, _, err = dexkit("sign", signed.result, "--page", page, "--key", signed.key)
    assert code == 2
    assert "does not show the digest of the recording" in err


def test_missing_tool_names_the_package(
    signed: Signed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for tool, package in signatures.PACKAGES.items():
        arguments = ("--key", signed.key, "--tool", tool, "-o", tmp_path / "a.zip")
        code, _, err = dexkit("sign", signed.result, *arguments)
        assert code == 2
        assert f"{tool} is not installed" in err
        assert f"apt install {package}" in err
    code, _, err = verify(signed.archive, signed.public)
    assert code == 2
    assert "ssh-keygen is not installed" in err
    assert not (tmp_path / "a.zip").exists()


def test_invalid_key_is_refused(signed: Signed, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    for text, why in (
        ("", "holds no public key"),
        ("hello", "is not a public key"),
        ("-----BEGIN OPENSSH PRIVATE KEY-----\nx", "is a private key"),
        ("untrusted comment: minisign encrypted secret key\nRWRTY0Iy", "is a private key"),
        ("ssh-ed25519 AAAAAAAAAAAAAAAAAAAAAAAA", "cannot read the public key"),
        ("\x00" * 50, "is not a public key"),
        ("x" * (2 << 20), "is too large"),
    ):
        bad.write_text(text)
        code, _, err = verify(signed.archive, bad)
        assert code == 2, text
        assert why in err
    bad.write_bytes(b"\xff\xfe")
    assert verify(signed.archive, bad)[0] == 2
    code, _, err = dexkit("sign", signed.result, "--key", bad, "-o", tmp_path / "a.zip")
    assert code == 2
    assert "ssh-keygen does not sign with" in err


def test_name_that_no_archive_can_hold_is_refused(signed: Signed, tmp_path: Path) -> None:
    for name in ("manifest.json", "Manifest.JSON", "résultat.json", ".result.json"):
        shutil.copy(signed.result, tmp_path / name)
        run = signed.folder / "run.mcap"
        code, _, err = dexkit(
            "sign", tmp_path / name, "--recording", run, "--key", signed.key, "-o", "x.zip"
        )
        assert code == 2
        assert "cannot be in an archive under the name" in err


def test_recording_that_changes_meanwhile_leaves_no_archive(
    signed: Signed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("result.json", "run.mcap"):
        shutil.copy(signed.folder / name, tmp_path / name)
    real = signatures.sign

    def meanwhile(*arguments: Any) -> Any:
        with (tmp_path / "run.mcap").open("ab") as file:
            file.write(b"more")
        return real(*arguments)

    monkeypatch.setattr(signing.signatures, "sign", meanwhile)
    code, _, err = dexkit("sign", tmp_path / "result.json", "--key", signed.key)
    assert code == 2
    assert "was changed while it was signed" in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["result.json", "run.mcap"]


def test_archive_that_cannot_be_written_is_an_error(signed: Signed, tmp_path: Path) -> None:
    for place, why in (
        ("/dev/full", "No space left on device"),
        (tmp_path, "Is a directory"),
        (tmp_path / "none" / "x", "No such file or directory"),
    ):
        code, _, err = dexkit("sign", signed.result, "--key", signed.key, "-o", place)
        assert code == 2
        assert f"cannot write {place}: {why}" in err
    code, _, err = dexkit("sign", signed.result, "--key", signed.key, "-o", signed.key)
    assert code == 2
    assert "is also an input" in err


# ---------------------------------------------------------------------- hostile archives


def zipped(*members: tuple[str, bytes], **options: Any) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", **options) as file:
        for name, data in members:
            file.writestr(zipfile.ZipInfo(name), data, options.get("compression"))
    return stream.getvalue()


def named(name: bytes) -> bytes:
    """An archive with one empty member of a name that :func:`pack` refuses."""
    data = b"".join(pack([Content("X" * len(name), 0, 0, lambda: [])]))
    return data.replace(b"X" * len(name), name)


GOOD = b"".join(pack([Content("a", 3, zlib.crc32(b"abc"), lambda: [b"abc"])]))


def patched(data: bytes, offset: int, value: bytes) -> bytes:
    """``data`` with other bytes at an offset; a negative one is from the end."""
    place = offset % len(data)
    return data[:place] + value + data[place + len(value) :]


HOSTILE = {
    "empty": (b"", "is not a zip archive"),
    "text": (b"{}" * 100, "is not a zip archive"),
    "bomb": (zipped(("a", bytes(10**6)), compression=zipfile.ZIP_DEFLATED), "is compressed"),
    "traversal": (named(b"../../etc/passwd"), "unsafe name"),
    "absolute": (named(b"/etc/passwd"), "unsafe name"),
    "windows": (named(b"..\\x"), "unsafe name"),
    "dot": (named(b".."), "unsafe name"),
    "control": (named(b"a\x1b[31m"), "unsafe name"),
    "zero": (named(b"a\x00b"), "unsafe name"),
    "not UTF-8": (named(b"\xff\xfe\xfd"), "name is not UTF-8 text"),
    "no name": (named(b"Y").replace(b"Y", b""), "directory"),
    "many": (zipped(*((str(i), b"") for i in range(500))), "members"),
    "cut short": (GOOD[:-5], "cut short"),
    "without its end": (GOOD[:-22], "cut short"),
    "half": (GOOD[: len(GOOD) // 2], "cut short"),
    "something before": (b"#!/bin/sh\n" + GOOD, "directory"),
    "something behind": (GOOD + b"x", "cut short, or has data after its end"),
    "a comment": (GOOD[:-2] + b"\1\0x", "cut short, or has data after its end"),
    "a huge directory": (patched(GOOD, -10, struct.pack("<L", 0xFFFFFFFF)), "directory"),
    "a huge member": (
        patched(GOOD, len(GOOD) - 22 - 47 + 20, struct.pack("<2L", 2**32 - 1, 2**32 - 1)),
        "headers",
    ),
    "encrypted": (patched(GOOD, len(GOOD) - 22 - 47 + 8, b"\1\0"), "encrypted"),
    "a link": (patched(GOOD, len(GOOD) - 22 - 47 + 38, struct.pack("<L", 0o120777 << 16)), "head"),
    "another local name": (patched(GOOD, 30, b"b"), "headers"),
    "of another program": (zipped(("a", b"")), "headers"),
    "no member listed": (patched(GOOD, -14, b"\0\0\0\0"), "belong to no member"),
}


@pytest.fixture(scope="module")
def public_key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not ssh_keygen():
        pytest.skip("ssh-keygen is not installed")
    return ssh_key(tmp_path_factory.mktemp("key") / "key").with_suffix(".pub")


@each("case", HOSTILE)
def test_hostile_archive_is_refused(case: str, tmp_path: Path, public_key: Path) -> None:
    data, why = HOSTILE[case]
    archive = tmp_path / "a.zip"
    archive.write_bytes(data)
    code, out, err = verify(archive, public_key)
    assert (code, out) == (2, "")
    assert why in err
    assert not hostile.raw(err)


def test_two_members_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError):
        write(tmp_path / "a.zip", {"a": b"1", "A": b"2"})
    data = b"".join(pack([Content(n, 0, 0, lambda: []) for n in ("a", "b")])).replace(b"b", b"A")
    with pytest.raises(ArchiveError, match="two members of the name A"):
        read_directory(io.BytesIO(data), "it")


def test_special_files_are_refused(tmp_path: Path, public_key: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for place in (tmp_path, tmp_path / "pipe", Path("/dev/zero")):
        code, _, err = verify(place, public_key)
        assert code == 2
        assert "is not an ordinary file" in err or "Is a directory" in err


def test_huge_manifest_or_signature_is_refused(tmp_path: Path, public_key: Path) -> None:
    for name in (MANIFEST, SIGNATURE):
        members = {MANIFEST: b"{}", SIGNATURE: b"", name: b" " * (manifests.LARGEST + 1)}
        code, _, err = verify(write(tmp_path / "a.zip", members), public_key)
        assert code == 2
        assert f"{name} is larger than" in err


def test_unknown_manifest_that_is_well_signed_is_an_error(signed: Signed, tmp_path: Path) -> None:
    for text, why in (
        ('{"format": "dexkit-signed-result", "version": 2}', "is version 2 of"),
        ("[" * 60_000, "is not valid JSON"),
        ("{}", "is not the manifest of a signed result"),
    ):
        signature, _ = signatures.sign(signatures.SSH_KEYGEN, text.encode(), signed.key)
        members = {MANIFEST: text.encode(), SIGNATURE: signature}
        code, _, err = verify(write(tmp_path / "a.zip", members), signed.public)
        assert code == 2
        assert why in err


# -------------------------------------------------------------------------------- codecs

texts = st.text(max_size=8)
digests = st.binary(min_size=32, max_size=32).map(bytes.hex)
letters = st.text("aZ09._+=@,() -", max_size=20)
names = st.builds("{}{}{}".format, st.sampled_from("fF_7"), letters, st.sampled_from("xX9_"))


@st.composite
def any_manifest(draw: Any) -> Manifest:
    roles = draw(st.permutations(manifests.ROLES)) if draw(st.booleans()) else manifests.ROLES[:2]
    count = len(roles)
    used = draw(st.lists(names, min_size=count, max_size=count, unique_by=str.casefold))
    size = st.integers(0, 2**32 - 1)
    return Manifest(
        files=tuple(
            File(role, name, draw(size), draw(digests))
            for role, name in zip(roles, used, strict=True)
        ),
        judged=Judged(
            {name: draw(texts) for name in manifests._ABOUT},
            draw(texts),
            {str(kind): draw(texts) for kind in Kind},
        ),
        dexkit=draw(texts),
    )


@given(any_manifest())
def test_manifest_is_read_as_it_was_written(manifest: Manifest) -> None:
    data = manifest.encode()
    assert Manifest.decode(data) == manifest
    assert Manifest.decode(data).encode() == data


@given(any_manifest(), st.data())
def test_manifest_with_another_byte_is_read_or_refused(manifest: Manifest, data: Any) -> None:
    encoded = bytearray(manifest.encode())
    encoded[data.draw(st.integers(0, len(encoded) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = Manifest.decode(bytes(encoded))
    except ArchiveError:
        return
    assert Manifest.decode(found.encode()) == found


@given(st.dictionaries(names, st.binary(max_size=50), max_size=8), st.data())
def test_archive_is_read_as_it_was_written(members: dict[str, bytes], data: Any) -> None:
    if len({name.casefold() for name in members}) < len(members):
        return
    listed = [
        Content(n, len(d), zlib.crc32(d), lambda d=d: [d])  # type: ignore[misc]
        for n, d in members.items()
    ]
    packed = b"".join(pack(listed))
    file = io.BytesIO(packed)
    found = {m.name: b"".join(member_pieces(file, m)) for m in read_directory(file, "it")}
    assert found == members
    with zipfile.ZipFile(file) as other:
        assert {n: other.read(n) for n in other.namelist()} == members
    changed = bytearray(packed)
    changed[data.draw(st.integers(0, len(packed) - 1))] ^= data.draw(st.integers(1, 255))
    try:  # contents may differ, headers not
        again = read_directory(io.BytesIO(bytes(changed)), "it")
    except ArchiveError:
        return
    assert [(m.name, m.size) for m in again] == [(n, len(d)) for n, d in members.items()]


@given(st.text(max_size=120))
def test_safe_name_is_one_file_in_one_folder(name: str) -> None:
    if is_safe_name(name):
        assert Path(name).name == name
        assert name.isascii()
        assert not name.startswith((".", "-"))


def test_recording_beside_is_used(signed: Signed) -> None:
    assert report_command.recording_beside(signed.result, "run.mcap") is not None
    assert issubclass(ArchiveError, DexkitError)
    assert not issubclass(ArchiveError, UsageError)
