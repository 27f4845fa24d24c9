"""Write every generated file of the repository: ``make docs`` (``python -m tools.generate``).

=============================  ==================================================================
:mod:`~.message_modules`       dexkit/messages/unitree_*.py, from dexkit/messages/idl/*.idl
:mod:`~.models_page`           docs/models.md and docs/images/model-*.svg, from the model profiles
:mod:`~.requirement_pages`     the catalogues in docs/conformance*.md and the areas in
                               docs/mutants.md, from the requirement files
:mod:`~.dex3_protocol_page`    the tables of docs/dex3-protocol.md, from the USB codec
:mod:`~.doctor_page`           the table of docs/doctor.md, from the doctor's diagnoses
:mod:`~.conformity_page`       docs/conformity.md, from conformity.toml
:mod:`~.real_hands_page`       docs/sources/real-hands.md, from real_hands.toml
:mod:`~.layouts`               docs/layouts, for Foxglove and PlotJuggler, from the model profiles
=============================  ==================================================================

Each has a function ``files()``: the content of its files by path.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["DOCS", "ROOT", "generated_files", "stale_files"]

ROOT = Path(__file__).resolve().parents[2]
"""The checkout."""
DOCS = ROOT / "docs"


def generated_files() -> dict[Path, str]:
    """Content of every generated file, by path."""
    # the generators import ROOT and DOCS from here
    from tools.generate import (
        conformity_page,
        dex3_protocol_page,
        doctor_page,
        layouts,
        message_modules,
        models_page,
        real_hands_page,
        requirement_pages,
    )

    return {
        **message_modules.files(),
        **models_page.files(),
        **requirement_pages.files(),
        **dex3_protocol_page.files(),
        **doctor_page.files(),
        **conformity_page.files(),
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
