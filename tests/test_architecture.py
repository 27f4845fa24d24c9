"""docs/architecture.md names files and functions that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
_FOLDERS = "dexkit|drivers|emulators|traces|conformance|tools|examples|tests|docs"
_PATH = re.compile(rf"(?:^|[\s`(])((?:{_FOLDERS})/[\w./*-]*|pyproject\.toml)", re.MULTILINE)
_NAMED = re.compile(rf"`((?:{_FOLDERS})/[\w/]+\.py)` ((?:`[A-Za-z_.]+`(?:, )?(?:later )?)+)")


def test_every_path_of_the_page_exists() -> None:
    paths = {path.rstrip(".") for path in _PATH.findall(PAGE)}
    assert len(paths) > 50, "the pattern of paths finds too few"
    missing = [p for p in sorted(paths) if not list(ROOT.glob(p.rstrip("/")))]
    assert not missing, f"docs/architecture.md names files that do not exist: {missing}"


def test_every_function_of_the_page_exists() -> None:
    found = _NAMED.findall(PAGE)
    assert len(found) > 8, "the pattern of functions finds too few"
    missing = []
    for path, names in found:
        source = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`([A-Za-z_.]+)`", names):
            for part in name.split("."):
                if not re.search(rf"\b(?:def|class) {part}\b", source):
                    missing.append(f"{path}: {name}")
    assert not missing, missing


def test_every_package_is_in_the_table() -> None:
    rows = re.findall(r"^\| `(\w+)/` \|", PAGE, re.MULTILINE)
    assert set(rows) == {"dexkit", "drivers", "emulators", "traces", "conformance", "tools"}
