"""The pages that the documentation site adds, and its links that leave docs/."""

from __future__ import annotations

import importlib.util
import posixpath
import re
from pathlib import Path

import pytest

from dexkit.conformance.kit.requirements import catalogue
from tools.site import hooks

ROOT = Path(__file__).parent.parent
NAV = re.compile(r"^ +- (?:[\w ]+: )?([\w/-]+\.md)$", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


def test_every_document_is_in_the_navigation() -> None:
    text = (ROOT / "tools/site/mkdocs.yml").read_text()
    listed = {name for name in NAV.findall(text) if "/index" not in name} - {"index.md"}
    listed |= set(hooks.hand_pages())
    docs = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    docs |= {name for name in hooks.pages() if "/" not in name} - {"index.md"}
    assert docs - listed == set()
    assert {name for name in listed - docs if not name.startswith(("api", "requirements"))} == set()


def test_pages_of_hands_are_added_to_the_navigation_once() -> None:
    config = {"nav": ["index.md", {"Hands and robots": ["models.md", "dex3.md"]}]}
    (_, section) = hooks.on_config(config)["nav"]
    added = [page for page in hooks.hand_pages() if page != "dex3.md"]
    assert "dex5.md" in added
    assert section == {"Hands and robots": ["models.md", "dex3.md", *added]}


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return hooks.pages()


def test_each_requirement_has_a_page_whose_links_exist(pages: dict[str, str]) -> None:
    every = {r.id for layer in ("dds", "robot", "usb", "client") for r in catalogue(layer=layer)}
    assert every == {Path(p).stem for p in pages if p.startswith("requirements/")} - {"index"}
    documents = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    for path, text in pages.items():
        for target in LINK.findall(text):
            if "://" in target or not path.startswith("requirements"):
                continue
            name = posixpath.normpath(posixpath.join(posixpath.dirname(path), target))
            assert name in pages or name in documents, f"{path}: {target}"


def test_api_pages_name_modules_that_exist(pages: dict[str, str]) -> None:
    names = [Path(p).stem for p in pages if p.startswith("api/") and not p.endswith("index.md")]
    assert len(names) > 5
    for name in names:
        assert importlib.util.find_spec(name) is not None
