"""Test the HTML pages in a real browser: width on a phone, loaded files and console errors.

A browser's window has a minimum width, so the page is in a frame that is as wide as a phone.
"""

from __future__ import annotations

import json
import re
import subprocess
from html import escape, unescape
from pathlib import Path

import pytest

from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.recording import Recording
from dexkit.conformance.report.compare import Comparison, render_comparison
from dexkit.conformance.report.html import render
from dexkit.traces import open_trace, sample_path
from tests.optional import chromium
from tests.report_helpers import result_of_every_kind

PHONE = 390
MEASURE = """
<script>
onload = () => {
  const found = {};
  for (const frame of document.querySelectorAll("iframe")) {
    const page = frame.contentDocument, wide = [];
    for (const e of page.querySelectorAll("body *"))
      if (e.getBoundingClientRect().right > innerWidthOf(frame) + 0.5 && !e.closest(".wrap"))
        wide.push(e.tagName + "." + e.className);
    found[frame.id] = {width: page.documentElement.scrollWidth, wide: wide.slice(0, 5)};
  }
  document.getElementById("found").textContent = JSON.stringify(found);
};
const innerWidthOf = frame => frame.contentWindow.innerWidth;
</script><pre id="found">nothing</pre>
"""


@pytest.fixture(scope="module")
def seen(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[dict[str, dict[str, object]], list[str]]:
    """What the browser measured in each page, and the lines of its console."""
    browser = chromium()
    if browser is None:
        pytest.skip("no chromium here")
    view = Recording.decode(open_trace(sample_path("dex1_hand_dropout")))
    result = judge(view)
    page = render(result, view, link="run.mcap")
    runs = [result_of_every_kind("a hand with quite a long name"), result_of_every_kind("b")]
    pages = {
        "report": page,
        "kinds": render(result_of_every_kind("averylongwordthatfindsnoplacetobreak" * 3)),
        "compare": render_comparison(Comparison([*runs, *runs])),
        # the measurement must detect this
        "wide": page.replace("<main>", '<main><p style="width:600px">wide</p>'),
        "loads": page.replace("<main>", '<main><img alt="" src="http://loads.invalid/x.png">'),
    }
    frames = "".join(
        f'<iframe id="{name}" style="width:{PHONE}px;height:800px;border:0" '
        f'srcdoc="{escape(text)}"></iframe>'
        for name, text in pages.items()
    )
    folder = tmp_path_factory.mktemp("browser")
    (folder / "all.html").write_text(f"<!doctype html>{frames}{MEASURE}", encoding="utf-8")
    done = subprocess.run(
        [
            browser,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--hide-scrollbars",
            f"--user-data-dir={folder / 'profile'}",
            "--enable-logging=stderr",
            "--window-size=800,900",
            "--dump-dom",
            (folder / "all.html").as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    reports = re.findall(r'<pre id="found">(.*?)</pre>', done.stdout)
    assert reports, done.stderr[-2000:]
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    return json.loads(unescape(reports[-1])), console


@pytest.mark.parametrize("name", ["report", "kinds", "compare"])
def test_page_is_not_wider_than_a_phone(
    seen: tuple[dict[str, dict[str, object]], list[str]], name: str
) -> None:
    found, _ = seen
    assert found[name] == {"width": PHONE, "wide": []}


def test_measurement_detects_a_wide_page(
    seen: tuple[dict[str, dict[str, object]], list[str]],
) -> None:
    assert seen[0]["wide"]["width"] != PHONE


def test_page_loads_nothing_and_logs_no_errors(
    seen: tuple[dict[str, dict[str, object]], list[str]], tmp_path: Path
) -> None:
    _, console = seen
    assert len(console) == 1  # the page that wants an image, which its policy forbids
    assert "loads.invalid" in console[0]
    assert "Content Security Policy" in console[0]
