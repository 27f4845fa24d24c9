"""Pauses and the age of samples: no stale command reaches a hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.clock import ManualClock, RealClock
from dexkit.command_age import (
    DRIFT,
    FORGET,
    PAUSE,
    QUIET,
    SETTLE,
    PauseWatch,
    SampleAges,
    WriteDeadline,
)
from dexkit.errors import HandTimeout
from dexkit.hand import HandCommand, HandState, Side
from dexkit.models import DEX1_1
from dexkit.service.hand_core import HandCore
from tests.each import each

EPOCH = 1_795_000_000.0
STEP = 0.01  # seconds between exchanges
STARVED = 0.8  # seconds that CycloneDDS's own thread may stay behind after a pause


class TestPauseWatch:
    @pytest.mark.parametrize("suspended", [False, True], ids=["stopped", "suspended"])
    def test_pause_is_reported_once(self, suspended: bool) -> None:
        clock = ManualClock()
        watch = PauseWatch(clock)
        watch.measure_pause()
        (clock.suspend if suspended else clock.advance)(3.0)
        assert watch.measure_pause() == 3.0
        assert watch.measure_pause() == 0.0

    def test_real_clock_advances_during_suspend(self) -> None:
        clock = RealClock()
        assert clock.since_boot() >= clock.now() - 0.1


def test_late_command_is_not_written() -> None:
    clock = ManualClock()
    deadline = WriteDeadline(clock)
    clock.advance(PAUSE)
    deadline.check()
    clock.suspend(0.01)
    with pytest.raises(HandTimeout, match="was paused"):
        deadline.check()


# -- a program and its clients in virtual time ------------------------------------------------


@dataclass(frozen=True)
class Sent:
    writer: int
    at: float  # true time
    source_ns: int
    arrives: float


@dataclass(frozen=True)
class Source:
    """A client's clock.

    :param kind: "normal", "constant", "none" (0), or "coarse" (ticks of 15 ms).
    :param jumps: (true time, seconds).
    """

    offset: float = 0.0
    drift: float = 0.0
    kind: str = "normal"
    jumps: tuple[tuple[float, float], ...] = ()

    def stamp(self, at: float) -> int:
        if self.kind == "none":
            return 0
        if self.kind == "constant":
            return round(EPOCH * 1e9)
        seconds = self.offset + at * (1 + self.drift)
        seconds += sum(size for when, size in self.jumps if when <= at)
        if self.kind == "coarse":
            seconds = math.floor(seconds / 0.015) * 0.015
        return round((EPOCH + seconds) * 1e9)


def stream(
    writer: int, source: Source, times: list[float], latency: Callable[[int], float]
) -> list[Sent]:
    """What a client sends; it arrives in order."""
    out: list[Sent] = []
    arrives = 0.0
    for i, at in enumerate(times):
        arrives = max(arrives, at + latency(i))
        out.append(Sent(writer, at, source.stamp(at), arrives))
    return out


class Program:
    """The service's glue without threads: each sample is judged, each exchange looks first."""

    def __init__(self, start: float = 0.0) -> None:
        self.clock = ManualClock(start)
        spec = DEX1_1.spec(Side.LEFT, io_rate=1 / STEP, simulated=True)
        self.core = HandCore(spec, DEX1_1, self.clock)
        self.core.opened(spec)
        self.ages = SampleAges()
        self.receiving, self.exchanging = PauseWatch(self.clock), PauseWatch(self.clock)
        self.commands: list[Sent] = []
        self.driven: list[tuple[float, Sent]] = []  # what each exchange sent, and when
        self.braked: list[float] = []

    def receive(self, sample: Sent) -> None:
        now, received = self.clock.now(), self.clock.since_boot()
        self.tick()
        age = self.ages.age(sample.writer, sample.source_ns, received)
        self.commands.append(sample)
        # its number is its gain, which nothing clamps
        command = HandCommand.position(1.0, kp=float(len(self.commands)))
        self.core.submit(command, now - age)

    def tick(self) -> None:
        if self.receiving.measure_pause():
            self.ages.resumed(self.clock.since_boot())
            self.core.paused()

    def exchange(self) -> None:
        command = self.core.next_command()
        if self.exchanging.measure_pause():
            self.core.paused()
            command = self.core.next_command()
        self.core.measured(HandState.from_values(1.0, stamp=self.clock.now()))
        boot = self.clock.since_boot()
        if command.is_brake:
            self.braked.append(boot)
        else:
            self.driven.append((boot, self.commands[int(command.kp[0]) - 1]))

    def run(
        self,
        samples: list[Sent],
        until: float,
        pauses: list[tuple[float, float, bool]] = (),  # type: ignore[assignment]
        behind: Callable[[int], float] = lambda i: 0.0,
    ) -> None:
        """Live until then.

        :param pauses: (begin, end, whether the machine is suspended).
        :param behind: seconds after a pause at which the samples of a writer are handed over.
        """
        events: list[tuple[float, int, Sent | None]] = []
        last: dict[int, float] = {}
        for sample in sorted(samples, key=lambda s: s.arrives):
            at = sample.arrives
            for begin, end, _ in pauses:
                if begin <= at < end + behind(sample.writer):
                    at = end + behind(sample.writer)
            at = max(at, last.get(sample.writer, 0.0))
            last[sample.writer] = at + 2e-5  # a queue is emptied one by one
            events.append((at, 0, sample))
        for i in range(round(until / STEP)):
            if not any(begin <= i * STEP < end for begin, end, _ in pauses):
                events.append((i * STEP, 1, None))
        for at, _, one in sorted(events, key=lambda e: e[:2]):
            away = max(0.0, at - self.clock.since_boot())
            if any(suspended and at - away < begin < at for begin, _, suspended in pauses):
                self.clock.suspend(away)
            else:
                self.clock.advance(away)
            if one is None:
                self.exchange()
                if len(self.braked + self.driven) % 5 == 0:
                    self.tick()
            else:
                self.receive(one)


