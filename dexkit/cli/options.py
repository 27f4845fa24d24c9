"""Options that several commands have: one definition each, with one help text and one type.

An option of which commands differ in one word or in the default is a function of that.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from dexkit import option_texts
from dexkit.errors import UsageError
from dexkit.escaping import one_line
from dexkit.hand import Side
from dexkit.models import DIALECTS

__all__ = [
    "DOMAIN",
    "FILE",
    "OUTPUT_FILE",
    "LocalPath",
    "Number",
    "dds_options",
    "device_option",
    "devices_by_side",
    "devices_option",
    "dialect_option",
    "domain_option",
    "dry_run_option",
    "duration_option",
    "force_option",
    "found_interface",
    "grade_option",
    "host_option",
    "html_option",
    "interface_option",
    "interfaces_option",
    "jobs_option",
    "json_option",
    "junit_option",
    "level_option",
    "list_option",
    "loop_option",
    "markdown_option",
    "one_side_option",
    "out_option",
    "output_option",
    "overwrite_option",
    "pace_option",
    "port_option",
    "prefix_option",
    "prefixed_topics",
    "quiet_option",
    "real_time_option",
    "record_option",
    "recording_option",
    "require_option",
    "result_option",
    "seed_option",
    "side_option",
    "topic_option",
    "verbose_option",
    "view_option",
    "wait_for_interface_option",
    "wait_option",
    "yes_option",
]

F = TypeVar("F", bound=Callable[..., Any])


class Number(click.FloatRange):
    """A finite number. ``click.FloatRange`` accepts NaN, which is neither too small nor too
    large, and numbers that no clock or timer can count.
    """

    _LARGEST = 1e9  # seconds: 30 years

    def _describe_range(self) -> str:
        """The range for the help; empty without bounds, where click would write ``x<=None``."""
        return "" if self.min is None and self.max is None else super()._describe_range()

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number."""
        found: float = super().convert(value, param, ctx)
        if not math.isfinite(found):
            self.fail(f"{one_line(value, 40)} is not a finite number.", param, ctx)
        if abs(found) > self._LARGEST:
            self.fail(f"{one_line(value, 40)} is larger than {self._LARGEST:g}.", param, ctx)
        return found


class _Sides(click.Choice):  # type: ignore[type-arg]
    """``left``, ``right`` or ``both``, as a tuple of :class:`~dexkit.hand.Side`."""

    def __init__(self) -> None:
        super().__init__([*map(str, Side), "both"])

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Side, ...]:
        """The sides; a tuple is returned as it is."""
        if isinstance(value, tuple):
            return value
        name = super().convert(value, param, ctx)
        return tuple(Side) if name == "both" else (Side(name),)


DOMAIN = click.IntRange(0, 230)
"""A DDS domain; those above have no ports (RTPS 9.6.1.1)."""


