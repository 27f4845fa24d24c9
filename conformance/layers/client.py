"""The layer ``client``: the commands that a client sends to hands, of a recorded session.

A run of the kit has none of its results: there the kit is the client, and sends wrong commands on
purpose.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from dexkit.conformance.kit.plots import Plot, PlotKind
from dexkit.conformance.layers import Layer, hand
from dexkit.conformance.layers.preconditions import not_blocked
from dexkit.errors import UsageError
from dexkit.hand import Subject
from dexkit.lazy import Lazy

if TYPE_CHECKING:
    from dexkit.conformance.checks import Context
    from dexkit.conformance.kit.recording import Recording, SideView

__all__ = ["LAYER"]

_REFERENCE: Lazy[type[Any]] = Lazy("dexkit.conformance.virtual.client:ReferenceClient")


def _commanded(recording: Recording) -> Iterable[tuple[Subject, SideView]]:
    """The judged hands that are commanded; the results of each are about its client."""
    return [(s, view) for s, view in hand.subjects(recording) if len(view.commands)]


def _no_script(name: str) -> type[Any]:
    raise UsageError(
        "the kit plays no stimulus to a client",
        hint="record its session with 'dexkit record', then judge it with 'dexkit check'",
    )


LAYER: Layer[Recording, SideView, Context] = Layer(
    name="client",
    checks=("dexkit.conformance.behaviours.client",),
    plots=(Plot(PlotKind.POSITION),),
    decode=hand.LAYER.decode,
    subjects=_commanded,
    context=Lazy("dexkit.conformance.checks:Context"),
    preconditions=(hand.applies_to_dialect, hand.carried, not_blocked),
    refine=hand.with_format,
    whole=hand.whole,
    script=_no_script,
    reference=lambda name: _REFERENCE.load(),
)