def every(period: float, begin: float, end: float) -> list[float]:
    return [begin + i * period for i in range(max(0, round((end - begin) / period)))]


latencies = st.floats(0.0, 0.1)
offsets = st.sampled_from([0.0, -3600.0, 0.3, 1e6, -1e8])
drifts = st.floats(-DRIFT, DRIFT)


@dataclass(frozen=True)
class Client:
    """What a client does around a pause.

    :param latency: (least, most beyond it), with ``noise`` of it for each sample in turn.
    :param spells: (period, begin, end) of its commands.
    :param behind: seconds after the pause until its samples are out of the socket.
    """

    writer: int
    source: Source
    latency: tuple[float, float]
    noise: tuple[float, ...]
    spells: tuple[tuple[float, float, float], ...]
    behind: float

    def sent(self) -> list[Sent]:
        least, jitter = self.latency
        times = sorted(t for spell in self.spells for t in every(*spell))
        return stream(self.writer, self.source, times, lambda i: least + jitter * self.noise[i % 5])


@st.composite
def clients(draw: st.DrawFn, begin: float, end: float) -> Client:
    kind = draw(st.sampled_from(["normal", "normal", "constant", "none", "coarse"]))
    jump = st.tuples(st.floats(0.5, end + 2.0), st.floats(-10.0, 10.0))
    jumps = draw(st.lists(jump, max_size=2))
    period = draw(st.sampled_from([0.004, 0.02, 0.1, 0.7]))
    spells = []
    if draw(st.booleans()):
        spells.append((period, draw(st.floats(0.1, 1.0)), begin))
    # a queue holds its first samples, or any
    spells.append((period, draw(st.floats(begin, end)), draw(st.floats(begin, end))))
    if draw(st.booleans()):
        spells.append((period, end + draw(st.floats(0.0, 0.5)), end + 2.0))
    # A clock that jumps while samples are stuck, or that is not usable, shows nothing about them:
    # then the socket must have been emptied in time.
    blind = bool(jumps) or kind in ("constant", "none")
    return Client(
        draw(st.integers(1, 5)),
        Source(draw(offsets), draw(drifts), kind, tuple(jumps)),
        (draw(latencies), draw(st.floats(0.0, 0.04))),
        tuple(draw(st.lists(st.floats(0.0, 1.0), min_size=5, max_size=5))),
        tuple(spells),
        draw(st.floats(0.0, 0.05 if blind else STARVED)),
    )