class LocalPath(click.Path):
    """A path of this machine, as a :class:`~pathlib.Path`; not a URL.

    :param exists: it must be there.
    :param file_okay: whether it may be a file, if it is there; ``dir_okay`` likewise for a folder.
    :param folder: whether it may be written as a folder is, with a slash at the end.
    """

    def __init__(
        self,
        *,
        exists: bool = False,
        file_okay: bool = True,
        dir_okay: bool = True,
        folder: bool = True,
    ) -> None:
        super().__init__(exists=exists, file_okay=file_okay, dir_okay=dir_okay, path_type=Path)
        self._folder = folder and dir_okay

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path.

        :raises UsageError: it is a URL, or the name of a folder where a file is meant.
        """
        text = os.fsdecode(value)
        if "://" in text and not (os.path.lexists(text) or os.path.isdir(os.path.dirname(text))):
            from dexkit.redaction import redact  # which no other start needs

            raise UsageError(
                f"{redact(text, text)} is a URL, and a file or a folder of this machine is needed",
                hint="copy it to this machine first; 'dexkit audit' alone reads behind URLs",
            )
        if not self._folder and text.endswith("/"):
            raise UsageError(f"{text} is the name of a folder, and a file is needed")
        return super().convert(value, param, ctx)


FILE = LocalPath()
OUTPUT_FILE = LocalPath(folder=False)


# ------------------------------------------------------------------------------ DDS


def dds_options(
    *, default_domain: int | None = 1, domain_default_text: str = ""
) -> Callable[[F], F]:
    """``--domain`` and ``--interface``.

    The interface defaults to loopback, or to that by which the first of ``DEXKIT_PEERS`` is
    reached.

    :param domain_default_text: what ``--help`` prints where there is no fixed default.
    """
    suffix = f"  [default: {domain_default_text}]" if domain_default_text else ""
    domain = domain_option(
        f"DDS domain: 0 is the robot, 1 xr_teleoperate's simulation.{suffix}", default_domain
    )
    interface = interface_option(
        "Network interface: name, address or prefix (192.168.123.0/24). Traffic stays on "
        "this machine unless one is named.",
        callback=_interface,
    )
    return lambda function: domain(interface(function))


def domain_option(help: str, default: int | None = None) -> Callable[[F], F]:
    """``--domain``.

    :param default: None for none, and for no default in ``--help``.
    """
    return click.option(
        "--domain", type=DOMAIN, default=default, show_default=default is not None, help=help
    )


def interface_option(
    help: str,
    *,
    callback: Callable[[click.Context, click.Parameter, str], str] | None = None,
) -> Callable[[F], F]:
    """``--interface``, by default loopback.

    :param callback: resolves the text to an interface of this machine; without it the text is
        passed on.
    """
    return click.option(
        "--interface", default="lo", show_default=True, metavar="IF", callback=callback, help=help
    )


def interfaces_option(help: str) -> Callable[[F], F]:
    """``--interface``, repeated, as ``interfaces``."""
    return click.option("--interface", "interfaces", multiple=True, metavar="IF", help=help)


_WAIT = "dexkit.wait_for_interface"


def wait_for_interface_option(help: str, default: float = 0.0) -> Callable[[F], F]:
    """``--wait-for-interface S``; the interface of :func:`dds_options` is waited for."""
    return click.option(
        "--wait-for-interface",
        type=Number(min=0),
        default=default,
        show_default=default > 0,
        metavar="S",
        is_eager=True,  # before --interface
        callback=lambda ctx, param, value: ctx.meta.setdefault(_WAIT, value),
        help=help,
    )


def found_interface(ctx: click.Context, text: str) -> str:
    """The name of the interface that an option means, waited for if that was asked for.

    :raises DdsSetupError: it is not there.
    """
    from dexkit.interface_names import find_interface, wait_for_interface

    seconds = ctx.meta.get(_WAIT, 0.0)
    if ctx.resilient_parsing or not seconds:
        return find_interface(text)
    return wait_for_interface(
        text,
        seconds,
        waiting=lambda why: click.echo(f"waiting for up to {seconds:g} s: {why}", err=True),
    )


def _interface(ctx: click.Context, parameter: click.Parameter, text: str) -> str:
    """Resolve ``--interface``; without it, that by which the peers are reached."""
    from dexkit.interface_names import interface_towards, named_peers

    if ctx.resilient_parsing:
        return text
    peers = named_peers()
    given = ctx.get_parameter_source(str(parameter.name))
    if peers and given is click.core.ParameterSource.DEFAULT:
        return interface_towards(peers[0])
    return found_interface(ctx, text)


def topic_option(verb: str, default: str) -> Callable[[F], F]:
    """``--topic``, repeated, as ``topics``."""
    return click.option(
        "--topic",
        "topics",
        multiple=True,
        metavar="TOPIC",
        help=f"{verb} this topic, e.g. rt/dex1/left/cmd, /dex1/left/cmd or '/dex1/*'; may be "
        f"repeated.  [default: {default}]",
    )


def prefix_option(help: str) -> Callable[[F], F]:
    """``--prefix``: of topics such as ``rt/r2/dex3/left/cmd``; empty for none."""

    def checked(ctx: click.Context, parameter: click.Parameter, text: str) -> str:
        if not text or ctx.resilient_parsing:
            return text
        from dexkit.topics import checked_prefix

        return checked_prefix(text)

    return click.option("--prefix", default="", metavar="NAME", callback=checked, help=help)


def prefixed_topics(topics: Sequence[str], prefix: str) -> tuple[str, ...]:
    """The topics of ``--topic`` under a prefix; all that are there if none is named."""
    if not prefix:
        return tuple(topics)
    from dexkit.topics import under_prefix
    from dexkit.traces.names import dds_topic

    return tuple(under_prefix(dds_topic(topic), prefix) for topic in topics or ("*",))


def force_option() -> Callable[[F], F]:
    """``--force`` of the commands that publish."""
    return click.option(
        "--force",
        is_flag=True,
        help="Publish even if another program publishes the same topics.",
    )


# ------------------------------------------------------------------------------ sessions


def pace_option(more: str = "") -> Callable[[F], F]:
    """``--pace``: a factor of time."""
    return click.option(
        "--pace",
        type=Number(1e-3, 1e3),
        default=1.0,
        show_default=True,
        help=f"0.5 plays in twice the time. {more}".rstrip(),
    )


def loop_option() -> Callable[[F], F]:
    """``--loop``."""
    return click.option("--loop", is_flag=True, help="Start over at the end, until Ctrl-C.")


# ------------------------------------------------------------------------------ conformance


def grade_option(help: str) -> Callable[[F], F]:
    """``--grade``: one of the two grades, as text, or None."""
    return click.option("--grade", type=click.Choice(option_texts.GRADES), help=help)


def level_option() -> Callable[[F], F]:
    """``--level``: one of the three levels, as text, or None."""
    return click.option(
        "--level",
        type=click.Choice(option_texts.LEVELS, case_sensitive=False),
        help=option_texts.LEVEL,
    )


# ------------------------------------------------------------------------------ hands


def side_option(
    help: str, *, default: str | None = None, required: bool = False
) -> Callable[[F], F]:
    """``--side``, as a tuple ``sides`` of :class:`~dexkit.hand.Side`.

    :param default: None for none, and for no default in ``--help``.
    """
    # an explicit default of None would count as a value for required (click 8.3)
    given: dict[str, Any] = {} if default is None else {"default": default, "show_default": True}
    return click.option("--side", "sides", type=_Sides(), required=required, help=help, **given)


def one_side_option(help: str, *, required: bool = False) -> Callable[[F], F]:
    """``--side`` of the commands for one hand, as text ``side``, or None."""
    return click.option(
        "--side", type=click.Choice(list(map(str, Side))), required=required, help=help
    )


def device_option(help: str) -> Callable[[F], F]:
    """``--device`` of the commands for one device."""
    return click.option("--device", metavar="PATH|SERIAL", help=help)


def devices_option(help: str) -> Callable[[F], F]:
    """``--device``, repeated, as ``devices``; :func:`devices_by_side` reads them."""
    return click.option("--device", "devices", multiple=True, metavar="PATH", help=help)


def yes_option(question: str) -> Callable[[F], F]:
    """``--yes``.

    :param question: what is not asked then.
    """
    return click.option("--yes", is_flag=True, help=f"Do not ask {question}.")


def devices_by_side(devices: Sequence[str], sides: Sequence[Side]) -> dict[Side, str]:
    """The paths of ``--device``, given as PATH or SIDE=PATH.

    :raises UsageError: a path fits no side, or a side has two.
    """
    by_side: dict[Side, str] = {}
    for text in devices:
        prefix, equals, path = text.partition("=")
        if equals and prefix in [str(s) for s in Side]:
            side = Side(prefix)
        elif len(sides) == 1:
            side, path = sides[0], text
        else:
            raise UsageError(
                f"--device {text} names no side", hint="--device left=PATH --device right=PATH"
            )
        if side not in sides:
            raise UsageError(f"--device {text}, but only the {sides[0]} hand is served")
        if side in by_side:
            raise UsageError(f"two devices for the {side} hand: {by_side[side]} and {path}")
        by_side[side] = path
    return by_side


def dialect_option(
    help: str, *, default: str | None = None, others: Sequence[str] = ()
) -> Callable[[F], F]:
    """``--dialect``: a dialect's name, or None.

    :param default: None for none, and for no default in ``--help``.
    :param others: further values.
    """
    return click.option(
        "--dialect",
        type=click.Choice([*DIALECTS, *others]),
        default=default,
        show_default=default is not None,
        help=help,
    )


def wait_option(help: str, *, default: float | None = 10.0) -> Callable[[F], F]:
    """``--wait S``: seconds of patience with hands that are not there yet; None for no limit."""
    return click.option(
        "--wait",
        type=Number(min=0),
        default=default,
        show_default=default is not None,
        metavar="S",
        help=help,
    )


# ------------------------------------------------------------------------------ running


def duration_option(
    help: str = "Stop after S seconds.  [default: at Ctrl-C]", *, least: float | None = None
) -> Callable[[F], F]:
    """``--duration S``; more than 0, or at least ``least``."""
    return click.option(
        "--duration",
        type=Number(min=least or 0, min_open=least is None),
        metavar="S",
        help=help,
    )


def real_time_option() -> Callable[[F], F]:
    """``--real-time/--no-real-time``."""
    return click.option(
        "--real-time/--no-real-time",
        default=True,
        show_default=True,
        help="Run before ordinary processes where the system permits it (docs/service.md).",
    )


def view_option() -> Callable[[F], F]:
    """``--view`` of the commands that run hands; see :func:`dexkit.view.viewer_process.viewer`."""
    return click.option(
        "--view",
        is_flag=True,
        help="Show the hands on a page in the browser; needs dexkit[view] (docs/view.md).",
    )


def dry_run_option(help: str) -> Callable[[F], F]:
    """``--dry-run``."""
    return click.option("--dry-run", is_flag=True, help=help)


def jobs_option() -> Callable[[F], F]:
    """``--jobs N``, or None."""
    return click.option(
        "--jobs", type=click.IntRange(1, 1024), help="Processes.  [default: one per processor]"
    )


def list_option(help: str) -> Callable[[F], F]:
    """``--list``, as ``list_only``."""
    return click.option("--list", "list_only", is_flag=True, help=help)


def host_option(help: str) -> Callable[[F], F]:
    """``--host ADDRESS`` of what is served by TCP, by default to this machine only."""
    return click.option(
        "--host", default="127.0.0.1", show_default=True, metavar="ADDRESS", help=help
    )


def port_option(help: str) -> Callable[[F], F]:
    """``--port N`` of what is served by TCP; None is the command's own choice."""
    return click.option("--port", type=click.IntRange(0, 65535), metavar="N", help=help)


