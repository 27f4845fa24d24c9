"""Backends by name and by path: conflicts, broken plug-ins, valid and invalid targets of a path.

Plug-ins are distributions on ``sys.path`` with an ``entry_points.txt``, as pip leaves them.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.backends import Backend, BackendOptions, backend, list_backends
from dexkit.cli import cli
from dexkit.errors import BackendBroken, BackendConflict, UnknownBackend, UsageError
from dexkit.hand import Hand, HandSpec, Side
from dexkit.models import MODELS
from tests.service_helpers import ScriptedHand

LEFT = BackendOptions(Side.LEFT)


class Plugins:
    def __init__(self, path: Path) -> None:
        self.path = path

    def install(self, dist: str, entries: dict[str, str], code: str = "", module: str = "") -> None:
        info = self.path / f"{dist.replace('-', '_')}-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {dist}\nVersion: 1.2\n")
        lines = "".join(f"{name} = {target}\n" for name, target in entries.items())
        (info / "entry_points.txt").write_text(f"[dexkit.backends]\n{lines}")
        if module:
            (self.path / f"{module}.py").write_text(code)
        importlib.invalidate_caches()


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Plugins]:
    monkeypatch.syspath_prepend(str(tmp_path))
    before = set(sys.modules)
    yield Plugins(tmp_path)
    for name in set(sys.modules) - before:
        del sys.modules[name]


GOOD = """
from dexkit.backends import Backend
from tests.service_helpers import ScriptedHand

