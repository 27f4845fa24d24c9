"""The page of ``dexkit view``: a server on this machine, and the contents of the page."""

from __future__ import annotations

import contextlib
import io
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from dexkit.errors import ExtraMissing
from dexkit.hand import Subject
from dexkit.kinematics import Skeleton
from dexkit.robots import RobotModel
from dexkit.view.drawing import places
from dexkit.view.guarded_server import GuardedPort
from dexkit.view.html_tables import hand_table, time_strip, topics_table
from dexkit.view.sources import HISTORY, Source
from dexkit.view.transport import SPEEDS, Transport
from dexkit.view.web_origins import Allowed
from dexkit.watch import Mark, Picture, SubjectView
from dexkit.watch.number_format import subject_name

try:
    import viser

    from dexkit.view.scene import Figure
    from dexkit.view.strip_charts import Chart, Curve
except ImportError as error:
    raise ExtraMissing(
        "the page needs the package viser", hint="pip install 'dexkit[view]'"
    ) from error

if TYPE_CHECKING:
    from viser import GuiHtmlHandle, GuiSliderHandle

__all__ = ["DEFAULT_PORT", "Page"]

DEFAULT_PORT = 8720
_PORTS = 50  # how many are tried from there
_RATE = 30.0
_TABLES = 0.25  # seconds between updates of the tables
_CHARTS = 0.1
_IDLE = 0.25  # seconds between looks while nobody has the page open
_MOST_BUTTONS = 40
_MOST_CHARTS = 8
_BUTTONS: dict[str, Callable[[Transport], None]] = {
    "Pause / go on": Transport.toggle,
    "-1 s": lambda transport: transport.step(-1.0),
    "+1 s": lambda transport: transport.step(1.0),
    "Now / start": Transport.restart,
}
_NOTHING = '<p style="font:13px system-ui;margin:10px">No hand has been seen here yet.</p>'


class _Server(viser.ViserServer):
    """A server that makes no connection to the outside: a page cannot ask it for a share link."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refused."""
        return None


@dataclass
class _Shown:
    """One source on the page."""

    source: Source
    transport: Transport
    hands_html: GuiHtmlHandle
    topics_html: GuiHtmlHandle
    strip: GuiHtmlHandle
    slider: GuiSliderHandle[float] | None = None
    figures: dict[tuple[str, str, str], Figure] = field(default_factory=dict)


