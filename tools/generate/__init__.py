"""Write every generated file: ``make docs`` (``python -m tools.generate``).

=============================  ==================================================================
in the repository
-------------------------------------------------------------------------------------------------
:mod:`~.message_modules`       dexkit/messages/unitree_*.py, from dexkit/messages/idl/*.idl
:mod:`~.real_hands_page`       docs/sources/real-hands.md, from real_hands.toml
:mod:`~.layouts`               docs/layouts, for Foxglove and PlotJuggler, from the model profiles
in build/docs and on the site
-------------------------------------------------------------------------------------------------
:mod:`~.models_page`           models.md and images/model-*.svg: joints, limits, topics and rates
:mod:`~.requirement_pages`     requirements/: a page for each requirement
:mod:`~.conformity_page`       conformity.md, from conformity.toml
:mod:`~.doctor_page`           diagnoses.md, of the doctor
:mod:`~.real_hands_page`       bases.md: what carries the MUSTs of each model
-------------------------------------------------------------------------------------------------
in build/docs
-------------------------------------------------------------------------------------------------
:mod:`~.record_schemas`        *.schema.json: the forms of result and self-test
=============================  ==================================================================

What is in the repository is the function ``files()`` of a module: content by path.
"""

from __future__ import annotations

import posixpath
import re
import shutil
from pathlib import Path

__all__ = ["BUILT", "DOCS", "ROOT", "built_pages", "generated_files", "stale_files", "write_pages"]

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
DOCS = ROOT / "docs"
BUILT = ROOT / "build" / "docs"
"""Of the pages that are not in the repository."""

_LINK = re.compile(r"(?<=\]\()[^()\s#:]+(?=[)#])")


def generated_files() -> dict[Path, str]:
    """Content of every generated file of the repository, by path."""
    # the generators import ROOT and DOCS from here
    from tools.generate import (
        layouts,
        message_modules,
        real_hands_page,
    )

    return {
        **message_modules.files(),
        **real_hands_page.files(),
        **layouts.files(),
    }


def stale_files() -> dict[Path, str]:
    """The generated files that are missing or out of date, with the content to write."""
    return {
        path: content
        for path, content in generated_files().items()
        if not path.exists() or path.read_text(encoding="utf-8") != content
    }


def built_pages() -> dict[str, str]:
    """Pages and drawings that are not in the repository, by the path that they have on the site;
    links are seen from docs/.
    """
    from tools.generate import (
        conformity_page,
        doctor_page,
        models_page,
        real_hands_page,
        requirement_pages,
    )

    return {
        "models.md": models_page.page(),
        **models_page.drawings(),
        "conformity.md": conformity_page.page(),
        "bases.md": real_hands_page.bases(),
        "diagnoses.md": doctor_page.page(),
        **requirement_pages.pages(),
    }


def write_pages() -> None:
    """Write :func:`built_pages` to :data:`BUILT`, their links seen from there, and schemas."""
    from tools.generate import record_schemas

    made = built_pages()
    shutil.rmtree(BUILT, ignore_errors=True)  # pages of requirements that are gone
    BUILT.mkdir(parents=True)
    for name, text in record_schemas.files().items():
        (BUILT / name).write_text(text, encoding="utf-8")
    for name, text in made.items():
        path = BUILT / name
        folder = posixpath.dirname(name)

        def seen_from_there(match: re.Match[str], folder: str = folder) -> str:
            target = posixpath.normpath(posixpath.join(folder, match[0]))
            if target in made:
                return match[0]
            return posixpath.relpath(f"docs/{target}", f"build/docs/{folder}")

        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(_LINK.sub(seen_from_there, text), encoding="utf-8")
