"""No value of any command-line option ends in a traceback."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import pytest

from dexkit import stop_signals
from dexkit.cli.options import Number
from dexkit.cli.settings import SettingsOption
from dexkit.emulators.faults import (
    DEX3_FAULTS,
    M4010_FAULTS,
    MX64_FAULTS,
    REVO2_FAULTS,
    RH56_FAULTS,
    FaultSchedule,
    parse_fault,
)
from dexkit.errors import DdsUnavailable, UsageError
from tests import hostile

_SAMPLE = "<sample>"
_FIXED: dict[tuple[str, ...], list[str]] = {
    ("badge",): ["<result>"],
    ("bridge",): ["unitree_go", "unitree_hg"],
    ("bringup",): ["dex3-usb", "--side", "left"],
    ("calibrate",): ["--yes"],
    ("check",): [_SAMPLE],
    ("compare",): ["<result>", "<result>"],
    ("doctor",): ["--scan", "none", "--domain", "1", "--seconds", "0.2"],
    ("emulate", "dex1-motor"): ["--link", "<link>"],
    ("emulate", "dex3-usb"): ["--link", "usbip://127.0.0.1:0"],
    ("emulate", "mx64"): ["--link", "<link>"],
    ("emulate", "revo2"): ["--link", "<link>"],
    ("emulate", "rh56"): ["--link", "<link>"],
    ("info",): [_SAMPLE],
    ("install-service",): ["sim-dex1", "--side", "left", "--user", "root", "--dry-run"],
    ("record",): ["<new>"],
    ("publish",): [_SAMPLE],
    ("rehearse",): [_SAMPLE],
    ("replay",): [_SAMPLE],
    ("report",): ["<result>"],
    ("selftest",): ["--external", "--dialect", "unitree_go", "--side", "left"],
    ("serve",): ["sim-dex1", "--side", "left"],
    ("teleop",): ["full-stroke"],
}
"""What a command needs so that it comes to look at the rest."""
_SLOW = {("demo",), ("emulate", "all")}
"""Commands that do their work in processes; only what they refuse at once is tried."""
_CODES = {0, 1, 2, 130}


@dataclass(frozen=True)
class _Value:
    """A value of the command line.

    :param begin: what stands before it: ``--fault=``, or ``--set=object=``.
    """

    begin: str
    type: click.ParamType[Any]


def _options() -> Iterator[tuple[tuple[str, ...], _Value]]:
    for name, command in hostile.commands():
        for parameter in command.params:
            if isinstance(parameter, click.Option) and not parameter.is_flag:
                yield name, _Value(f"{parameter.opts[0]}=", parameter.type)
            if isinstance(parameter, SettingsOption):
                for setting in parameter.known:
                    yield name, _Value(f"--set={setting.key}=", setting.type)


def test_every_number_on_the_command_line_is_finite_and_bounded() -> None:
    seen = 0
    for name, option in _options():
        kind = option.type
        where = f"dexkit {' '.join(name)} {option.begin}"
        if isinstance(kind, click.types.FloatParamType):
            assert isinstance(kind, Number), f"{where}: take dexkit.cli.options.Number"
            seen += 1
            for text in ("nan", "-nan", "inf", "-inf", "1e400", "1e300", "", "²", "1e"):
                with pytest.raises(click.BadParameter):
                    kind.convert(text, None, None)
        elif isinstance(kind, click.types.IntParamType):
            assert isinstance(kind, click.IntRange), f"{where}: a range, please"
            assert kind.min is not None, where
            seen += 1
            for text in ("9" * 30, "9" * 5000, "-" + "9" * 30, "", "²", "1.5", "nan"):
                if kind.max is None and text.isdigit():
                    continue
                with pytest.raises(click.BadParameter):
                    kind.convert(text, None, None)
    assert seen > 30


@pytest.fixture
def nothing_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """No DDS, no domain looked at, and whatever would run for ever ends at once."""

    class NoNode:
        def __init__(self, *args: object, **settings: object) -> None:
            raise DdsUnavailable("no DDS here")

    class Ended(stop_signals.StopRequest):
        def __init__(self) -> None:
            super().__init__()
            self.set()

    monkeypatch.setattr("dexkit.dds.DdsNode", NoNode)
    monkeypatch.setattr("dexkit.doctor.dds.observe_domains", lambda *a, **k: ())
    monkeypatch.setattr("dexkit.doctor.environment._import_problem", lambda module: "")
    monkeypatch.setattr("dexkit.stop_signals.StopRequest", Ended)


def _run_all(
    folder: Path, wanted: Callable[[_Value], bool], values: tuple[str, ...]
) -> tuple[int, list[str]]:
    _, recording = hostile.judged_result(folder)
    given = {
        "<result>": str(folder / "good.json"),
        _SAMPLE: str(recording),
        "<link>": str(folder / "link"),
        "<new>": str(folder / "new.mcap"),
    }
    tried, wrong = 0, []
    for name, option in _options():
        if not wanted(option):
            continue
        fixed = [given.get(a, a) for a in _FIXED.get(name, [])]
        for value in values:
            if name in _SLOW and isinstance(option.type, click.Path | click.types.StringParamType):
                continue
            tried += 1
            arguments = [*name, *fixed, f"{option.begin}{value}"]
            try:
                code, out, err = hostile.run_command(arguments)
            except hostile.Crash as crash:
                wrong.append(str(crash))
                continue
            if code not in _CODES or hostile.raw(out + err):
                wrong.append(f"{arguments}: exit code {code}, {hostile.raw(out + err)}\n{err}")
            for path in folder.iterdir():
                if path.name != "good.json":
                    path.unlink()
    return tried, wrong


@pytest.mark.usefixtures("nothing_starts")
def test_no_value_of_an_option_ends_in_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where a name without a folder leads to
    (tmp_path / "here").mkdir()

    def wanted(option: _Value) -> bool:
        return not isinstance(option.type, click.Choice)

    tried, wrong = _run_all(tmp_path / "here", wanted, ("nan", "\x1b[31m\udc80"))
    assert tried > 120
    assert not wrong, "\n".join(wrong)


@pytest.mark.soak
@pytest.mark.usefixtures("nothing_starts")
def test_no_text_ends_in_a_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    # no argument of a program can hold a zero
    texts = (*hostile.NUMBERS, *hostile.TEXTS)
    values = tuple(dict.fromkeys(v[:5000] for v in texts if "\0" not in v))
    tried, wrong = _run_all(tmp_path / "here", lambda option: True, values)
    assert tried > 2000
    assert not wrong, "\n".join(wrong)


_WORDS = (
    "drop", "corrupt", "unplug", "silent", "stuck", "overheat", "@", "@3s", "@²s", ":", "p=", "id=",
    "for=", "side=left", "side=", "ms=", ",", "=", "é", "\n", "id=1", "-", "for=2ms", "volts=",
)  # fmt: skip


def fault_text(rng: random.Random) -> str:
    """A fault specification, or a text that looks like one."""
    if rng.random() < 0.5:
        return "".join(rng.choice(_WORDS + hostile.NUMBERS) for _ in range(rng.randint(0, 8)))
    keys = [
        f"{rng.choice(('id', 'for', 'p', 'ms', 'side', 'volts'))}={rng.choice(hostile.NUMBERS)}"
        for _ in range(rng.randint(0, 3))
    ]
    kind = rng.choice(("drop", "silent", "unplug", "stuck", "overheat", "brown-out", "pause"))
    time = rng.choice(("", f"@{rng.choice(hostile.NUMBERS)}{rng.choice(('', 's', 'ms'))}"))
    return f"{kind}{time}:{','.join(keys)}"


def test_fault_is_parsed_or_refused() -> None:
    rng = random.Random(11)
    understood = 0
    families = (MX64_FAULTS, DEX3_FAULTS, M4010_FAULTS, RH56_FAULTS, REVO2_FAULTS)
    for _ in range(3000):
        text = fault_text(rng)
        for family in families:
            try:
                fault = parse_fault(text, family)
            except UsageError:
                continue
            understood += 1
            assert all(
                0 <= v < 1e7 for v in (fault.at, fault.duration or 0, *fault.params.values())
            )
            assert fault.device is None or 0 <= fault.device <= family.max_id
            FaultSchedule([fault]).poll(1e8)
    assert understood > 50


def test_backend_settings_are_parsed_or_refused() -> None:
    from dexkit.backends import BackendOptions, list_backends
    from dexkit.errors import DexkitError
    from dexkit.hand import Side

    tried = 0
    values = (*hostile.NUMBERS, *(text[:5000] for text in hostile.TEXTS), "/", "/dev/full", "1.2")
    for row in list_backends():
        assert row.backend is not None
        for key in row.backend.settings:
            for value in values:
                tried += 1
                device = "/dev/null" if row.backend.needs else None
                options = BackendOptions(Side.LEFT, device, {key: value})
                try:
                    row.backend.create(options)
                except DexkitError:
                    pass
                except Exception as error:
                    raise AssertionError(f"{row.name} {key}={value[:40]!r}: {error!r}") from error
    assert tried > 500