def quiet_option() -> Callable[[F], F]:
    """``--quiet``."""
    return click.option("--quiet", is_flag=True, help="Warnings only; no status line.")


# ------------------------------------------------------------------------------ output


def overwrite_option(what: str) -> Callable[[F], F]:
    """``--overwrite`` of the commands that write a recording.

    :param what: is overwritten.
    """
    return click.option("--overwrite", is_flag=True, help=f"Overwrite {what}.")


def json_option(help: str) -> Callable[[F], F]:
    """``--json`` of the commands that print their result, as ``as_json``."""
    return click.option("--json", "as_json", is_flag=True, help=help)


def result_option(help: str) -> Callable[[F], F]:
    """``--result FILE`` of the commands that write their result (JSON), as ``result_path``."""
    return click.option("--result", "result_path", type=OUTPUT_FILE, metavar="FILE", help=help)


def html_option(help: str = option_texts.PAGE, *, report: bool = True) -> Callable[[F], F]:
    """``--html FILE``, as ``html_path``.

    :param report: the page is a report, and ``--report`` is another name of the option.
    """
    names = ("--report", "--html") if report else ("--html",)
    return click.option(*names, "html_path", type=OUTPUT_FILE, metavar="FILE", help=help)


def record_option(help: str) -> Callable[[F], F]:
    """``--record FILE``, as ``record_path``: what is seen meanwhile is recorded there."""
    return click.option(
        "--record",
        "record_path",
        type=LocalPath(dir_okay=False),
        metavar="FILE.mcap",
        help=help,
    )


