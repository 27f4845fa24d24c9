"""The layers of judging: a hand's DDS topics, a robot's DDS topics, a hand's USB, and the client.

A :class:`Layer` is the data by which the kit goes from a device to verdicts: how a recording is
decoded, what is judged by which checks (:mod:`dexkit.conformance.kit.judge`), and which script is
played to which reference. Each layer is in a module of its own:

* :mod:`~dexkit.conformance.layers.hand`: ``dds``, the DDS topics of hands;
* :mod:`~dexkit.conformance.layers.usb`: ``usb``, the USB transfers of Dex3-1 hands;
* :mod:`~dexkit.conformance.layers.robot`: ``robot``, the low-level DDS topics of robots;
* :mod:`~dexkit.conformance.layers.client`: ``client``, the commands that a client sends to hands.

These modules are imported with the requirements, and load checks, decoders, scripts and references
on first use.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from dexkit.conformance.kit.plots import Plot
from dexkit.hand import Subject
from dexkit.lazy import Lazy
from dexkit.robots import ROBOTS

__all__ = [
    "LAYERS",
    "Layer",
    "Precondition",
    "layer",
    "layer_of_model",
]


RecordingT = TypeVar("RecordingT")
ViewT = TypeVar("ViewT")
ContextT = TypeVar("ContextT")

# the layers are below all that judges: they name requirements, outcomes and results by Any
Precondition = Callable[[Any, ContextT], Any]
"""Takes the judgement; returns the result, where a requirement is not to be checked at all."""
Decode = Callable[[Any, "str | None", Sequence[Subject]], "RecordingT | None"]


@dataclass(frozen=True)
class Layer(Generic[RecordingT, ViewT, ContextT]):
    """The data by which one layer is judged.

    :param name: one of :data:`LAYERS`; it selects the catalogue
        (:func:`dexkit.conformance.kit.requirements.catalogue`).
    :param checks: the modules that register its checks.
    :param plots: what shows a failure where neither the catalogue nor the check names a plot.
    :param decode: a recording's part that is about the layer; None where there is none. It takes
        the recording, the dialect's name (None for the one that the topics show) and the
        subjects to be judged (none for all that are there).
    :param subjects: each subject to be judged, and the recording's part that is about it.
    :param context: what a check of the layer gets.
    :param preconditions: what is asked before the check, in this order; the first that has a
        result decides.
    :param refine: adds to an outcome what the recording says beside the check.
    :param whole: begin and end of the recording, seconds, as the place of failures that have
        none; None where such a failure cannot be excused by a busy machine.
    :param script: the stimulus script of a model, by the model's name.
    :param reference: the simulated device or client of a model that meets every requirement,
        likewise.
    """

    name: str
    checks: Sequence[str]
    plots: tuple[Plot, ...]
    decode: Decode[RecordingT]
    subjects: Callable[[RecordingT], Iterable[tuple[Subject, ViewT]]]
    context: Lazy[Callable[[RecordingT, ViewT, Any], ContextT]]
    preconditions: Sequence[Precondition[ContextT]]
    refine: Callable[[ContextT, Any], Any]
    whole: Callable[[RecordingT], tuple[float, float] | None]
    script: Callable[[str], type[Any]]
    reference: Callable[[str], type[Any]]


_MODULES = {"dds": "hand", "usb": "usb", "robot": "robot", "client": "client"}
LAYERS = tuple(_MODULES)
"""The names of the layers."""


def layer(name: str) -> Layer[Any, Any, Any]:
    """The layer of that name, one of :data:`LAYERS`."""
    module = importlib.import_module(f"{__name__}.{_MODULES[name]}")
    found: Layer[Any, Any, Any] = module.LAYER
    return found


def layer_of_model(model_name: str) -> Layer[Any, Any, Any]:
    """The layer of a hand's or robot's DDS topics."""
    return layer("robot" if model_name in ROBOTS else "dds")
