"""The USB catalogue as a page: ``python -m dexkit.conformance.usb.page`` brings it up to date in
docs/conformance-usb.md.
"""

from __future__ import annotations

from pathlib import Path

from dexkit.conformance.mutants import mutants
from dexkit.conformance.requirements import catalogue
from dexkit.conformance.requirements.page import BEGIN, END, entry

__all__ = ["catalogue_page"]


def catalogue_page() -> str:
    """Markdown of all USB requirements, by area."""
    lines: list[str] = []
    area = ""
    for requirement in catalogue(layer="usb"):
        if requirement.area != area:
            area = requirement.area
            lines += ["", f"### {area.removeprefix('USB: ').capitalize()}", ""]
        killers = [m.name for m in mutants() if m.kills == requirement.id]
        where = f"phase `{requirement.phase}`" if requirement.phase else "the descriptors"
        lines += entry(requirement, where, killers)
    return "\n".join(lines)


def main() -> None:
    """Write it into the documentation."""
    path = Path(__file__).resolve().parents[2] / "docs" / "conformance-usb.md"
    text = path.read_text(encoding="utf-8")
    head, tail = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
    path.write_text(f"{head}\n{catalogue_page()}\n{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