def output_option(metavar: str, help: str, default: str | None = None) -> Callable[[F], F]:
    """``-o``, ``--output``: the only file that a command writes."""
    return click.option(
        *("-o", "--output"),
        type=OUTPUT_FILE,
        default=default,
        show_default=default is not None,
        metavar=metavar,
        help=help,
    )


def out_option(
    help: str, default: str | None = None, *, required: bool | None = None
) -> Callable[[F], F]:
    """``--out DIR``: the folder for all that a command writes.

    :param default: None where it must be named.
    :param required: whether it must; None without a default.
    """
    return click.option(
        "--out",
        type=LocalPath(file_okay=default is None),
        default=None if default is None else Path(default),
        required=default is None if required is None else required,
        show_default=default is not None,
        metavar="DIR",
        help=help,
    )


def junit_option() -> Callable[[F], F]:
    """``--junit FILE``, as ``junit_path``."""
    return click.option(
        "--junit", "junit_path", type=OUTPUT_FILE, metavar="FILE", help="Write JUnit XML."
    )


def markdown_option(default: str = "") -> Callable[[F], F]:
    """``--markdown FILE``, as ``markdown_path``."""
    suffix = f"  [default: {default}]" if default else ""
    return click.option(
        "--markdown",
        "markdown_path",
        type=OUTPUT_FILE,
        metavar="FILE",
        help=f"{option_texts.SUMMARY}; - prints it.{suffix}",
    )


def recording_option(then: str = "") -> Callable[[F], F]:
    """``--recording RUN.mcap``: the recording of a result.

    :param then: what the command does with it, for the help.
    """
    return click.option(
        "--recording",
        type=LocalPath(exists=True),
        metavar="RUN.mcap",
        help=f"The recording that was judged{then}. Default: the one that the result names, if it "
        "lies beside it.",
    )


def verbose_option(help: str) -> Callable[[F], F]:
    """``-v``, ``--verbose``."""
    return click.option("-v", "--verbose", is_flag=True, help=help)


def require_option(example: str) -> Callable[[F], F]:
    """``--require PREFIX``, repeated."""
    return click.option(
        "--require",
        multiple=True,
        metavar="PREFIX",
        help=f"{option_texts.REQUIRE}, e.g. {example}; may be repeated.",
    )


# ------------------------------------------------------------------------------ emulated devices


def seed_option(what: str, default: int = 0) -> Callable[[F], F]:
    """``--seed N``.

    :param what: what is random.
    """
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=default,
        show_default=True,
        help=f"Seed of the random numbers of {what}.",
    )