class Page:
    """Shows sources until it is closed.

    :param sources: side by side; two recordings share their controls.
    :param host: address that it is bound to.
    :param port: None for the first free one from :data:`DEFAULT_PORT`.
    :param origins: of other web pages that may read the view.
    :param skeletons: by model and subject (``left``, ``robot``), instead of the model's own.
    :raises UsageError: the port is taken, or pages that may not read cannot be kept out.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        origins: Sequence[str] = (),
        skeletons: Mapping[tuple[str, str], Skeleton] | None = None,
    ) -> None:
        first = DEFAULT_PORT if port is None else port
        ports = range(first, first + (_PORTS if port is None else 1))
        with contextlib.ExitStack() as stack:
            self._guard = stack.enter_context(GuardedPort(host, ports, Allowed(host, origins)))
            hidden = self._guard.hidden
            with contextlib.redirect_stdout(io.StringIO()):
                self._server = _Server(
                    host=hidden.host, port=hidden.port, verbose=False, label="dexkit view"
                )
                stack.callback(self._stop_server)
            self._guard.open()
            stack.pop_all()
        self.host, self.port = host, self._guard.port
        self._skeletons = dict(skeletons or {})
        self._charts: list[Chart] = []
        self._window = 10.0
        self._lock = threading.RLock()  # callbacks of the page run in threads of the server
        self._next_tables = self._next_charts = 0.0
        self._arranged = 0
        self.frames = 0
        self._build(list(sources))

    @property
    def url(self) -> str:
        """URL for browsers."""
        return f"http://{self._guard.authority}"

    def close(self) -> None:
        """End the server."""
        self._guard.close()
        self._stop_server()

    def _stop_server(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def run(self, stop: threading.Event) -> None:
        """Show until ``stop`` is set: 30 pictures a second, none while the page is not open."""
        period = 1.0 / _RATE
        due = time.monotonic()
        while not stop.is_set():
            looked_at = bool(self._server.get_clients())
            if not looked_at:  # a recording begins when somebody sees it
                for transport in self._transports:
                    transport.hold()
            self.step(time.monotonic())
            due = max(due + period, time.monotonic())
            stop.wait(max(0.0, due - time.monotonic()) if looked_at else _IDLE)

    def step(self, now: float) -> None:
        """Take new samples, and show the moment that is due.

        :param now: monotonic clock, seconds.
        """
        with self._lock:
            tables, charts = now >= self._next_tables, now >= self._next_charts
            if tables:
                self._next_tables = now + _TABLES
            if charts:
                self._next_charts = now + _CHARTS
            with self._server.atomic():
                for shown in self._shown:
                    end = shown.source.poll()
                    begin = max(0.0, end - HISTORY) if shown.source.live else 0.0
                    at = shown.transport.advance(now, begin, end)
                    self._show(shown, shown.source.collector.picture(at), tables)
                if charts:
                    at = self._shown[0].transport.at
                    for chart in self._charts:
                        chart.update(at, self._window)
            self.frames += 1

    # -- building the page -----------------------------------------------------------------------

    def _build(self, sources: list[Source]) -> None:
        server, gui = self._server, self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.scene.set_up_direction("+z")
        # from where one looks: the library's own lights are above, and its room washes colours out
        server.scene.configure_default_lights(enabled=False)
        server.scene.configure_environment_map(hdri=None)
        server.scene.add_light_ambient("/lights/ambient", intensity=1.1)
        server.scene.add_light_directional(
            "/lights/main", position=(-1.2, -2.0, 2.2), intensity=2.0, cast_shadow=True
        )
        server.scene.add_light_directional(
            "/lights/fill", position=(1.8, -1.2, 0.4), intensity=0.8, cast_shadow=False
        )
        server.scene.add_grid("/grid", width=4.0, height=4.0, position=(0.0, 0.0, -0.08),
                              cell_size=0.05, section_size=0.25)  # fmt: skip
        server.initial_camera.fov = math.radians(50)
        self._transports = [Transport(live=s.live) for s in sources]
        strips = [gui.add_html("") for _ in sources]
        sliders = self._controls(sources)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Hands"):
            hands = [gui.add_html("") for _ in sources]
        with tabs.add_tab("Topics"):
            topics = [gui.add_html("") for _ in sources]
        with tabs.add_tab("Charts"):
            self._chart_controls(sources)
        if any(s.marks for s in sources):
            with tabs.add_tab("Marks"):
                for number, source in enumerate(sources):
                    self._mark_buttons(number, source)
        self._shown = [
            _Shown(*each)
            for each in zip(sources, self._transports, hands, topics, strips, sliders, strict=True)
        ]
        gui.main_panel.dock_right()
        with contextlib.suppress(AttributeError):
            gui.main_panel.set_width(430)

    def _controls(self, sources: list[Source]) -> list[GuiSliderHandle[float] | None]:
        gui = self._server.gui
        pause = gui.add_button_group("", tuple(_BUTTONS))

        @pause.on_click
        def _(event: object) -> None:
            with self._lock:
                for transport in self._transports:
                    _BUTTONS[pause.value](transport)

        if not all(s.live for s in sources):
            speeds = {f"{s:g}": s for s in SPEEDS}
            speed = gui.add_button_group("Speed", tuple(speeds))

            @speed.on_click
            def _(event: object) -> None:
                with self._lock:
                    for transport in self._transports:
                        transport.speed = speeds[speed.value]

        sliders: list[GuiSliderHandle[float] | None] = []
        for number, source in enumerate(sources):
            if source.live:
                low, high, label = -HISTORY, 0.0, "Back, s"
            else:
                low, high, label = 0.0, max(0.1, round(source.poll(), 2)), "Time, s"
            slider = gui.add_slider(label, low, high, 0.01, high if source.live else low)
            slider.on_update(self._slide(number, slider, source.live))
            sliders.append(slider)
        return sliders

    def _slide(
        self, number: int, slider: GuiSliderHandle[float], live: bool
    ) -> Callable[[viser.GuiEvent[GuiSliderHandle[float]]], None]:
        def slid(event: viser.GuiEvent[GuiSliderHandle[float]]) -> None:
            if event.client is None:  # set by this program
                return
            with self._lock:
                transport = self._transports[number]
                transport.seek(slider.value + (transport.end if live else 0.0))

        return slid

    def _mark_buttons(self, number: int, source: Source) -> None:
        gui = self._server.gui
        verdicts = [m for m in source.marks if m.kind != "phase"]
        phases = [m for m in source.marks if m.kind == "phase"]
        gui.add_markdown(f"**{_plain(source.title)}**")
        if not verdicts:
            gui.add_markdown("No requirement failed.")
        for mark in verdicts[:_MOST_BUTTONS]:
            self._mark_button(number, mark, source, "red" if mark.kind == "fail" else "orange")
        if len(verdicts) > _MOST_BUTTONS:
            gui.add_markdown(f"and {len(verdicts) - _MOST_BUTTONS} more.")
        if phases:
            with gui.add_folder("Phases of the stimulus", expand_by_default=not verdicts):
                for mark in phases[:_MOST_BUTTONS]:
                    self._mark_button(number, mark, source, "gray")

    def _mark_button(self, number: int, mark: Mark, source: Source, color: str) -> None:
        at = source.collector.seconds(mark.time_ns)
        button = self._server.gui.add_button(
            f"{at:.2f} s  {mark.title}",
            color=color,  # type: ignore[arg-type]
            hint=mark.text or None,
        )

        @button.on_click
        def _(event: object) -> None:
            with self._lock:
                self.go_to(number, at)

    def go_to(self, number: int, at: float) -> None:
        """Show a moment of a source, paused just before it."""
        transport = self._transports[number]
        transport.seek(at)
        transport.paused = True

    def _chart_controls(self, sources: list[Source]) -> None:
        gui = self._server.gui
        window = gui.add_slider("Window, s", 1.0, 60.0, 1.0, self._window)

        @window.on_update
        def _(event: object) -> None:
            self._window = float(window.value)

        self._number = gui.add_dropdown("Number", ("-",), initial_value="-")
        add = gui.add_button("Add a chart")
        beside = gui.add_button("Add to the last chart")
        clear = gui.add_button("Remove all")
        self._choices: dict[str, Curve] = {}
        self._charts_folder = gui.add_folder("Charts")

        @add.on_click
        def _(event: object) -> None:
            with self._lock:
                self._add_chart([self._choices[self._number.value]])

        @beside.on_click
        def _(event: object) -> None:
            with self._lock:
                if not self._charts:
                    return
                last = self._charts.pop()
                last.remove()
                self._add_chart([*last.curves, self._choices[self._number.value]])

        @clear.on_click
        def _(event: object) -> None:
            with self._lock:
                while self._charts:
                    self._charts.pop().remove()

    def _add_chart(self, curves: list[Curve]) -> None:
        if len(self._charts) >= _MOST_CHARTS:
            self._charts.pop(0).remove()
        with self._charts_folder:
            self._charts.append(Chart(self._server, ", ".join(c.name for c in curves), curves))

    # -- showing -----------------------------------------------------------------------------------

    def _show(self, shown: _Shown, picture: Picture, tables: bool) -> None:
        self._arrange(picture, shown)
        many = len(self._shown) > 1
        for view in picture.subjects:
            key = (view.prefix, view.dialect, str(view.subject))
            if key in shown.figures:
                shown.figures[key].update(view)
        if not tables:
            return
        shown.hands_html.content = "".join(
            hand_table(v, _title(v, shown.source.title if many else "")) for v in picture.subjects
        ) or _NOTHING  # fmt: skip
        shown.topics_html.content = topics_table(picture.topics, shown.source.title)
        self._show_time(shown)

    def _show_time(self, shown: _Shown) -> None:
        source, transport = shown.source, shown.transport
        if source.live:
            behind = transport.end - transport.at
            text = "live" if transport.following else f"paused, {behind:.1f} s ago"
            value = -behind
            shown.strip.content = (
                f'<p style="font:13px system-ui;margin:4px 10px"><b>{text}</b> · '
                f"{_escaped(source.title)}</p>"
            )
        else:
            collector = source.collector
            marks = [
                (collector.seconds(m.time_ns), collector.seconds(m.end_ns), m.kind, m.title)
                for m in source.marks
            ]
            shown.strip.content = time_strip(marks, transport.end, transport.at, source.title)
            value = transport.at
        slider = shown.slider
        if slider is not None and abs(slider.value - value) > 0.005:
            slider.value = min(max(value, slider.min), slider.max)  # type: ignore[misc]

    def _arrange(self, picture: Picture, shown: _Shown) -> None:
        """Make figures of hands that are new, and put all into their places."""
        new = [
            v
            for v in picture.subjects
            if (v.prefix, v.dialect, str(v.subject)) not in shown.figures
        ]
        if not new:
            return
        for each in self._shown:
            for figure in each.figures.values():
                figure.remove()
            each.figures.clear()
        everything: list[tuple[_Shown, SubjectView]] = []
        for each in self._shown:
            moment = each.source.collector.picture(each.transport.at)
            everything += [(each, view) for view in moment.subjects]
        robots = {i: isinstance(v.model, RobotModel) for i, (_, v) in enumerate(everything)}
        spots = places(len(everything), robots)
        many = len(self._shown) > 1
        for i, (each, view) in enumerate(everything):
            key = (view.prefix, view.dialect, str(view.subject))
            each.figures[key] = Figure(
                self._server,
                f"/figures/{self._arranged}_{i}",
                view,
                f"{view.prefix} {view.subject} · {each.source.title}".lstrip()
                if many
                else subject_name(view),
                spots[i],
                self._skeletons.get((view.model.name, str(view.subject))),
                i % 2 if len(everything) > 2 else 0,
            )
        self._arranged += 1
        self._look_at(len(everything) - sum(robots.values()), any(robots.values()))
        self._offer_numbers()

    def _look_at(self, hands: int, robots: bool) -> None:
        distance = 0.62 * max(1.0, hands / 2) if hands else 0.2
        if robots and hands:
            distance = max(distance, 0.8)
        position = (0.1 if hands else 0.5, -distance, 0.24 if hands else 0.6)
        target = (0.0, 0.0, 0.07) if hands else (0.0, 2.2, 0.6)
        self._server.initial_camera.position = position
        self._server.initial_camera.look_at = target
        for client in self._server.get_clients().values():
            client.camera.position = position
            client.camera.look_at = target

    def _offer_numbers(self) -> None:
        """Offer every number in the choice, and chart the first joint of each hand."""
        many = len(self._shown) > 1
        self._choices = {}
        first: dict[tuple[str, str, Subject], dict[str, Curve]] = {}
        for number, shown in enumerate(self._shown, 1):
            fields = shown.source.collector.fields()
            shared = Counter(topic for topic, _ in {(t, part.subject) for t, part, _ in fields})
            for topic, part, each in fields:
                whose = f" {part.subject}" if shared[topic] > 1 else ""
                name = f"{topic.removeprefix('rt/')}{whose}  {each.name}"
                name += f"  #{number}" if many else ""
                curve = Curve(shown.source.collector, topic, each.path, name)
                self._choices.setdefault(name, curve)
                if (each.quantity, each.index) == ("q", 0) and part.kind != "low":
                    of_hand = first.setdefault((part.prefix, part.model.name, part.subject), {})
                    of_hand.setdefault(topic, curve)
        options = tuple(self._choices) or ("-",)
        self._number.options = options
        if self._charts:
            return
        for curves in list(first.values())[:2]:
            self._add_chart(list(curves.values()))


def _title(view: SubjectView, source: str) -> str:
    name = subject_name(view)
    return f"{name} · {source}" if source else name


def _plain(text: str) -> str:
    """Text for markdown, without its signs."""
    return "".join(c if c.isalnum() or c in " .,:/-" else " " for c in text)


def _escaped(text: str) -> str:
    from html import escape

    return escape(text)
