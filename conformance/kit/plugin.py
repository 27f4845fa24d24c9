"""Pytest options of the conformance suite, and the output of a run.

Registered through the entry point ``pytest11``, so that the suite also runs outside a checkout:
``pytest --pyargs dexkit.conformance --backend ezgripper``. It is loaded in every pytest run of
the environment, so it imports nothing heavy and does nothing unless the suite is collected.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from dexkit.conformance.kit.results import Result, RunResult
    from dexkit.conformance.kit.suite_run import SuiteOptions
    from dexkit.errors import DexkitError

__all__ = ["OPTIONS_KEY", "REPORTED_KEY", "RESULT_KEY", "WHY_KEY"]

OPTIONS_KEY: pytest.StashKey[SuiteOptions | None] = pytest.StashKey()
RESULT_KEY: pytest.StashKey[RunResult] = pytest.StashKey()
REPORTED_KEY: pytest.StashKey[list[Result]] = pytest.StashKey()
"""The results of the tests that ran; ``-k`` can leave some out."""
WHY_KEY: pytest.StashKey[str] = pytest.StashKey()
"""Why there is no result, where a run came to none."""

_MARK = "conformance"
_TRACE = "--dexkit-trace"
_FILES = {
    "result": "result",
    "report": "report",
    "markdown": "summary",
    "recording": "recording",
}
"""Options that name a file to write, and what it is."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the suite's options.

    Each also has a long name, ``--dexkit-NAME``. It is the only one where another plug-in of the
    environment has the short name, so that pytest does not fail there.
    """
    from dexkit import option_texts as texts
    from dexkit.conformance.hands import BUILT_IN
    from dexkit.models import DIALECTS
    from dexkit.robots import ROBOTS

    objects = "; ".join(
        f"{each.model.name} {side}={percent:g}"
        for each in BUILT_IN
        for side, percent in each.objects.items()
    )
    group = parser.getgroup("dexkit conformance", "judge a hand on Unitree's topics")

    def add(name: str, **attributes: Any) -> None:
        long = f"--dexkit-{name}"
        dest = long.removeprefix("--").replace("-", "_")
        try:
            group.addoption(f"--{name}", long, dest=dest, **attributes)
        except ValueError:
            group.addoption(long, dest=dest, **attributes)

    add(
        "backend",
        metavar="NAME",
        help="hand to judge: a name from 'dexkit backends', package.module:Class, or 'external' "
        "for a service that already runs; sim-h1 or sim-g1 for an emulated robot",
    )
    add(
        "device",
        action="append",
        default=[],
        metavar="PATH",
        help="device of the hand, or left=PATH and right=PATH; without it the device is emulated "
        "where dexkit can",
    )
    add(
        "side",
        choices=["left", "right", "both"],
        help="hands to judge; default both, or left with one --device",
    )
    add(
        "dialect",
        choices=[*DIALECTS, *ROBOTS],
        help="dialect of the hand, or the robot (default: the model's own; unitree_go "
        "with external)",
    )
    add("domain", type=int, help="DDS domain; default: a free one, or 0 with external or --device")
    add("interface", default="lo", help="network interface (default: lo)")
    add(
        "object",
        action="append",
        default=[],
        metavar="PCT",
        help="object between the fingers, touched at this percentage of opening (with several "
        "joints: of closing); left=PCT or right=PCT. Default where the kit starts the hand: "
        f"{objects}; 'none' for none",
    )
    add("set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the backend")
    group.addoption(
        _TRACE,
        metavar="FILE",
        help="recorded session to replay; also '--trace FILE' (a file that ends in .mcap)",
    )
    add(
        "require",
        action="append",
        default=[],
        metavar="PREFIX",
        help=_as_in_pytest(f"{texts.REQUIRE}, e.g. DEX1-RATE"),
    )
    add(
        "quick",
        action="store_true",
        help="only the MUSTs that need no long observation",
    )
    add(
        "thorough",
        action="store_true",
        help="every stimulus twelve times, some ten minutes: what appears late or only sometimes",
    )
    add("list", action="store_true", help=_as_in_pytest(texts.LIST))
    add(
        "capabilities",
        metavar="FILE.toml",
        help=_as_in_pytest(f"{texts.CAPABILITIES} (docs/capabilities.md)"),
    )
    add("level", choices=texts.LEVELS, help=_as_in_pytest(texts.LEVEL))
    add("grade", choices=texts.GRADES, help=_as_in_pytest(texts.GRADE))
    add("result", metavar="FILE", help=_as_in_pytest(texts.RESULT))
    add("report", metavar="FILE.html", help=_as_in_pytest(texts.PAGE))
    add(
        "markdown",
        metavar="FILE.md",
        help=_as_in_pytest(f"{texts.SUMMARY}, for a comment or a wiki"),
    )
    add("recording", metavar="FILE.mcap", help="keep the recording")
    add("view", action="store_true", help="show the run on a page in the browser")


def _as_in_pytest(text: str) -> str:
    """A help text in the form of pytest's own: no capital at first, no full stop at the end."""
    return text[0].lower() + text[1:].removesuffix(".")


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(args: list[str]) -> None:
    """Accept ``--trace FILE.mcap`` as the session: pytest's own ``--trace`` takes no value."""
    for i, (option, value) in enumerate(pairwise(args)):
        if option == "--trace" and value.endswith(".mcap"):
            args[i : i + 2] = [_TRACE, value]
            return


