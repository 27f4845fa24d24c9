"""``dexkit check``: judge a recording."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from dexkit import option_texts
from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    FILE,
    LocalPath,
    dialect_option,
    grade_option,
    html_option,
    junit_option,
    level_option,
    list_option,
    prefix_option,
    require_option,
    result_option,
    side_option,
    verbose_option,
)
from dexkit.console import Console
from dexkit.documents import check_output_paths
from dexkit.errors import ConformanceError, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.hand import Side
from dexkit.models import DIALECTS
from dexkit.robots import ROBOTS

_MOST = 40
"""Differences from a result that are printed."""


@click.command(
    "check",
    cls=Command,
    exit_codes={
        0: "every MUST that could be judged is met; with --grade, those of that grade; with "
        "--against, nothing differs, whatever the verdict",
        1: "one is not met; with --against, something differs, or it is another recording",
        2: "the recording is not usable or damaged (what is left is judged all the same), "
        "nothing in it could be judged, or the client did not allow to judge a MUST",
    },
)
@click.argument(
    "recording",
    type=LocalPath(exists=True),
    metavar="IN.mcap",
    required=False,
)
@side_option("Hands to judge. Default: those of the run, else all hands in the recording.")
@dialect_option(
    "Dialect of the hand, or model of the robot; auto takes it from topics and types.",
    default="auto",
    others=("auto", *ROBOTS),
)
@prefix_option("Judge the hands under rt/NAME/, where there are several robots.")
@require_option("DEX1-RATE")
@level_option()
@grade_option(option_texts.GRADE)
@click.option(
    "--capabilities",
    type=FILE,
    metavar="FILE.toml",
    help=f"{option_texts.CAPABILITIES}. Default: what the recording of a run says",
)
@click.option(
    "--against",
    type=FILE,
    metavar="RESULT.json",
    help="Judge again and compare with this result, without any other option.",
)
@list_option(option_texts.LIST)
@result_option(option_texts.RESULT)
@junit_option()
@html_option()
@verbose_option("Also print what could not be judged, and why.")
def command(
    recording: Path | None,
    sides: tuple[Side, ...] | None,
    dialect: str,
    prefix: str,
    require: tuple[str, ...],
    level: str | None,
    grade: str | None,
    capabilities: Path | None,
    against: Path | None,
    list_only: bool,
    result_path: Path | None,
    junit_path: Path | None,
    html_path: Path | None,
    verbose: bool,
) -> None:
    """Judge a recording against the requirements of its hand.

    IN.mcap is a session recorded with 'dexkit record', a ROS 2 bag, or the recording of a
    conformance run with all its stimuli. In a session the client's commands are judged too; errors
    of the client do not fail the hand. With --require DEX1-CLIENT (DEX3-, DEX5-) the verdict is
    about the client.

    With --against, the recording is judged with all requirements, and everything that the result
    file states is compared: requirements, verdicts, grades, figures and texts. What no recording
    tells is printed as stated.
    """
    if against is not None:
        _compare(recording, against)
        return
    from dexkit.conformance.kit.claims import Claims
    from dexkit.conformance.kit.decoding import recording_of
    from dexkit.conformance.kit.judge import judge
    from dexkit.conformance.kit.requirements import Kind, catalogue, select
    from dexkit.conformance.kit.robot import robot_in
    from dexkit.conformance.kit.run_record import recorded_claims
    from dexkit.conformance.report.terminal import print_result
    from dexkit.digests import sha256_of_file
    from dexkit.traces.sessions.judgeable import judgeable

    check_output_paths([result_path, junit_path, html_path], [recording, capabilities])
    view, model_name, also = None, None, ""
    if dialect != "auto":
        model_name = dialect if dialect in ROBOTS else DIALECTS[dialect].model
    if recording is not None:
        context = click.get_current_context()
        trace, imported = context.with_resource(judgeable(recording))
        for text in imported or ():
            click.echo(f"warning: {text}", err=True)
        for text in trace.damage:
            click.echo(f"warning: {text}", err=True)
        wanted = None if dialect == "auto" else dialect
        view = recording_of(trace, wanted, sides or (), prefix)
        robot = robot_in(trace) if dialect == "auto" and view.layer != "robot" else None
        also = f"there is a robot, too: judge it with --dialect {robot.name}" if robot else ""
        model_name = view.model.name
    if capabilities is None and view is not None:
        claims = recorded_claims(view.run)
    else:
        claims = Claims.load(capabilities, model_name)
    model_name = model_name or claims.hand.get("model")
    if view is None:
        every = catalogue(model_name, None)
    else:
        every = catalogue(model_name, view.layer)
        every += catalogue(model_name, "usb") if view.usb is not None else ()
        every += catalogue(model_name, "client") if view.stimulus is None else ()
    requirements = select(claims.apply(every), prefixes=require, level=level)
    if not requirements:
        raise ConformanceError("no requirement is left by --require and --level together")
    if list_only:
        from dexkit.conformance.kit.selection import print_selection

        print_selection(requirements)
        return
    if view is None or recording is None:
        raise _no_recording()
    subject = {"recording": recording.name}
    if imported is None:  # else it is of several files, or a temporary one
        subject["recording_sha256"] = sha256_of_file(trace.path)
    result = judge(view, requirements=requirements, claims=claims, subject=subject)
    console = Console()
    print_result(result, console, verbose=verbose, more="-v shows why")
    if also:
        console.print(also)
    if result_path:
        from dexkit.conformance.kit.result_file import write_json

        write_json(result, result_path)
    if junit_path:
        from dexkit.conformance.report.junit import write_junit

        write_junit(result, junit_path)
    if html_path:
        from dexkit.conformance.report.html import write_html

        write_html(result, view, html_path, recording=recording)
        console.print(f"report: {html_path}", highlight=False)
    if result.judged == 0:
        raise ConformanceError(
            "nothing was judged, which is not a pass",
            hint="dexkit check -v shows what each requirement needs",
        )
    if trace.damage:
        raise ConformanceError(
            "the recording is damaged; the verdict covers the readable part only: "
            f"{trace.damage[0]}",
            hint="'dexkit info' names all of the damage; record again, or copy the file again",
        )
    sys.exit(result.exit_code(None if grade is None else Kind(grade)))


def _no_recording() -> UsageError:
    return UsageError("which recording is to be judged?", hint="dexkit check RECORDING.mcap")


def _compare(recording: Path | None, result: Path) -> None:
    """Judge a recording again, and print what differs from a result.

    :raises click.exceptions.Exit: something does.
    """
    from dexkit import __version__, documents
    from dexkit.conformance.kit.rejudge import compare_with_recording
    from dexkit.conformance.kit.requirements import Kind
    from dexkit.conformance.kit.result_file import parse_result
    from dexkit.digests import sha256_of_file

    context = click.get_current_context()
    for name in context.params.keys() - {"recording", "against"}:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise UsageError("--against takes no other options: it judges as the result says")
    if recording is None:
        raise _no_recording()
    document = documents.read_json(result)
    stated = parse_result(document, result)
    named, real = stated.subject.get("recording_sha256"), sha256_of_file(recording)
    if named is not None and named != real:
        click.echo(f"DIFFERS: {recording} is not the recording that {result} was judged from")
        click.echo(f"  SHA-256 {one_line(named)} in the result, {real} of the recording")
        raise click.exceptions.Exit(1)
    found = compare_with_recording(document, recording)
    for line in [*found.remarks, *found.part()]:
        click.echo(one_line(line, REMARK))
    for path, value in found.stated.items():
        shown = one_line(json.dumps(value, ensure_ascii=False), REMARK)
        click.echo(f"as stated, not compared: {path} {shown}")
    if not found.differences:
        click.echo(f"the same: {recording}, judged by dexkit {__version__}, gives {result}")
        # the last line of a part is the verdict of all requirements together
        for kind in () if found.is_part else Kind:
            click.echo(f"  {one_line(stated.grade(kind).sentence(), REMARK)}")
        return
    click.echo(f"DIFFERS: {result} is not what {recording} gives")
    for difference in found.differences[:_MOST]:
        click.echo(f"  {difference}")
    if len(found.differences) > _MOST:
        click.echo(f"  and {len(found.differences) - _MOST} more differences")
    made_by = stated.environment.get("dexkit", "of an unknown version")
    if made_by != __version__:
        click.echo(f"  dexkit {one_line(made_by)} judged, and this is {__version__}: use that one")
    raise click.exceptions.Exit(1)
