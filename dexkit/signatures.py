"""Make and check detached signatures with an installed tool: OpenSSH's ssh-keygen, or minisign.

dexkit has no cryptography of its own. A signature is for :data:`NAMESPACE` only, so that one that
was made for a letter or a git commit does not count: ``ssh-keygen -n``, and with minisign the
trusted comment, which it signs as well.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from dexkit import documents
from dexkit.errors import ArchiveError, SigningError, UsageError
from dexkit.escaping import one_line
from dexkit.temporary_folder import TemporaryFolder

__all__ = [
    "MINISIGN",
    "NAMESPACE",
    "PACKAGES",
    "SSH_KEYGEN",
    "Checked",
    "PublicKey",
    "check",
    "require",
    "sign",
]

NAMESPACE = "dexkit-result"
SSH_KEYGEN, MINISIGN = "ssh-keygen", "minisign"
PACKAGES = {SSH_KEYGEN: "openssh-client", MINISIGN: "minisign"}
"""The package of Debian and Ubuntu that each tool is in."""
_PATIENCE = 120.0
"""Seconds for a tool, in which a user may have to type a passphrase or touch a hardware key."""
_LARGEST_KEY_FILE = 1 << 20  # characters; an allowed_signers file of thousands of people
_MOST_PRINCIPALS = 20
_KEY = r"(?P<type>(?:ssh-|ecdsa-sha2-|sk-)[a-z0-9@.-]{1,60}) (?P<blob>[A-Za-z0-9+/]{16,}={0,2})"
_SSH_KEY = re.compile(rf"{_KEY}(?: .*)?")
_SIGNER = re.compile(rf"\S.* {_KEY}(?: .*)?")
_GOOD = re.compile(r"^Good .* with (?P<kind>\S+) key (?P<print>\S+:\S+)$", re.MULTILINE)
_ARMOR = re.compile(
    rb"-----BEGIN SSH SIGNATURE-----\n"
    rb"(?:[A-Za-z0-9+/]{70}\n)*[A-Za-z0-9+/]{1,70}={0,2}\n"
    rb"-----END SSH SIGNATURE-----\n"
)
_COMMENT = "signature of a dexkit result"
_MINISIGN = re.compile(
    rb"untrusted comment: %b\n"
    rb"[A-Za-z0-9+/]{99}=\n"
    rb"trusted comment: [^\n]*\n"
    rb"[A-Za-z0-9+/]{86}==\n" % _COMMENT.encode()
)
_FORMS = {SSH_KEYGEN: _ARMOR, MINISIGN: _MINISIGN}
"""The files that ``sign`` makes, to the byte. The tools read the first signature of a file and
leave the rest, and do not sign minisign's first line: whoever has the file could write there."""
_US = "signer"  # the principal of a bare public key


@dataclass(frozen=True)
class PublicKey:
    """A key that checks signatures.

    :param tool: the tool whose key it is.
    :param text: lines of an allowed_signers file, or minisign's key in base64.
    :param bare: a public key; else an allowed_signers file.
    """

    tool: str
    text: str
    bare: bool = True

    @classmethod
    def read(cls, path: Path) -> PublicKey:
        """Read an ssh public key, an allowed_signers file, or minisign's public key.

        :raises UsageError: it is none of these.
        """
        text = documents.read_text(path)
        if len(text) > _LARGEST_KEY_FILE:
            raise UsageError(f"{path} is too large for a public key")
        lines = [t for line in text.splitlines() if (t := line.strip()) and not t.startswith("#")]
        if not lines:
            raise UsageError(f"{path} holds no public key")
        if "PRIVATE KEY" in lines[0] or "secret key" in lines[0]:
            raise UsageError(
                f"{path} is a private key; to verify needs the public one",
                hint="it is in KEY.pub",
            )
        if lines[0].startswith("untrusted comment:") and len(lines) > 1:
            lines = lines[1:]
        if len(lines) == 1 and _minisign_id(lines[0]):
            return cls(MINISIGN, lines[0])
        bare = [_SSH_KEY.fullmatch(line) for line in lines]
        if all(bare):
            signers = [
                f'{_US} namespaces="{NAMESPACE}" {key["type"]} {key["blob"]}' for key in bare if key
            ]
            return cls(SSH_KEYGEN, "\n".join(signers) + "\n")
        if all(_SIGNER.fullmatch(line) for line in lines):
            return cls(SSH_KEYGEN, "\n".join(lines) + "\n", bare=False)
        raise UsageError(
            f"{path} is not a public key",
            hint="an ssh public key (KEY.pub), an allowed_signers file (man ssh-keygen), or a "
            "public key of minisign",
        )


