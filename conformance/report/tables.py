"""Tables of the pages that dexkit writes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = ["no_wrap", "table"]


def no_wrap(text: str) -> str:
    """A cell that is not broken."""
    return f'<bdi style="white-space:nowrap">{text}</bdi>'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; the cells are HTML, the first of each row is its heading."""
    head = "".join(f'<th scope="col">{h if " " in h else no_wrap(h)}</th>' for h in heads)
    body = "".join(
        f'<tr><th scope="row">{row[0]}</th>'
        + "".join(
            f'<td data-run="{h}">{cell}</td>' for h, cell in zip(heads[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return (
        f'<div class="wrap"><table class="matrix"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )
