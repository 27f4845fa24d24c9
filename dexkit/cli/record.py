"""``dexkit record``: DDS topics into an mcap file."""

from __future__ import annotations

import contextlib
import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dexkit import threads
from dexkit.cli.command_help import Command
from dexkit.cli.options import (
    FILE,
    LocalPath,
    dds_options,
    duration_option,
    overwrite_option,
    prefix_option,
    prefixed_topics,
    topic_option,
)
from dexkit.cli.remarks import remark, remarks
from dexkit.cli.status_line import Stderr
from dexkit.errors import DexkitError, TraceError, UsageError
from dexkit.escaping import REMARK, one_line
from dexkit.stop_signals import stop_on_signals

if TYPE_CHECKING:
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import HandsElsewhere
    from dexkit.traces import Recorder
    from dexkit.traces.dds_recording import DdsRecording

__all__ = ["command"]


@click.command(
    "record",
    cls=Command,
    exit_codes={
        0: "no loss was detected",
        1: "nothing was received, something is missing (it is reported), OUT was renamed "
        "meanwhile, or an episode could not be merged",
        2: "wrong usage, or OUT cannot be written",
    },
)
@click.argument("out", type=LocalPath(dir_okay=False))
@topic_option("Record", "every topic of a known type, also those that appear later")
@prefix_option("Only topics under rt/NAME/, as rt/r2/dex3/left/cmd for r2.")
@dds_options(default_domain=None, domain_default_text="where hands are: 1, else 0")
@duration_option()
@overwrite_option("OUT, when the first message arrives")
@click.option(
    "--beside-episodes",
    "episodes",
    type=FILE,
    metavar="DIR",
    help="Directory in which xr_teleoperate writes episodes meanwhile; their frames get the times "
    "of the recorded messages.",
)
def command(
    out: Path,
    topics: tuple[str, ...],
    prefix: str,
    domain: int | None,
    interface: str,
    duration: float | None,
    overwrite: bool,
    episodes: Path | None,
) -> int:
    """Record DDS topics to OUT, an mcap file, until Ctrl-C.

    Payloads are written unchanged, with reception time and source timestamp, and with ros2msg
    schemas for PlotJuggler, Foxglove and readers of ROS 2 bags. A killed recorder loses at most
    half a second. Without --domain it records where hands are: on 1, that of simulations, or on 0,
    the robot's.

    With --beside-episodes, each episode written to DIR during the recording is merged with it into
    OUT_NAME.mcap: hands from the wire, arms and pictures at the true times of their frames.
    """
    from dexkit.dds import DdsNode
    from dexkit.doctor.hand_domains import HandsElsewhere, listening_domain
    from dexkit.traces import Recorder
    from dexkit.traces.dds_recording import record_topics
    from dexkit.traces.names import dds_topic

    if out.exists() and not out.is_dir() and not overwrite:
        raise UsageError(
            f"{out} exists", hint="choose another name, or overwrite it with --overwrite"
        )
    topics = prefixed_topics(topics, prefix)
    before = _episodes(episodes) if episodes is not None else {}
    started = time.monotonic()
    form = "%(levelname)s %(message)s"
    logging.basicConfig(level=logging.WARNING, format=form, handlers=[Stderr()], force=True)
    chosen, why = listening_domain(domain, interface)
    with stop_on_signals() as stop, DdsNode(domain=chosen, interface=interface) as node:
        if why:
            remark("note", why)
        elsewhere = HandsElsewhere(chosen, interface)
        asked = {"topics": " ".join(map(dds_topic, topics))} if topics else None
        recorder = Recorder(out, overwrite=overwrite, keep_empty=False, metadata=asked)
        status = _Status(recorder, started, elsewhere)
        with recorder:
            what = ", ".join(topics) if topics else "every known type"
            click.echo(f"ready: recording {what} on domain {chosen}, {interface}, to {out}")
            recording = record_topics(
                node,
                recorder,
                topics or None,
                stop=stop.event,
                duration=duration,
                on_tick=status.tick,
            )
        status.clear()
        if not recorder.written:
            threads.check()  # why nothing came is known then
            _refuse_empty(node, recording, time.monotonic() - started, elsewhere)
    for topic, why in recording.unknown.items():
        remark("warning", f"{topic} was not recorded: {why}")
    remarks("warning", filter(None, (*recording.losses.describe(), recorder.displaced)))
    dropped = recorder.dropped
    per_topic = ", ".join(
        f"{one_line(topic)} {count}" for topic, count in sorted(recorder.offered.items())
    )
    click.echo(
        f"{out}: {recorder.written} messages ({per_topic}), {_describe_losses(recorder, recording)}"
    )
    merged = True
    if episodes is not None:
        merged = _merge_episodes(out, episodes, before, overwrite)
    return 1 if dropped or recording.losses or recorder.displaced or not merged else 0


