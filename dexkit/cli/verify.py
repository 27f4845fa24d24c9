"""``dexkit verify``: check a signed archive."""

from __future__ import annotations

from pathlib import Path

import click

from dexkit.cli.options import LocalPath
from dexkit.escaping import REMARK, one_line

_MOST = 40
"""Differences that are printed; a result of another recording has thousands."""


@click.command("verify")
@click.argument("archive", type=LocalPath(exists=True), metavar="ARCHIVE.zip")
@click.option(
    "--public-key",
    type=LocalPath(exists=True),
    required=True,
    metavar="FILE",
    help="Accepted signer: an ssh public key, an allowed_signers file, or a public key of "
    "minisign.",
)
@click.option(
    "--rejudge/--no-rejudge",
    default=True,
    show_default=True,
    help="Judge the recording again, and compare the result with what it gives.",
)
def command(archive: Path, public_key: Path, rejudge: bool) -> None:
    """Verify an archive of 'dexkit sign', and judge its recording again.

    Checks the signature, the digest of every file, and that none is missing or added; then judges
    the recording as 'dexkit check' does and compares all of the result: requirements, verdicts,
    grades, figures and texts. What no recording tells is printed as stated by the signer. A result
    about a part of the requirements is no pass: the others are named.

    A signature says who vouches for the result, not that the hand conforms.

    Exit code: 0 everything agrees, whatever the verdict on the hand; 1 something differs, one line
    each; 2 the archive, the key or the tool cannot be used.
    """
    from dexkit.conformance.signed.manifest import INCOMPLETE
    from dexkit.conformance.signed.verify import verify_archive
    from dexkit.signatures import PublicKey

    found = verify_archive(archive, PublicKey.read(public_key), rejudge=rejudge)
    if found.differences:
        click.echo(f"NOT VERIFIED: {archive}")
        for line in found.differences[:_MOST]:
            click.echo(f"  {one_line(line, REMARK)}")
        if len(found.differences) > _MOST:
            click.echo(f"  and {len(found.differences) - _MOST} more differences")
    else:
        click.echo(f"verified: {archive}")
    for line in found.notes:
        click.echo(f"  {one_line(line, REMARK)}")
    if found.differences:
        raise click.exceptions.Exit(1)
    assert found.manifest is not None, "what is verified has a manifest"
    judged = found.manifest.judged
    is_part = found.comparison is not None and found.comparison.is_part

    def word(grade: str) -> str:
        return INCOMPLETE if is_part and grade == "pass" else grade

    grades = ", ".join(f"{kind} {word(grade)}" for kind, grade in judged.grades.items())
    about = judged.about
    who = about["hand"] or about["backend"] or "a hand without a name"
    real = f", {about['nature']}" if about["nature"] else ""
    what = f"{who}{real}, as {about['model']} ({about['dialect']}), {about['sides']}"
    click.echo(f"  signed result: {one_line(what)}; recorded at {one_line(about['recorded_at'])}")
    verdict = f"{word(judged.overall)} ({about['requirements']} requirements); {grades}"
    head = "its verdict" if rejudge else "its verdict, stated by the signer and not verified"
    click.echo(f"  {head}: {one_line(verdict)}")
    click.echo("The signature says who vouches for this result, not that the hand is good.")
