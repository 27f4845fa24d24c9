"""The screen of ``dexkit monitor`` as HTML."""

from __future__ import annotations

import io
from pathlib import Path

from rich.console import Console

from dexkit.monitor.screen import Shown, screen
from dexkit.traces import open_trace
from dexkit.traces.watched import feed
from dexkit.watch.events import Events

__all__ = ["monitor_picture"]

_FORMAT = (
    "<!doctype html><meta charset='utf-8'><body style='margin:0;background:#16191d'>"
    "<pre style='margin:0;padding:10px;color:#d8dee4;font:14.2px/1.32 DejaVu Sans Mono,monospace'>"
    "{code}</pre></body>"
)


def monitor_picture(recording: Path, at: float, width: int, height: int) -> str:
    """The screen at a moment of a recording, as if it were live."""
    collector = feed(open_trace(recording))
    events = Events(collector)
    for i in range(int(at) + 1):
        events.update(collector.picture(float(i)))
    told = [(f"12:00:{event.at:02.0f}", event) for event in events.recent]
    shown = Shown("domain 0 on eth0", f"12:00:{at:02.0f}")
    console = Console(file=io.StringIO(), record=True, width=width, force_terminal=True)
    for line in screen(collector.picture(at), told, shown, width, height):
        console.print(line, no_wrap=True, crop=True)
    return console.export_html(code_format=_FORMAT, inline_styles=True)