@given(st.data())
def test_nothing_sent_before_a_pause_ends_moves_the_hand_after_it(data: st.DataObject) -> None:
    begin = 2.0
    end = begin + data.draw(st.floats(PAUSE + 0.02, 4.0), "pause")
    suspended = data.draw(st.booleans(), "suspended")
    some = st.lists(clients(begin, end), min_size=1, max_size=3, unique_by=lambda c: c.writer)
    many = data.draw(some, "clients")
    program = Program()
    behind = {client.writer: client.behind for client in many}
    samples = [sample for client in many for sample in client.sent()]
    program.run(samples, end + 2.0, [(begin, end, suspended)], lambda w: behind[w])
    stale = [(t, s) for t, s in program.driven if t >= end > s.at]
    assert not stale, f"driven at {stale[0][0]}, sent {end - stale[0][1].at:.3f} s before the end"


@given(
    offset=offsets,
    drift=drifts,
    latency=latencies,
    pause=st.floats(0.3, 5.0),
    rate=st.floats(50.0, 500.0),
    suspended=st.booleans(),
)
@settings(max_examples=6)
def test_steady_client_is_obeyed_0_2_s_after_a_pause(
    offset: float, drift: float, latency: float, pause: float, rate: float, suspended: bool
) -> None:
    begin, end = 1.5, 1.5 + pause
    times = every(1 / rate, 0.5, end + 1.0)
    program = Program()
    program.run(
        stream(1, Source(offset, drift), times, lambda i: latency),
        end + 1.0,
        [(begin, end, suspended)],
    )
    assert program.driven[0][0] < 0.5 + latency + 2 * STEP + 1 / rate
    again = [t for t, _ in program.driven if t >= end]
    braked = [t for t in program.braked if t >= end]
    assert end <= braked[0] < end + 2 * STEP
    assert end + SETTLE - latency - 0.01 < again[0] < end + SETTLE + latency + 0.02 + 2 / rate
    assert all(t < again[0] for t in braked)  # and from then on without a break


@each(
    ("source", "most"),
    [
        (Source(-3600.0), SETTLE),
        (Source(kind="coarse"), SETTLE),
        (Source(kind="constant"), QUIET),
        (Source(kind="none"), QUIET),
    ],
    ids=["normal", "coarse", "constant", "none"],
)
def test_new_client_after_a_pause_is_obeyed(source: Source, most: float) -> None:
    """It was not received before: by its pace, or when the socket has long been emptied."""
    program = Program()
    sent = stream(1, source, every(0.005, 4.1, 6.0), lambda i: 0.001)
    program.run(sent, 6.0, [(1.0, 4.0, False)])
    begin = 4.1 if most == SETTLE else 4.0
    assert begin + most <= program.driven[0][0] < begin + most + 0.1


def test_single_command_after_a_pause_is_obeyed_if_its_age_is_known() -> None:
    def after(at: float, *, known: bool) -> bool:
        before = every(0.01, 0.5, 1.0) if known else []
        program = Program()
        sent = stream(1, Source(-7.0), [*before, at], lambda i: 0.002)
        program.run(sent, at + 0.3, [(2.0, 5.0, False)])
        return any(t >= 5.0 for t, _ in program.driven)

    assert not after(4.9, known=True)
    assert not after(5.0 + SETTLE / 2, known=True)
    assert after(5.06 + SETTLE, known=True)
    assert not after(5.06 + SETTLE, known=False)
    assert not after(4.9 + QUIET, known=False)
    assert after(5.06 + QUIET, known=False)


# -- without a pause --------------------------------------------------------------------------