def _episodes(folder: Path) -> dict[Path, tuple[int, int]]:
    """The episodes below a folder, each with the time and size of its file.

    :raises UsageError: it is not a folder. One that is not there yet is empty.
    """
    from dexkit.traces.sessions.episodes import DATA, episode_folders

    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is not a folder")
    found = {}
    for episode in episode_folders(folder) if folder.exists() else ():
        with contextlib.suppress(FileNotFoundError):  # it may be deleted meanwhile
            status = (episode / DATA).stat()
            found[episode] = (status.st_mtime_ns, status.st_size)
    return found


def _merge_episodes(
    out: Path, folder: Path, before: dict[Path, tuple[int, int]], force: bool
) -> bool:
    """Merge the episodes that are new or changed; whether there are some and all are merged."""
    from dexkit.traces import open_trace
    from dexkit.traces.sessions.paths import file_name
    from dexkit.traces.sessions.sources import beside

    new = [e for e, status in _episodes(folder).items() if before.get(e) != status]
    if not new:
        remark("warning", f"no episode was written to {folder}")
        return False
    trace, whole = open_trace(out), True
    for episode in new:
        name = file_name("_".join(episode.relative_to(folder).parts) or episode.name)
        target = out.with_name(f"{out.stem}_{name}.mcap")
        try:
            report = beside(episode, trace, source=folder).convert(target, False, force)
        except DexkitError as error:
            whole = False
            remark("warning", f"not merged: {error}", episode)
            continue
        remarks("warning", (*report.corrections, *report.problems), episode)
        click.echo(one_line(f"{target}: {report.messages} messages ({report.form})", REMARK))
    return whole


def _describe_losses(recorder: Recorder, recording: DdsRecording) -> str:
    brief = recording.losses.status()
    return f"{recorder.dropped} dropped" + (f", {brief}" if brief else "")


def _refuse_empty(
    node: DdsNode, recording: DdsRecording, waited: float, elsewhere: HandsElsewhere
) -> None:
    """Report that nothing was received, and the topics that are on the domain, or where hands are.

    :raises TraceError: always, with exit code 1.
    """
    seen = sorted({f"{e.topic} ({e.type_name})" for e in node.endpoints() if not e.own})
    seen = [one_line(entry) for entry in seen if not entry.startswith("DCPS")]
    others = [p.process or p.key for p in node.discovery.participants() if not p.own]
    if where := elsewhere.now():
        hint = f"there is {where}"
    elif not others:
        hint = "no other participant was seen there: is it another --domain or --interface?"
    elif not seen:
        hint = f"participants seen: {', '.join(others)}; they publish and subscribe nothing"
    else:
        hint = f"participants seen: {', '.join(others)}; topics seen: {', '.join(seen)}"
    error = TraceError(
        f"nothing was recorded in {waited:.1f} s on domain {node.domain}, {node.interface}"
        + (f" (subscribed: {', '.join(recording.subscribed)})" if recording.subscribed else ""),
        hint=hint,
    )
    error.exit_code = 1
    raise error


class _Status:
    """One line that is rewritten on a terminal, or a line every ten seconds elsewhere."""

    def __init__(self, recorder: Recorder, started: float, elsewhere: HandsElsewhere) -> None:
        self._recorder = recorder
        self._elsewhere = elsewhere
        self._started = started
        self._tty = sys.stderr.isatty()
        self._before: dict[str, int] = {}
        self._at = self._last_line = started

    def tick(self, recording: DdsRecording) -> None:
        now = time.monotonic()
        offered = self._recorder.offered
        if not offered and (where := self._elsewhere.look()):
            self.clear()
            remark("note", where)
        rates = {
            topic: (count - self._before.get(topic, 0)) / (now - self._at)
            for topic, count in sorted(offered.items())
        }
        if not self._tty and now - self._last_line < 10:
            return
        self._before, self._at, self._last_line = offered, now, now
        text = f"{now - self._started:6.1f} s  {sum(offered.values()):,} messages"
        text += f"  {_describe_losses(self._recorder, recording)}"
        text += "".join(
            f"  {one_line(t.removeprefix('rt/'))} {hz:.0f} Hz" for t, hz in rates.items()
        )
        if not offered:
            text += f"  waiting for {', '.join(recording.subscribed) or 'topics'}"
        if self._tty:
            import shutil

            columns = shutil.get_terminal_size().columns
            click.echo(f"\r\033[K{text[: columns - 1]}", nl=False, err=True)
        else:
            click.echo(text, err=True)

    def clear(self) -> None:
        if self._tty:
            click.echo("\r\033[K", nl=False, err=True)