@dataclass(frozen=True)
class Checked:
    """Result of the check of a signature.

    :param good: the signature is of these data, and of a key that was given.
    :param intact: the signature is of these data, whatever the key.
    :param key: the key that signed: kind and fingerprint, or minisign's key id; empty if unknown.
    :param who: the principal of the allowed_signers file, or empty.
    :param words: the tool's own words, where it is not good.
    """

    good: bool
    intact: bool = False
    key: str = ""
    who: str = ""
    words: str = ""


def require(tool: str) -> str:
    """The path of a tool.

    :raises SigningError: it is not installed.
    """
    found = shutil.which(tool)
    if found is None:
        raise SigningError(
            f"{tool} is not installed; it makes and checks the signatures",
            hint=f"install the package {PACKAGES[tool]}: sudo apt install {PACKAGES[tool]}",
        )
    return found


def sign(tool: str, data: bytes, key: Path) -> tuple[bytes, str]:
    """Sign ``data``; returns the signature and the key that made it.

    :param key: file of the private key; for ssh-keygen also that of a public key whose private
        one an agent holds.
    :raises SigningError: the tool is missing, or cannot use the key.
    """
    documents.open_ordinary(key, error=SigningError).close()  # the tool would wait for a pipe
    with TemporaryFolder("sign") as folder:
        message, signature = folder / "manifest.json", folder / "manifest.json.sig"
        message.write_bytes(data)
        path = str(key.absolute())
        if tool == SSH_KEYGEN:
            command = ["-Y", "sign", "-q", "-n", NAMESPACE, "-f", path, str(message)]
        else:
            command = ["-S", "-s", path, "-m", str(message), "-x", str(signature)]
            command += ["-t", NAMESPACE, "-c", _COMMENT]
        # minisign asks on standard input, ssh-keygen on the terminal
        stdin = _STANDARD_INPUT if tool == MINISIGN else subprocess.DEVNULL
        done = _run(tool, *command, stdin=stdin)
        if done.returncode or not signature.is_file():
            raise SigningError(
                f"{tool} does not sign with {key}: {_last_line(done)}",
                hint="make a key: ssh-keygen -t ed25519 -f KEY"
                if tool == SSH_KEYGEN
                else "make a key: minisign -G -s KEY -p KEY.pub",
            )
        made = signature.read_bytes()
        return made, _signed_by(tool, message, signature)


def check(
    key: PublicKey, data: bytes, signature: bytes, origin: object = "the signature"
) -> Checked:
    """Check the signature of ``data``.

    :param origin: what to call the signature.
    :raises ArchiveError: it is not one signature as :func:`sign` makes it, and nothing else.
    :raises SigningError: the tool is missing.
    :raises UsageError: it cannot use the public key.
    """
    if not _FORMS[key.tool].fullmatch(signature):
        raise ArchiveError(
            f"{origin} is not one signature of {key.tool} and nothing else",
            hint="its file was changed, or another program wrote it: verify the archive as "
            "'dexkit sign' made it",
        )
    with TemporaryFolder("verify") as folder:
        message, file = folder / "manifest.json", folder / "manifest.json.sig"
        message.write_bytes(data)
        file.write_bytes(signature)
        if key.tool == MINISIGN:
            return _check_minisign(key, message, file)
        signers = folder / "allowed_signers"
        signers.write_text(key.text, encoding="utf-8")
        return _check_ssh(key, message, file, signers, folder)


