"""Hooks of mkdocs: pages that are made of other files, and links that leave docs/."""

from __future__ import annotations

import functools
import posixpath
import re
from pathlib import Path
from typing import Any

from dexkit.models import short_names
from tools.generate import built_pages
from tools.generate.requirement_pages import REQUIREMENT

__all__ = ["on_config", "on_files", "on_page_content", "on_page_markdown"]

ROOT = Path(__file__).resolve().parent.parent.parent
HANDS = "Hands and robots"
API = {
    "dexkit.hand": "Hands: joints, states, commands",
    "dexkit.backends": "Backends",
    "dexkit.models": "Models of hands",
    "dexkit.robots": "Robots",
    "dexkit.messages": "Messages",
    "dexkit.service": "Service",
    "dexkit.teleop": "Teleoperation client",
    "dexkit.traces": "Recordings",
    "dexkit.watch": "What is on the wire",
    "dexkit.kinematics": "Kinematics",
    "dexkit.errors": "Errors",
}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")
_ROLE = re.compile(r":(?:class|mod|func|meth|data|attr|exc):<code>~?(\.?[\w.]*\.)?~?([^<]*)</code>")
_CODE = re.compile(r"(^```.*?^```)", re.DOTALL | re.MULTILINE)
_OTHER_OR_ID = re.compile(
    r"^#.*$|!?\[(?:[^\[\]]|\[[^\]]*\])*\]\([^()\s]*\)|`[^`]*`|<[^>]*>"
    rf"|(?P<id>{REQUIREMENT.pattern})",
    re.MULTILINE,
)


def on_config(config: Any) -> Any:
    """Add the pages of hands to their section."""
    (section,) = (s[HANDS] for s in config["nav"] if HANDS in s)
    section += [page for page in hand_pages() if page not in section]
    return config


def hand_pages() -> list[str]:
    """The page of each model that has one by its short name: ``dex3.md``."""
    names = (f"{short}.md" for short in short_names())
    return [name for name in names if (ROOT / "docs" / name).exists()]


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made."""
    from mkdocs.structure.files import File

    for path, text in pages().items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **more: object) -> str:
    """Make text of links that leave docs/, and links of the ids of requirements."""
    path = page.file.src_uri
    return requirement_links(local_links(markdown, path), path)


def on_page_content(html: str, **more: object) -> str:
    """Show references of docstrings (``:class:`` and others) as plain code."""
    return _ROLE.sub(r"<code>\2</code>", html)


def local_links(markdown: str, path: str) -> str:
    """Replace links to files outside docs/ by their text and path; code is left alone.

    :param path: of the page in docs/.
    """

    def replace(match: re.Match[str]) -> str:
        picture, text, target = match.groups()
        if picture or "://" in target or target.startswith(("#", "mailto:")):
            return match[0]
        place = posixpath.normpath(posixpath.join(posixpath.dirname(path), target))
        if not place.startswith(".."):
            return match[0]
        name = place.lstrip("./").partition("#")[0]
        return text if name in text else f"{text} (`{name}`)"

    parts = _CODE.split(markdown)
    parts[::2] = [_LINK.sub(replace, part) for part in parts[::2]]
    return "".join(parts)


def requirement_links(markdown: str, path: str) -> str:
    """Link ids of requirements to their pages; headings, links and code are left alone.

    :param path: of the page in docs/.
    """
    known = pages()

    def replace(match: re.Match[str]) -> str:
        page = f"requirements/{match['id']}.md"
        if match["id"] is None or page not in known or page == path:
            return match[0]
        return f"[{match['id']}]({posixpath.relpath(page, posixpath.dirname(path) or '.')})"

    parts = _CODE.split(markdown)
    parts[::2] = [_OTHER_OR_ID.sub(replace, part) for part in parts[::2]]
    return "".join(parts)


@functools.cache
def pages() -> dict[str, str]:
    """Markdown of every page that is made, by its path."""
    made = {"index.md": home(), **built_pages()}
    listed = "\n".join(f"- [`{name}`]({name}.md): {title}" for name, title in API.items())
    made["api/index.md"] = f"# API\n\nMade from the docstrings.\n\n{listed}\n"
    for name, title in API.items():
        made[f"api/{name}.md"] = f"# {title}\n\n::: {name}\n"
    return made


def home() -> str:
    """The first page: README.md, its links seen from docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")

    def replace(match: re.Match[str]) -> str:
        picture, shown, target = match.groups()
        inside = target.removeprefix("docs/")
        return f"{picture}[{shown}]({inside if inside != target else _outside(target)})"

    parts = _CODE.split(text)
    parts[::2] = [_LINK.sub(replace, part) for part in parts[::2]]
    return "".join(parts)


def _outside(target: str) -> str:
    return target if "://" in target or target.startswith("#") else f"../{target}"
