"""Finding entry points: the quick look at entry_points.txt agrees with importlib.metadata."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import pytest

from dexkit.plugins import entry_points

GROUP = "dexkit.test-group"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, the only one on the import path."""
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    return tmp_path


def register(folder: Path, group: str = GROUP) -> None:
    package = folder / "acme-1.0.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    (package / "entry_points.txt").write_text(f"[{group}]\nacme = acme:HAND\n")


def test_entry_point_of_an_installed_package_is_found(folder: Path) -> None:
    register(folder)
    assert [(e.name, e.value) for e in entry_points(GROUP)] == [("acme", "acme:HAND")]


def test_entry_point_of_another_finder_is_found(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register(folder)
    found = list(metadata.entry_points(group=GROUP))
    sys.path.clear()

    class Finder(metadata.DistributionFinder):
        def find_spec(self, *args: object) -> None:
            return None

        def find_distributions(
            self, context: metadata.DistributionFinder.Context | None = None
        ) -> list[metadata.Distribution]:
            return [e.dist for e in found if e.dist is not None]

    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder()])
    assert len(entry_points(GROUP)) == 1
