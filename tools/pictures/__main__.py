"""``python -m tools.pictures``: make the pictures anew."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from dexkit.cli.view import recorded
from dexkit.conformance.audit.audit import Audit, in_this_process
from dexkit.conformance.report.curves import page as curves_page
from dexkit.conformance.report.curves import recorded as curves_of
from dexkit.threads import Worker
from dexkit.traces import open_trace, sample_path
from dexkit.view.browser_page import Page
from tools.browser import Browser, chromium
from tools.pictures.terminal import monitor_picture
from tools.spoiled_sets.author_e import write_all

IMAGES = Path(__file__).parent.parent.parent / "docs" / "images"
_SETTLE = 0.8  # seconds in which a page takes what it was sent
_FRAMES, _FRAME = 48, 0.25  # of the animated picture, and seconds of the recording between them


@contextmanager
def viewed(
    samples: Sequence[str], folder: Path, width: int, height: int
) -> Iterator[tuple[Browser, Callable[[float], None]]]:
    """A browser with the viewer's page of samples, and a function that goes to a moment."""
    sources = [recorded(sample_path(name), True) for name in samples]
    stop = threading.Event()
    with Page(sources, port=0) as page:
        worker = Worker("page", page.run, stop)
        worker.start()

        def go_to(at: float) -> None:
            for number in range(len(sources)):
                page.go_to(number, at)
            time.sleep(_SETTLE)

        try:
            with Browser(folder, width, height) as browser:
                browser.open(page.url)
                browser.wait("document.body && document.querySelector('.dk table') !== null")
                # the viewer's own remark about a machine without a graphics processor
                browser.run(
                    "document.head.insertAdjacentHTML('beforeend',"
                    "'<style>.mantine-Notifications-root{display:none}</style>')"
                )
                time.sleep(4.0)  # its letters come last
                yield browser, go_to
        finally:
            stop.set()
            worker.join()
    worker.check()


def pictures(only: Sequence[str]) -> None:
    """Make those that are named, or all."""
    wanted = set(only)

    def asked(name: str) -> bool:
        return not wanted or name in wanted

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if asked("view-hands") or asked("view-moving"):
            with viewed(["dex3_pinch"], folder / "a", 1280, 720) as (browser, go_to):
                go_to(12.2)
                if asked("view-hands"):
                    save(browser.picture(), "view-hands")
                if asked("view-moving"):
                    animate(browser, go_to, 4.5)
        if asked("view-marks"):
            with viewed(["dex1_hand_dropout"], folder / "b", 1280, 720) as (browser, go_to):
                browser.click("Marks")
                go_to(9.0)
                save(browser.picture(), "view-marks")
        if asked("view-two"):
            with viewed(["dex1_pick_place", "dex1_hand_dropout"], folder / "c", 1280, 720) as (
                browser,
                go_to,
            ):
                go_to(7.0)
                save(browser.picture(), "view-two")
        if asked("info"):
            path = folder / "info.html"
            path.write_text(curves_page([curves_of(open_trace(sample_path("dex3_pinch")))]))
            with Browser(folder / "d", 1000, 620) as browser:
                browser.open(path.as_uri())
                browser.wait("document.querySelectorAll('svg').length > 3")
                save(browser.picture(), "info")
        if asked("audit"):
            page = audited(folder)
            for name, width, height in (("audit", 1100, 1500), ("audit-phone", 400, 1500)):
                with Browser(folder / name, width, height) as browser:
                    browser.open(page.as_uri())
                    browser.wait("document.querySelectorAll('.moment svg').length > 0")
                    if name == "audit-phone":
                        browser.run("document.querySelector('#worst').scrollIntoView()")
                    save(browser.picture(), name)
        if asked("monitor"):
            path = folder / "monitor.html"
            path.write_text(monitor_picture(sample_path("dex3_pinch"), 12.2, 100, 30))
            with Browser(folder / "e", 900, 640) as browser:
                browser.open(path.as_uri())
                browser.wait("document.querySelector('pre') !== null")
                save(browser.picture(), "monitor")


def audited(folder: Path) -> Path:
    """The page of an audit of three sets with known faults."""
    sets = folder / "sets"
    write_all(sets)
    before = Path.cwd()
    os.chdir(sets)  # so that names on the page are short
    try:
        Audit(["pick_dex1", "toast_dex3", "xr_dex3"], Path("audit-out")).run(in_this_process)
    finally:
        os.chdir(before)
    return sets / "audit-out/summary.html"


def save(png: bytes, name: str) -> None:
    """Write a picture."""
    with Image.open(io.BytesIO(png)) as image:
        image.convert("RGB").save(IMAGES / f"{name}.png", optimize=True)
    report(IMAGES / f"{name}.png")


def animate(browser: Browser, go_to: Callable[[float], None], begin: float) -> None:
    """Write the animated picture: some seconds of the recording."""
    frames = []
    for i in range(_FRAMES):
        go_to(begin + i * _FRAME)
        with Image.open(io.BytesIO(browser.picture())) as image:
            frames.append(image.convert("RGB").resize((800, 450), Image.Resampling.LANCZOS))
    path = IMAGES / "view-moving.webp"
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=round(_FRAME * 1e3), loop=0,
        quality=55, method=4,
    )  # fmt: skip
    report(path)


def report(path: Path) -> None:
    """Print the written files."""
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    if chromium() is None:
        sys.exit("error: Chromium is not on this machine")
    pictures(sys.argv[1:])
