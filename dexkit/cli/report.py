"""``dexkit report``: write the reports of a result file again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    LocalPath,
    html_option,
    junit_option,
    markdown_option,
    recording_option,
    verbose_option,
)
from dexkit.documents import check_output_paths, write_file
from dexkit.errors import UsageError

if TYPE_CHECKING:
    from dexkit.conformance.kit.recording import Recording
    from dexkit.conformance.kit.results import RunResult


def write_text(path: Path, text: str) -> None:
    """Write a report; ``-`` is standard output."""
    if str(path) == "-":
        click.echo(text, nl=False)
    else:
        write_file(path, text)


@click.command(
    "report",
    cls=Command,
    exit_codes={
        0: "the reports are written, whatever the verdict",
        2: "the result, or the recording, cannot be used",
    },
)
@click.argument("result", type=LocalPath(exists=True), metavar="RESULT.json")
@recording_option(": the page then shows plots")
@html_option()
@markdown_option()
@junit_option()
@verbose_option("Also print what could not be judged, and why.")
def command(
    result: Path,
    recording: Path | None,
    html_path: Path | None,
    markdown_path: Path | None,
    junit_path: Path | None,
    verbose: bool,
) -> None:
    """Write the reports of a result file.

    A result file comes from 'dexkit check --result FILE' or from the conformance suite with
    '--result FILE'. Without an option the result is printed as a table.
    """
    from dexkit.conformance.kit.result_file import read_json
    from dexkit.conformance.report.html import write_html
    from dexkit.conformance.report.junit import write_junit
    from dexkit.conformance.report.markdown import render_markdown
    from dexkit.conformance.report.terminal import print_result
    from dexkit.console import Console

    found = read_json(result)
    file = recording or recording_beside(result, found.subject.get("recording", ""))
    check_output_paths([html_path, markdown_path, junit_path], [result, file])
    if html_path:
        view = None
        if file is not None:
            view = _matching_recording(file, found, given=recording is not None)
        shown = file if view is not None else None
        write_html(found, view, html_path, recording=shown)
    if markdown_path:
        write_text(markdown_path, render_markdown(found))
    if junit_path:
        write_junit(found, junit_path)
    if not (html_path or markdown_path or junit_path):
        print_result(found, Console(), verbose=verbose, more="-v shows why")
    for path in (html_path, junit_path, markdown_path):
        if path and str(path) != "-":
            click.echo(f"report: {path}", err=True)


def recording_beside(result: Path, name: str) -> Path | None:
    """The recording that the result names, where it lies in the same folder."""
    if not name or Path(name).name != name:
        return None
    path = result.parent / name
    return path if path.is_file() else None


def _matching_recording(path: Path, result: RunResult, *, given: bool) -> Recording | None:
    """The recording that was judged; None if the one found beside the result is another.

    :raises UsageError: the recording that the user gave is not the one that was judged.
    """
    from dexkit.conformance.kit.decoding import recording_of
    from dexkit.conformance.report.labels import utc_date
    from dexkit.traces import open_trace

    trace = open_trace(path)
    view = recording_of(trace, result.subject.get("dialect"), result.hands)
    for text in trace.damage:
        click.echo(f"warning: {path}: {text}", err=True)
    when = utc_date(view.origin_ns).isoformat(timespec="seconds")
    if not result.recorded_at or when == result.recorded_at:
        return view
    text = f"{path} begins at {when}, the run of this result at {result.recorded_at}"
    if given:
        raise UsageError(text, hint="give the recording that was judged, or none")
    click.echo(f"no plots: {text}", err=True)
    return None