@given(
    offset=offsets,
    drift=drifts,
    least=latencies,
    lags=st.lists(st.tuples(st.floats(1.0, 5.0), st.floats(0.0, 2.5)), min_size=1, max_size=4),
)
@settings(max_examples=6)
def test_late_command_is_not_obeyed(
    offset: float, drift: float, least: float, lags: list[tuple[float, float]]
) -> None:
    """A network that lags, or CycloneDDS's receiving thread alone that stood still."""

    def latency(i: int) -> float:
        at = 0.5 + i * 0.01
        return least + max((lag for when, lag in lags if when <= at < when + 0.4), default=0.0)

    program = Program()
    sent = stream(1, Source(offset, drift), every(0.01, 0.5, 6.0), latency)
    program.run(sent, 9.0)
    slack = DRIFT * 10 + STEP + 1e-3
    first: dict[float, float] = {}
    for t, s in program.driven:
        first.setdefault(s.at, t)
    for at, t in first.items():
        assert t - at <= least + PAUSE + slack, f"driven {t - at:.3f} s after it was sent"
    in_time = sum(s.arrives - s.at <= least + PAUSE - 0.01 for s in sent)
    stale = program.core.counters.stale
    assert program.core.counters.accepted == len(sent) - stale >= in_time


@each("size", [-7200.0, -5.0, -0.4, -0.1, 0.1, 0.4, 5.0, 7200.0])
def test_client_whose_clock_is_set_is_obeyed(size: float) -> None:
    program = Program()
    source = Source(12.0, jumps=((2.0, size),))
    program.run(stream(1, source, every(0.005, 0.5, 4.0), lambda i: 0.001), 4.0)
    ages = [(t, t - s.at) for t, s in program.driven]
    assert max(age for t, age in ages) < SETTLE + 0.05  # for so long the last one was in force
    assert max(age for t, age in ages if t > 2.3) < 0.02
    assert not [t for t in program.braked if t > 0.6]


class TestLongSilence:
    """Of a client, without a pause of ours."""

    @staticmethod
    def ages(source: Source, times: list[float], late: dict[float, float]) -> list[float]:
        ages = SampleAges()
        for i in range(100):
            ages.age(1, source.stamp(i * 0.01), i * 0.01 + 0.001)
        return [ages.age(1, source.stamp(t), t + late.get(t, 0.001)) for t in times]

    def test_next_command_after_a_client_pause_is_obeyed(self) -> None:
        for drift in (-DRIFT, 0.0, DRIFT):
            (age,) = self.ages(Source(9.0, drift), [3600.0], {})
            assert age <= 1e-3

    def test_commands_sent_before_a_client_suspend_are_not_obeyed(self) -> None:
        """Its machine wakes up after an hour and sends what it still has, then goes on."""
        old = [1.0, 1.01, 1.02]
        new = every(0.01, 3600.0, 3601.0)
        ages = self.ages(Source(9.0), old + new, dict.fromkeys(old, 3599.0))
        assert ages[:3] == [math.inf] * 3
        assert [math.isfinite(age) for age in ages[3:]].index(True) in (20, 21)  # 0.2 s

    def test_client_with_a_changed_clock_is_obeyed_again(self) -> None:
        source = Source(9.0, jumps=((1800.0, -10.0),))
        ages = self.ages(source, every(0.01, 3600.0, 3601.0), {})
        assert ages[0] == math.inf
        assert ages[-1] < 0.01

    def test_baseline_is_confirmed_again_after_a_pause(self) -> None:
        ages, source = SampleAges(), Source(9.0)
        for i in range(100):
            ages.age(1, source.stamp(i * 0.01), i * 0.01)
        ages.resumed(2.0 + FORGET)
        at = 2.0 + FORGET + 2 * SETTLE
        assert ages.age(1, source.stamp(at), at) == math.inf
        assert ages.age(1, source.stamp(at + SETTLE), at + SETTLE) < 0.01


def test_old_writers_are_forgotten() -> None:
    ages = SampleAges()
    for number in range(10_000):
        ages.age(number, Source().stamp(1.0), 1.0)
    assert len(ages._writers) <= 64
