"""The page of ``dexkit view`` in a real browser: what is seen, clicked, and loaded."""

from __future__ import annotations

import importlib.util
import io
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from dexkit.hand import MotorError
from dexkit.threads import Worker
from dexkit.view.sources import Recorded
from dexkit.watch import Mark
from tests.watch_helpers import STATE, closing_hands, dex3_state, ns
from tools.browser import Browser, chromium

if importlib.util.find_spec("viser") is None or chromium() is None:
    pytest.skip("needs viser and chromium", allow_module_level=True)

pytestmark = pytest.mark.soak  # a page needs seven seconds of a processor

TEXT = "document.body.innerText"


class Seen(NamedTuple):
    """A browser with the page open."""

    browser: Browser
    url: str


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    from dexkit.view.browser_page import Page

    late = int(MotorError.OVERCURRENT)
    hands = closing_hands(30.0, 20.0, faults=lambda t: {1: late} if t > 20.0 else {})
    marks = (
        Mark(ns(0), ns(10), "phase", "step both"),
        Mark(ns(25), ns(25), "fail", "DEX3-X-01 right", "0.2 rad too far"),
    )
    stop = threading.Event()
    with Page([Recorded("a.mcap", hands, marks)], port=0) as page:
        worker = Worker("page", page.run, stop)
        worker.start()
        try:
            with Browser(tmp_path_factory.mktemp("browser"), 760, 480) as browser:
                browser.open(page.url)
                browser.wait(f"document.body && {TEXT}.includes('thumb_1')")
                yield Seen(browser, page.url)
        finally:
            stop.set()
            worker.join()
    worker.check()


def picture(browser: Browser) -> NDArray[np.int16]:
    """What is seen of the scene, shape (height, width, 3)."""
    from PIL import Image

    with Image.open(io.BytesIO(browser.picture())) as image:
        return np.asarray(image.convert("RGB"), dtype=np.int16)[:, :300]


def until_still(browser: Browser) -> NDArray[np.int16]:
    """The scene when it no longer changes."""
    last = picture(browser)
    for _ in range(200):
        now = picture(browser)
        if not np.abs(now - last).any():
            return now
        last = now
    raise AssertionError("the scene does not come to rest")


def press(browser: Browser, key: str) -> None:
    """Press a key on the time line."""
    browser.run("document.querySelector('[role=slider]').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)


def test_a_click_on_a_failed_requirement_shows_its_fault(seen: Seen) -> None:
    browser, url = seen
    browser.click("Marks")
    browser.click("25.00 s DEX3-X-01 right")
    browser.wait(f"{TEXT}.includes('25.00 s of')")
    browser.click("Hands")
    browser.wait(f"{TEXT}.includes('thumb_1: overcurrent')")
    # the page loads nothing from elsewhere, and logs no error
    own = (url, url.replace("http", "ws"), f"blob:{url}", "data:")
    assert [u for u in browser.requested if not u.startswith(own)] == []
    assert browser.errors == []


def test_hands_move_when_a_recording_is_scrubbed(seen: Seen) -> None:
    browser, _ = seen
    browser.click("Hands")
    browser.click("+1 s")  # and pause
    press(browser, "Home")
    browser.wait(f"{TEXT}.includes('0.00 s of')")
    opened = until_still(browser)
    assert not browser.run(f"{TEXT}.includes('overcurrent')")
    press(browser, "End")
    browser.wait(f"{TEXT}.includes('29.95 s of')")
    browser.wait(f"{TEXT}.includes('thumb_1: overcurrent')")
    browser.click("Marks")
    browser.click("25.00 s DEX3-X-01 right")
    browser.wait(f"{TEXT}.includes('25.00 s of')")
    moved = np.abs(until_still(browser) - opened).max(axis=2) > 40
    assert moved.mean() > 0.002  # of the scene


def test_a_fault_of_a_live_hand_shows_and_goes(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds")
    from dexkit.dds import DdsNode
    from dexkit.messages import message_type
    from dexkit.view.browser_page import Page
    from dexkit.view.sources import Live
    from dexkit.watch import Collector
    from dexkit.watch.listener import Listener
    from tests.dds_helpers import free_domain

    domain, stop = free_domain(), threading.Event()
    with (
        DdsNode(domain) as hand,
        DdsNode(domain) as node,
        Listener(node, Collector(), None) as listener,
        Page([Live("live", listener)], port=0) as page,
    ):
        writer = hand.writer("rt/dex3/left/state", message_type(STATE))
        faults: dict[int, int] = {}

        def publish() -> None:
            while not stop.wait(0.01):
                writer.write_raw(dex3_state([0.2] * 7, faults))

        workers = [Worker("page", page.run, stop), Worker("hand", publish)]
        for worker in workers:
            worker.start()
        try:
            with Browser(tmp_path, 760, 480) as browser:
                browser.open(page.url)
                browser.wait(f"document.body && {TEXT}.includes('thumb_1')")
                assert not browser.run(f"{TEXT}.includes('overcurrent')")
                faults[1] = int(MotorError.OVERCURRENT)
                browser.wait(f"{TEXT}.includes('thumb_1: overcurrent')")
                faults.clear()
                browser.wait(f"!{TEXT}.includes('overcurrent')")
        finally:
            stop.set()
            for worker in workers:
                worker.join()
    for worker in workers:
        worker.check()
