"""The curves of a recording in the terminal, a line each."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import numpy as np
from rich.cells import set_cell_size

from dexkit.console import Console
from dexkit.escaping import one_line
from dexkit.sparkline import ASCII, BLOCKS, resampled, sparkline

if TYPE_CHECKING:
    from dexkit.traces import Trace

__all__ = ["plot_lines", "print_plot"]

_NAME, _RANGE = 26, 18
_LEAST = 10


def print_plot(trace: Trace) -> None:
    """Print them as wide as the terminal."""
    console = Console()
    unicode = (sys.stdout.encoding or "").lower().replace("-", "").startswith("utf")
    for line in plot_lines(trace, console.width, BLOCKS if unicode else ASCII):
        console.print(line, highlight=False, markup=False, no_wrap=True, crop=True)


def plot_lines(trace: Trace, width: int, levels: str = BLOCKS) -> list[str]:
    """The position of every joint, commanded and measured on one scale, and the rate of topics.

    :param width: of the lines, cells.
    """
    from dexkit.traces.sessions.streams import streams_of

    cells = max(_LEAST, width - _NAME - _RANGE)
    seconds = max((trace.last_ns - trace.first_ns) / 1e9, 1e-3)
    end = f"{seconds:.1f} s"
    lines = ["", f"{'joint or topic':{_NAME}}{'0 s':<{cells - len(end)}}{end}"]
    streams = streams_of(trace)
    for part in dict.fromkeys(s.part for s in streams):
        mine = [s for s in streams if s.part == part]
        for joint in dict.fromkeys(j for s in mine for j in s.joints):
            curves = [
                (s.kind, (s.times_ns - trace.first_ns) / 1e9, s.q[:, s.joints.index(joint)])
                for s in mine
                if joint in s.joints
            ]
            finite = np.concatenate([q[np.isfinite(q)] for _, _, q in curves])
            if not len(finite):
                continue
            low, high = float(finite.min()), float(finite.max())
            for kind, t, q in curves:
                name = f"{part.removesuffix('_hand')} {joint} {'cmd' if kind == 'command' else 'q'}"
                drawn = sparkline(resampled(t, q, cells, 0.0, seconds), low, high, levels)
                lines.append(_line(name, drawn, f"{low:.2f} to {high:.2f} rad"))
    for topic, samples in sorted(trace.load(payloads=False).items()):
        t = (samples.log_time_ns - trace.first_ns) / 1e9
        counts, _ = np.histogram(t, bins=cells, range=(0.0, seconds))
        rates = counts * cells / seconds
        drawn = sparkline(rates, 0.0, float(rates.max(initial=0.0)), levels)
        lines.append(_line(topic, drawn, f"0 to {rates.max(initial=0.0):.0f} Hz"))
    return lines


def _line(name: str, drawn: str, scale: str) -> str:
    return f"{set_cell_size(one_line(name), _NAME - 1)} {drawn} {scale}"
