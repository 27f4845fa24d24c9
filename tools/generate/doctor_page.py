"""diagnoses.md: every diagnosis of the doctor with symptom and remedy."""

from __future__ import annotations

from dexkit.doctor.catalogue import DIAGNOSES

__all__ = ["page"]


def page() -> str:
    """The Markdown of the page, in docs/."""
    rows = [
        "# What the doctor finds",
        "",
        "Every diagnosis of [`dexkit doctor`](doctor.md).",
        "",
        "| You see | Diagnosis | What to do |",
        "| --- | --- | --- |",
    ]
    rows += [
        f"| {_cell(d.symptom)} | `{d.id}` ({d.severity}): {d.title}; {d.why} | {_cell(d.fix)} |"
        for d in DIAGNOSES.values()
    ]
    return "\n".join(rows) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