backend = Backend(summary="A hand of mine", model="dex1-1", make=lambda o: ScriptedHand(o.side))
"""


class TestByName:
    def test_built_in_backends_are_listed(self) -> None:
        names = {row.name: row for row in list_backends()}
        assert {
            "dex1-serial",
            "ezgripper",
            "sim-dex1",
            "sim-dex3",
            "sim-brainco",
            "sim-inspire-dfx",
            "sim-inspire-ftp",
            "sim-dex5",
            "dex3-usb",
        } <= names.keys()
        for row in names.values():
            if row.origin.startswith("dexkit "):
                assert row.backend is not None, row.error
                assert row.backend.model in MODELS
                assert row.backend.summary

    def test_plug_in_is_found_by_its_entry_point(self, plugins: Plugins) -> None:
        plugins.install("my-gripper", {"mine": "my_gripper:backend"}, GOOD, "my_gripper")
        hand = backend("mine").create(LEFT)
        assert hand.spec.side is Side.LEFT
        (row,) = [row for row in list_backends() if row.name == "mine"]
        assert (row.origin, row.target) == ("my-gripper 1.2", "my_gripper:backend")

    def test_plug_in_cannot_replace_a_built_in_backend(self, plugins: Plugins) -> None:
        plugins.install("evil-twin", {"sim-dex1": "evil:backend"}, GOOD, "evil")
        with pytest.raises(BackendConflict, match=r"built in.*evil-twin 1\.2") as raised:
            backend("sim-dex1")
        assert "package.module:Object" in raised.value.hint
        rows = [row for row in list_backends() if row.name == "sim-dex1"]
        assert len(rows) == 2
        assert all(row.backend is None and "evil-twin" in row.error for row in rows)
        assert backend("evil:backend").create(LEFT)  # by its path it is to be had

    def test_two_plug_ins_with_one_name_are_refused(self, plugins: Plugins) -> None:
        plugins.install("one", {"grip": "one_mod:backend"}, GOOD, "one_mod")
        plugins.install("two", {"grip": "two_mod:backend"}, GOOD, "two_mod")
        with pytest.raises(BackendConflict, match=r"more than one package: .*one 1\.2"):
            backend("grip")

    def test_unknown_backend_error_lists_the_known_ones(self) -> None:
        with pytest.raises(UnknownBackend) as raised:
            backend("nope")
        assert isinstance(raised.value, LookupError)
        assert str(raised.value) == "no backend 'nope'"
        assert "sim-dex1" in raised.value.hint

    @pytest.mark.parametrize(
        ("code", "why"),
        [
            ("raise RuntimeError('boom')", "RuntimeError: boom"),
            ("import no_such_module_at_all", "ModuleNotFoundError"),
            ("x = 1", "there is no 'backend' in broken_mod"),
            ("backend = 42", "is a int, not a backend"),
            ("import sys; sys.modules[__name__] = None; this is no python", "SyntaxError"),
        ],
    )
    def test_broken_plug_in_is_reported_and_others_stay_usable(
        self, plugins: Plugins, code: str, why: str
    ) -> None:
        plugins.install("broken", {"broken": "broken_mod:backend"}, code, "broken_mod")
        with pytest.raises(BackendBroken, match="broken_mod") as raised:
            backend("broken")
        assert why in raised.value.message
        rows = {row.name: row for row in list_backends()}
        assert rows["broken"].backend is None
        assert why in rows["broken"].error
        assert rows["sim-dex1"].backend is not None
        assert backend("sim-dex1")

    def test_the_command_lists_all(self, plugins: Plugins) -> None:
        plugins.install("broken", {"broken": "broken_mod:backend"}, "import nix_da", "broken_mod")
        result = CliRunner().invoke(cli, ["backends"], env={"COLUMNS": "200"})
        assert result.exit_code == 0
        for text in ("sim-dex1", "ezgripper", "dex1-1", "broken 1.2", "unusable", "--device"):
            assert text in result.output


class WithoutSpec:
    """All but one of the four."""

    def __init__(self, side: Side) -> None:
        self.side = side

    def open(self) -> None: ...
    def close(self) -> None: ...
    def exchange(self, command: object) -> None: ...


class WithoutClose:
    def __init__(self, side: Side) -> None:
        self.side = side


def make_hand(options: BackendOptions) -> Hand:
    """A hand out of a function.

    More text.
    """
    return ScriptedHand(options.side)


def make_failure(options: BackendOptions) -> Hand:
    raise ValueError("no port")


def make_nothing(options: BackendOptions) -> object:
    return None


class SpecMethod(ScriptedHand):
    def spec(self) -> HandSpec:  # type: ignore[override]
        return self._spec


class SpecBroken(ScriptedHand):
    @property
    def spec(self) -> HandSpec:
        return self._speck  # type: ignore[attr-defined, no-any-return]


class AlwaysLeft(ScriptedHand):
    def __init__(self, side: Side) -> None:
        super().__init__()


class WithPort(ScriptedHand):
    def __init__(self, side: Side, port: str) -> None:
        super().__init__(side)


class TestByPath:
    def test_hand_class_is_a_backend(self) -> None:
        kind = backend("tests.service_helpers:ScriptedHand")
        assert kind.create(BackendOptions(Side.RIGHT)).spec.side is Side.RIGHT
        assert kind.summary.startswith("A hand that reaches its goal at once")

    def test_function_is_a_backend(self) -> None:
        kind = backend(f"{__name__}:make_hand")
        assert kind.create(LEFT).spec.side is Side.LEFT
        assert kind.summary == "A hand out of a function."

    @pytest.mark.parametrize("name", ["make_nothing", "WithoutClose", "WithoutSpec"])
    def test_object_that_creates_no_hand_is_refused(self, name: str) -> None:
        with pytest.raises(BackendBroken, match="not a Hand"):
            backend(f"{__name__}:{name}").create(LEFT)

    @pytest.mark.parametrize(
        ("name", "says", "hint"),
        [
            ("WithoutSpec", "has no spec", "spec, open, close, exchange"),
            ("WithoutClose", "no spec and no open and no close and no exchange", "a Hand has"),
            ("SpecMethod", "spec is a method, not a HandSpec", "a property"),
            ("SpecBroken", "no attribute '_speck'", f"at {__file__}"),
            ("AlwaysLeft", "made for the right hand, but its spec has left", "pass the given side"),
            ("WithPort", "missing 1 required positional argument: 'port'", "with the side alone"),
        ],
    )
    def test_incomplete_hand_class_error_names_what_is_missing(
        self, name: str, says: str, hint: str
    ) -> None:
        with pytest.raises(BackendBroken, match=says) as raised:
            backend(f"{__name__}:{name}").create(BackendOptions(Side.RIGHT))
        assert hint in raised.value.hint

    def test_model_is_taken_from_the_hand(self) -> None:
        kind = backend("tests.service_helpers:ScriptedHand")
        assert kind.model_of(LEFT) == "dex1-1"
        wrong = replace(kind, model="dex3-1")
        with pytest.raises(BackendBroken, match="declares the model dex3-1"):
            wrong.create(LEFT)

    @pytest.mark.parametrize(
        "path", ["no_such_package:x", "tests.service_helpers:nope", "tests.service_helpers:", ":x"]
    )
    def test_path_to_nothing_is_refused(self, path: str) -> None:
        with pytest.raises(BackendBroken, match=r"cannot load|is a module, not a backend"):
            backend(path)

    def test_backend_in_the_working_directory_is_found(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "hand_being_written.py").write_text(
            "from tests.service_helpers import ScriptedHand\n"
        )
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
        kind = backend("hand_being_written:ScriptedHand")
        assert kind.create(LEFT).spec.side is Side.LEFT
        assert sys.path[-1] == str(tmp_path)

    def test_exception_in_a_hand_constructor_names_file_and_line(self) -> None:
        with pytest.raises(BackendBroken, match="ValueError: no port") as raised:
            backend(f"{__name__}:make_failure").create(LEFT)
        assert raised.value.hint == f"at {__file__}:{make_failure.__code__.co_firstlineno + 1}"

    def test_object_that_is_no_backend_is_refused(self) -> None:
        with pytest.raises(BackendBroken, match="is a tuple"):
            backend("tests.test_package:PACKAGES")


class TestOptions:
    KIND = Backend(
        summary="x",
        model="dex1-1",
        make=lambda o: ScriptedHand(o.side),
        needs="--device PATH",
        needs_device=True,
        settings={"speed": "how fast"},
    )

    def test_missing_device_option_is_refused(self) -> None:
        with pytest.raises(UsageError) as raised:
            self.KIND.create(LEFT)
        assert raised.value.hint == "give --device PATH"

    def test_unknown_setting_is_refused(self) -> None:
        options = BackendOptions(Side.LEFT, "x", {"sped": "1"})
        with pytest.raises(UsageError, match="no setting 'sped'") as raised:
            self.KIND.create(options)
        assert "speed" in raised.value.hint
