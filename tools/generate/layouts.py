"""Layouts of Foxglove and PlotJuggler for recordings of each hand: docs/layouts."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

from dexkit.hand import Side
from dexkit.models import BUILT_IN, HandModel
from dexkit.watch.fields import parts_of
from tools.generate import DOCS

__all__ = ["Curves", "curves", "files"]

_ROWS = 7  # plots below each other
_STATE, _COMMAND = "#1f77b4", "#ff7f0e"

Curves = dict[Side, list[tuple[str, list[tuple[str, str]]]]]
"""For each side, joints with their (topic, path in the message): command, then state."""


def curves(model: HandModel) -> Curves:
    """The positions of a model's joints in its first dialect."""
    dialect = model.dialects[0]
    found: Curves = {}
    for side in Side:
        topics = zip(dialect.topics(side), (dialect.cmd_type, dialect.state_type), strict=True)
        paths = []
        for topic, type_name in topics:
            part = next(p for p in parts_of(topic, type_name) if p.subject is side)
            paths.append([(topic, part.fields[i].path) for i in part.columns("q")])
        names = [joint.name for joint in model.joints[side]]
        found[side] = [(n, list(c)) for n, c in zip(names, zip(*paths, strict=True), strict=True)]
    return found


def files() -> dict[Path, str]:
    """The layouts of the models that dexkit has."""
    made = {}
    for model in BUILT_IN:
        found = curves(model)
        made[DOCS / "layouts" / f"foxglove-{model.name}.json"] = _foxglove(found, model.unit)
        made[DOCS / "layouts" / f"plotjuggler-{model.name}.xml"] = _plotjuggler(found)
    return made


def _foxglove(found: Curves, unit: str) -> str:
    panels: dict[str, object] = {}
    sides = []
    for side, joints in found.items():
        names = []
        for name, paths in joints:
            key = f"Plot!{side}_{name}"
            names.append(key)
            panels[key] = {
                "title": f"{side} {name}, {unit}",
                "paths": [
                    {
                        # quoted, because the topics do not begin with a slash
                        "value": f'"{topic}".{path}',
                        "label": "command" if i == 0 else "state",
                        "color": _COMMAND if i == 0 else _STATE,
                        "enabled": True,
                        "timestampMethod": "receiveTime",
                    }
                    for i, (topic, path) in enumerate(paths)
                ],
                "isSynced": True,
                "xAxisVal": "timestamp",
                "showLegend": True,
                "legendDisplay": "floating",
                "showXAxisLabels": True,
                "showYAxisLabels": True,
            }
        sides.append(_mosaic(names, "column"))
    return (
        json.dumps(
            {
                "configById": panels,
                "globalVariables": {},
                "userNodes": {},
                "playbackConfig": {"speed": 1},
                "layout": {"direction": "row", "first": sides[0], "second": sides[1]},
            },
            indent=1,
        )
        + "\n"
    )


def _mosaic(names: list[str], direction: str) -> object:
    """Panels of equal size below, or beside, each other."""
    if len(names) == 1:
        return names[0]
    half = len(names) // 2
    return {
        "direction": direction,
        "first": _mosaic(names[:half], direction),
        "second": _mosaic(names[half:], direction),
        "splitPercentage": round(100 * half / len(names), 1),
    }


def _plotjuggler(found: Curves) -> str:
    root = ElementTree.Element("root")
    titles = {"name": "Main Window", "parent": "main_window"}
    window = ElementTree.SubElement(root, "tabbed_widget", titles)
    for side, joints in found.items():
        tab = ElementTree.SubElement(window, "Tab", tab_name=str(side), containers="1")
        container = ElementTree.SubElement(tab, "Container")
        columns = [joints[i : i + _ROWS] for i in range(0, len(joints), _ROWS)]
        beside = _splitter(container, "|", len(columns))
        for column in columns:
            below = _splitter(beside, "-", len(column))
            for name, paths in column:
                area = ElementTree.SubElement(below, "DockArea", name=name)
                plot = ElementTree.SubElement(
                    area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false"
                )
                ElementTree.SubElement(plot, "limitY")
                for i, (topic, path) in enumerate(paths):
                    ElementTree.SubElement(
                        plot,
                        "curve",
                        name=f"{topic}/{path.replace('.', '/')}",
                        color=_COMMAND if i == 0 else _STATE,
                    )
    ElementTree.indent(root, " ")
    return (
        "<?xml version='1.0' encoding='UTF-8'?>\n"
        + ElementTree.tostring(root, encoding="unicode")
        + "\n"
    )


def _splitter(parent: ElementTree.Element, orientation: str, count: int) -> ElementTree.Element:
    return ElementTree.SubElement(
        parent,
        "DockSplitter",
        orientation=orientation,
        count=str(count),
        sizes=";".join(f"{1 / count:.6f}" for _ in range(count)),
    )