def pytest_configure(config: pytest.Config) -> None:
    """Check the options, before anything is started."""
    config.addinivalue_line("markers", f"{_MARK}: a requirement of the conformance suite")
    config.stash[OPTIONS_KEY] = None
    config.stash[REPORTED_KEY] = []
    names = ("device", "side", "object", "set", "domain", "trace", "view", *_FILES)
    if not config.getoption("dexkit_backend"):
        given = [f"--{name}" for name in names if config.getoption(f"dexkit_{name}")]
        if given:
            text = f"{', '.join(given)} without --backend: which hand is to be judged?"
            raise pytest.UsageError(text)
        return
    from dexkit.conformance.kit.suite_run import SuiteOptions
    from dexkit.errors import DexkitError

    try:
        config.stash[OPTIONS_KEY] = SuiteOptions.from_pytest(config)
    except DexkitError as error:
        raise _usage(error) from error
    if config.getoption("numprocesses", None):
        raise pytest.UsageError(
            "the suite judges one hand in one run; pytest-xdist's -n cannot divide it"
        )


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> int | None:
    """``--list``: no hand is needed."""
    if not config.getoption("dexkit_list"):
        return None
    from dexkit.conformance.kit.selection import print_selection
    from dexkit.conformance.kit.suite_run import selection
    from dexkit.errors import DexkitError

    try:
        print_selection(selection(config))
    except DexkitError as error:
        raise _usage(error) from error
    return 0


def _usage(error: DexkitError) -> pytest.UsageError:
    hint = f"\n  {error.hint}" if error.hint else ""
    return pytest.UsageError(f"{error.message}{hint}")


def _items(session: pytest.Session) -> list[pytest.Item]:
    return [i for i in session.items if i.get_closest_marker(_MARK)] if session.items else []


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Set the exit code: a run in which nothing was judged, or a MUST is open, does not pass.

    The suite's exit codes are those of ``dexkit check``: 0 pass, 1 fail, 2 not usable. With
    ``--grade`` the requirements of that kind decide; the others' failures are still reported.
    """
    config = session.config
    usual = (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.NO_TESTS_COLLECTED)
    if config.option.collectonly or exitstatus not in usual:
        return
    if not _items(session) and config.stash[OPTIONS_KEY] is None:
        return  # a pytest run without the suite
    from dexkit.conformance.kit.requirements import Kind
    from dexkit.conformance.kit.results import Grade, Overall, overall_of

    reported: list[Result] = config.stash[REPORTED_KEY]
    grade = config.getoption("dexkit_grade")
    if grade and len(_items(session)) == len(session.items):
        session.exitstatus = Grade.from_results(Kind(grade), reported).overall.exit_code
        return
    if overall_of(reported) is Overall.INCONCLUSIVE:
        session.exitstatus = Overall.INCONCLUSIVE.exit_code


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> Iterator[None]:
    """Print the table of results at the end.

    pytest's own lists of failures are left out: they repeat the table, each side by itself. They
    are printed when they were asked for, or hold other tests.
    """
    session = terminalreporter._session
    result = config.stash.get(RESULT_KEY, None)
    if result is not None and session is not None and len(_items(session)) == len(session.items):
        if config.option.tbstyle == "auto":
            config.option.tbstyle = "no"
        if not any(a.startswith("-r") for a in config.invocation_params.args):
            terminalreporter.reportchars = ""
    yield
    if session is None or config.option.collectonly:
        return
    if not _items(session) and config.stash[OPTIONS_KEY] is None:
        return
    terminalreporter.section("conformance")
    if result is None:
        text = "Nothing was judged, which is not a pass."
        why = config.stash.get(WHY_KEY, "")
        if why:
            text = f"Nothing was judged, which is not a pass: {why}."
        elif config.stash[OPTIONS_KEY] is not None:
            deselected = terminalreporter.stats.get("deselected", [])
            if _items(session) or any(i.get_closest_marker(_MARK) for i in deselected):
                text += " No requirement was left to be judged."
            else:
                text += (
                    " pytest found none of the suite's tests: name them (--pyargs "
                    "dexkit.conformance), and where your own pytest settings hide them "
                    "(python_files), add -c /dev/null."
                )
        else:
            text += (
                " Name the hand: --backend ezgripper or dex3-usb (emulated), --backend sim-dex1 "
                "or sim-dex3, or --backend external for a service that runs."
            )
        terminalreporter.write_line(text, yellow=True)
        return
    from dexkit.conformance.report.terminal import print_result
    from dexkit.console import Console

    width = max(terminalreporter._tw.fullwidth, 80)
    console = Console(
        file=terminalreporter._tw._file,
        width=width,
        force_terminal=terminalreporter._tw.hasmarkup,
    )
    verbose = config.option.verbose > 0
    print_result(result, console, verbose=verbose, more="-v shows why")
    for option, name in _FILES.items():
        path = config.getoption(f"dexkit_{option}")
        if path:
            terminalreporter.write_line(f"{name}: {path}")
