"""The layer ``client``: the commands that a client sends to hands, of a recorded session.

A run of the kit has none of its results: there the kit is the client, and sends wrong commands on
purpose.
"""

from __future__ import annotations

from collections.abc import Iterable

from dexkit.conformance.checks import Context
from dexkit.conformance.layers import Layer, hand, not_blocked
from dexkit.conformance.recording import Recording, SideView
from dexkit.hand import Subject

__all__ = ["LAYER"]


def _commanded(recording: Recording) -> Iterable[tuple[Subject, SideView]]:
    """The judged hands that are commanded; the results of each are about its client."""
    return [(s, view) for s, view in hand.subjects(recording) if len(view.commands)]


def _reference(model: str) -> type:
    from dexkit.conformance.virtual.client import ReferenceClient

    return ReferenceClient


LAYER: Layer[Recording, SideView, Context] = Layer(
    name="client",
    decode=hand.LAYER.decode,
    subjects=_commanded,
    context=Context,
    preconditions=(hand.applies_to_dialect, not_blocked),
    refine=lambda context, outcome: outcome,
    whole=hand.whole,
    script=hand.LAYER.script,
    reference=_reference,
)
