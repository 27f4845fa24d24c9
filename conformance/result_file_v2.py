"""Convert a result file of version 2 into version 3.

Version 2 had text where version 3 has data: the load of the machine stood at the beginning of
``reason``, joints were named in ``observed``, and the backend's name showed a virtual run. A
robot's side and layer were called ``body``.
Nothing is checked here: :mod:`~dexkit.conformance.result_file` validates the result.
"""

from __future__ import annotations

import re
from typing import Any

from dexkit.conformance.requirements import catalogue
from dexkit.hand import Side
from dexkit.models import MODELS
from dexkit.robots import ROBOTS

__all__ = ["converted"]

_LOADS = {"the machine was busy": "busy", "the machine was too busy": "too busy"}
"""Beginnings of a reason, and the load that each of them means."""
_ROBOT = {"body": "robot"}


def converted(document: dict[str, Any]) -> dict[str, Any]:
    """Return the document in version 3; parts that are not of version 2's form stay unchanged."""
    found = {**document, "version": 3}
    if isinstance(document.get("results"), list):
        found["results"] = [_result(e) if isinstance(e, dict) else e for e in document["results"]]
    if isinstance(document.get("stage"), dict):
        found["stage"] = {_renamed(side): s for side, s in document["stage"].items()}
    if isinstance(document.get("subject"), dict):
        found["subject"] = _subject(document["subject"])
    return found


def _subject(about: dict[str, Any]) -> dict[str, Any]:
    found = dict(about)
    if found.get("sides") == "body":
        found["sides"] = "robot"
    if _text(found, "backend").startswith("virtual "):
        found["device"] = "virtual"
    return found


def _renamed(text: Any) -> Any:
    return _ROBOT.get(text, text) if isinstance(text, str) else text


def _text(entry: dict[str, Any], key: str) -> str:
    value = entry.get(key)
    return value if isinstance(value, str) else ""


def _result(entry: dict[str, Any]) -> dict[str, Any]:
    reason = _text(entry, "reason")
    load = next((load for begin, load in _LOADS.items() if reason.startswith(begin)), "none")
    requirement = entry.get("requirement")
    plots = [str(plot) for plot in _known_plots(_text(entry, "id"))]
    found = {
        **entry,
        "joints": _joints(entry),
        "disturbance": {"load": load, "late_s": None, "explained_s": None, "failure_s": None},
        "plots": plots,
        "retry": load != "none",
    }
    if "side" in entry:
        found["side"] = _renamed(entry["side"])
    if isinstance(requirement, dict):
        found["requirement"] = {"like": "", **requirement, "plots": plots}
        if "layer" in requirement:
            found["requirement"]["layer"] = _renamed(requirement["layer"])
    return found


def _known_plots(name: str) -> tuple[Any, ...]:
    """The plots of the requirement of that id in today's catalogue."""
    return next((r.plots for r in catalogue(None, None) if r.id == name), ())


def _joints(entry: dict[str, Any]) -> list[int]:
    """The joints that the text names."""
    requirement = entry.get("requirement")
    name = _text(requirement, "model") if isinstance(requirement, dict) else ""
    side = _text(entry, "side")
    if name in ROBOTS:
        joints = [j.name for j in ROBOTS[name].joints if j is not None]
    elif name in MODELS and side in {str(s) for s in Side}:
        joints = [j.name for j in MODELS[name].joints[Side(side)]]
    else:
        return []
    words = set(re.findall(r"\w+", _text(entry, "observed")))
    return [i for i, joint in enumerate(joints) if joint in words] if len(joints) > 1 else []
