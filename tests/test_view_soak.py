"""What ``dexkit view`` costs, in a real browser, beside hands that are served: long runs."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest

from dexkit.child_processes import Tool
from dexkit.hand import Floats
from dexkit.messages import message_type
from tests.cli_helpers import running
from tests.dds_helpers import DdsNode, free_domain
from tests.watch_helpers import STATE
from tools.browser import Browser, chromium

if importlib.util.find_spec("viser") is None or chromium() is None:
    pytest.skip("needs viser and chromium", allow_module_level=True)

pytestmark = pytest.mark.soak

MINUTES = float(os.environ.get("DEXKIT_VIEW_SOAK_MINUTES", "20"))
TEXT = "document.body && document.body.innerText"
TICK = os.sysconf("SC_CLK_TCK")


def processor_time(pid: int) -> float:
    """Seconds that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def resident(pid: int) -> float:
    """MiB that a process holds."""
    found = re.search(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    assert found is not None
    return int(found[1]) / 1024


@contextmanager
def hands(domain: int) -> Iterator[None]:
    """Two Dex3-1 at 1000 Hz."""
    with Tool("serve", "sim-dex3", "--side", "both", "--domain", str(domain), "--quiet") as served:
        served.ready.wait(60)
        assert served.place, served.last_lines
        yield


@contextmanager
def viewed(domain: int) -> Iterator[tuple[int, str]]:
    """``dexkit view`` of a domain: its process and the page's address."""
    with Tool("view", "--domain", str(domain), "--no-open", "--port", "0") as view:
        view.ready.wait(60)
        assert view.place, view.last_lines
        yield view._process.pid, view.place


def opened(browser: Browser, url: str) -> float:
    """Seconds until the page shows a hand."""
    begin = time.monotonic()
    browser.open(url)
    browser.wait(f"{TEXT} && {TEXT}.includes('thumb_1')")
    return time.monotonic() - begin


def share(pid: int, seconds: float) -> float:
    """Part of a core that a process uses."""
    before, begin = processor_time(pid), time.monotonic()
    time.sleep(seconds)
    return (processor_time(pid) - before) / (time.monotonic() - begin)


def intervals(domain: int, seconds: float) -> Floats:
    """Between the source timestamps of the left hand's states, ms."""
    with DdsNode(domain) as node:
        reader = node.reader("rt/dex3/left/state", message_type(STATE), most=100_000)
        time.sleep(seconds)
        stamps = np.array([s.source_timestamp_ns for s in reader.take()])
        reader.close()
    return np.asarray(np.diff(stamps)[100:] / 1e6)


def told(name: str, found: Floats) -> str:
    q = np.percentile(np.abs(found - 1.0), (50, 99, 99.9, 100))
    return (
        f"{name}: jitter median {q[0]:.3f}, 99 % {q[1]:.3f}, 99.9 % {q[2]:.3f}, most {q[3]:.2f} ms"
    )


def test_viewer_of_two_hands_uses_little_processor_time(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """2 x 1000 Hz in, 30 pictures a second out, in under a quarter of a core.

    Times are reported; on a machine that is busy with something else they say little, so only
    the processor time of the viewer, which that does not change much, is an assertion.
    """
    domain = free_domain()
    with hands(domain):
        lines = [told("without the view", intervals(domain, 20.0))]
        with viewed(domain) as (pid, url):
            alone = share(pid, 5.0)
            lines.append(told("with the view, no page", intervals(domain, 20.0)))
            with Browser(tmp_path, 1000, 700) as browser:
                lines.append(f"page up after {opened(browser, url):.2f} s")
                watched = share(pid, 20.0)
                lines.append(told("with the page open", intervals(domain, 20.0)))
        lines.append(told("without it again", intervals(domain, 20.0)))
    lines.append(f"viewer: {alone:.3f} of a core without a page, {watched:.3f} with one")
    print("\n" + "\n".join(lines))
    record_property("view", "; ".join(lines))
    assert alone < 0.25
    assert watched < 0.25


def test_serve_shows_its_hand() -> None:
    with running("serve", "sim-dex1", "--side", "left", "--domain", free_domain(), "--view",
                 "--quiet") as process:  # fmt: skip
        first = process.line_out()
        assert first.startswith("view: http://127.0.0.1:")
        assert process.ready().startswith("ready: sim-dex1 left")
        code, _, _ = process.end(signal.SIGINT)
    assert code == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", int(first.rpartition(":")[2])))


def test_viewer_does_not_leak(tmp_path: Path) -> None:
    """Memory of the viewer and the page at a quarter of the time, and at the end.

    At the beginning the history of 1000 Hz is filled (docs/view.md); then nothing grows.
    """
    domain = free_domain()
    with ExitStack() as stack:
        stack.enter_context(hands(domain))
        pid, url = stack.enter_context(viewed(domain))
        browser = stack.enter_context(Browser(tmp_path, 1000, 700))
        opened(browser, url)
        browser.call("Performance.enable")

        def heap() -> float:
            browser.call("HeapProfiler.collectGarbage")
            metrics = browser.call("Performance.getMetrics")["metrics"]
            return float(next(m["value"] for m in metrics if m["name"] == "JSHeapUsedSize")) / 2**20

        seen = []
        for _ in range(20):
            time.sleep(MINUTES * 60 / 20)
            seen.append((resident(pid), heap()))
            print(f"viewer {seen[-1][0]:.1f} MiB, page's heap {seen[-1][1]:.1f} MiB", flush=True)
        quarter = np.mean(seen[5:8], axis=0)
        end = np.mean(seen[-3:], axis=0)
        assert end[0] - quarter[0] < 10.0
        assert end[1] - quarter[1] < 5.0
        assert browser.errors == []
