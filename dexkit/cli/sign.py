"""``dexkit sign``: a result, its recording and its page as one signed archive."""

from __future__ import annotations

from pathlib import Path

import click

from dexkit.cli.options import (
    LocalPath,
    output_option,
    recording_option,
)
from dexkit.documents import check_output_paths
from dexkit.errors import UsageError
from dexkit.escaping import one_line


@click.command("sign")
@click.argument("result", type=LocalPath(exists=True), metavar="RESULT.json")
@recording_option()
@click.option(
    "--page",
    type=LocalPath(exists=True),
    metavar="PAGE.html",
    help="Also sign this report page of the result.",
)
@click.option(
    "--key",
    type=LocalPath(exists=True),
    required=True,
    metavar="KEY",
    help="Private key to sign with; of ssh, or of minisign with --tool minisign.",
)
@click.option(
    "--tool",
    # literal, because what signs is imported only when the command runs
    type=click.Choice(["ssh-keygen", "minisign"]),
    default="ssh-keygen",
    show_default=True,
    help="Signing program; it must be installed.",
)
@output_option("FILE.zip", "Where to write the archive.  [default: RESULT.zip]")
def command(
    result: Path,
    recording: Path | None,
    page: Path | None,
    key: Path,
    tool: str,
    output: Path | None,
) -> None:
    """Sign a result together with its recording, as one archive.

    The archive is a zip of the result, the recording, the page if one is given, a manifest with
    their SHA-256 digests, and a signature of the manifest. The same files and key give the same
    bytes. 'dexkit verify' checks it.

    A recording that does not belong to the result is refused: by the digest in the result or,
    without one, by judging the recording again.

    Exit code: 0 the archive is written, 2 a file, the key or the tool cannot be used, or the
    recording is another one.
    """
    from dexkit.cli.report import recording_beside
    from dexkit.conformance.result_file import read_json
    from dexkit.conformance.signed.sign import sign_result

    name = read_json(result).subject.get("recording", "")
    file = recording or recording_beside(result, name)
    if file is None:
        raise UsageError(
            f"the recording of {result} is not beside it", hint="name it: --recording RUN.mcap"
        )
    target = output or result.with_suffix(".zip")
    check_output_paths([target], [result, file, page, key])
    signed = sign_result(result, file, page, key=key, tool=tool, output=target)
    click.echo(f"signed: {target}")
    click.echo(f"  by: {one_line(signed.key or 'an unknown key')}")
    click.echo(f"  recording: {one_line(file.name)}, {signed.recording}")
    if page is not None:
        click.echo(f"  page: {one_line(page.name)}, {signed.page}")