def _check_ssh(
    key: PublicKey, message: Path, signature: Path, signers: Path, folder: Path
) -> Checked:
    names = [_US]
    if key.bare:
        bare = folder / "key.pub"
        for line in key.text.splitlines():
            bare.write_text(" ".join(line.split()[-2:]) + "\n")
            if _run(SSH_KEYGEN, "-l", "-f", str(bare)).returncode:
                raise UsageError("ssh-keygen cannot read the public key")
    else:
        command: tuple[str, ...] = ("-Y", "find-principals", "-s", str(signature))
        command += ("-f", str(signers))
        names = _run(SSH_KEYGEN, *command).stdout.splitlines()[:_MOST_PRINCIPALS]
    words = "no line of the allowed_signers file has the key that signed"
    for name in names:
        command = ("-Y", "verify", "-n", NAMESPACE, "-I", name)
        command += ("-f", str(signers), "-s", str(signature))
        with message.open("rb") as data:
            done = _run(SSH_KEYGEN, *command, stdin=data)
        found = _GOOD.search(done.stdout)
        if done.returncode == 0 and found:
            who = "" if key.bare else name
            return Checked(True, True, f"{found['kind']} key {found['print']}", who)
        words = _last_line(done)
    by = _signed_by(SSH_KEYGEN, message, signature)
    return Checked(False, bool(by), by, words=words)


def _check_minisign(key: PublicKey, message: Path, signature: Path) -> Checked:
    command = ("-V", "-Q", "-P", key.text, "-m", str(message), "-x", str(signature))
    done = _run(MINISIGN, *command)
    by = _signed_by(MINISIGN, message, signature)
    if done.returncode:
        return Checked(False, False, by, words=_last_line(done))
    if done.stdout.strip() != NAMESPACE:
        words = f"the trusted comment is {one_line(done.stdout.strip(), 80)!r}, not {NAMESPACE}"
        return Checked(False, False, by, words=words)
    return Checked(True, True, f"minisign key {_minisign_id(key.text)}")


def _signed_by(tool: str, message: Path, signature: Path) -> str:
    """The key that made a signature; empty if it is not one of the message.

    What minisign says of a key that is not known is not checked.
    """
    if tool == MINISIGN:
        lines = signature.read_text("utf-8", "replace").splitlines()
        found = _minisign_id(lines[1]) if len(lines) > 1 else ""
        return f"minisign key {found}" if found else ""
    command = ("-Y", "check-novalidate", "-n", NAMESPACE, "-s", str(signature))
    with message.open("rb") as data:
        done = _run(SSH_KEYGEN, *command, stdin=data)
    match = _GOOD.search(done.stdout) if done.returncode == 0 else None
    return f"{match['kind']} key {match['print']}" if match else ""


def _minisign_id(text: str) -> str:
    """The key id in a public key (42 bytes) or a signature (74 bytes) of minisign, as version 0.11
    writes it into key files (hexadecimal, no leading zeros); empty if it is none.
    The format: algorithm, 8 bytes of id in little-endian order, key.
    """
    try:
        raw = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return ""
    if len(raw) not in (42, 74) or raw[:2] not in (b"Ed", b"ED"):
        return ""
    return f"{int.from_bytes(raw[2:10], 'little'):X}"


_STANDARD_INPUT = 0


def _run(
    tool: str, *arguments: str, stdin: int | IO[bytes] = subprocess.DEVNULL
) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            [require(tool), *arguments],
            stdin=stdin,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "LC_ALL": "C"},
            timeout=_PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise SigningError(f"{tool} has not ended within {_PATIENCE:g} s") from None
    except OSError as why:
        raise SigningError(f"{tool} cannot be run: {why.strerror}") from why


def _last_line(done: subprocess.CompletedProcess[str]) -> str:
    """Last line of a tool's output: the reason of a failure."""
    lines = [t for line in (done.stdout + "\n" + done.stderr).splitlines() if (t := line.strip())]
    return one_line(lines[-1], 200) if lines else f"exit code {done.returncode}"
