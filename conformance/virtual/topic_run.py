"""Play a script to a service in memory, on a virtual clock: a conformance run without DDS."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.phased_script import play
from dexkit.conformance.kit.robot import codec_for
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.conformance.stimuli import (
    Action,
    Join,
    Leave,
    Observation,
    Plan,
    Restart,
    Role,
    Send,
    StartService,
    StopService,
    script_for,
)
from dexkit.conformance.stimuli.script import Pose
from dexkit.conformance.virtual.memory_trace import MemoryTrace
from dexkit.conformance.virtual.service import Sample, TopicDevice
from dexkit.hand import Subject

__all__ = ["ORIGIN_NS", "log_time_ns", "run_virtual"]

ORIGIN_NS = 1_700_000_000_000_000_000
"""The recording's clock when the virtual one is at 0."""
_STARTS_S = 2.0
"""Seconds that a service takes to start."""
_RIVAL = 1000
"""The second client's number."""


def log_time_ns(seconds: float) -> int:
    """A time of the virtual clock on the recording's."""
    return ORIGIN_NS + round(seconds * 1e9)


class _States:
    """Decodes states; the last one of each side once, however often it is asked for."""

    def __init__(self, codec: MotorCodec) -> None:
        self._codec = codec
        self._last: dict[Subject, tuple[bytes, tuple[Pose, Pose] | None]] = {}

    def read(self, payload: bytes, side: Subject) -> tuple[Pose, Pose] | None:
        """(q, dq) of a side's joints; None if the sequence is too short."""
        last = self._last.get(side)
        if last is None or last[0] is not payload:
            last = self._last[side] = payload, self._codec.read_state(payload, side)
        return last[1]


class _Poses(Mapping[Subject, Pose]):
    """The newest poses (0) or velocities (1) of all sides, decoded only when they are read."""

    def __init__(self, states: _States, newest: Mapping[Subject, bytes], which: int) -> None:
        self._states, self._newest, self._which = states, newest, which

    def _state(self, side: Subject) -> tuple[Pose, Pose] | None:
        return self._states.read(self._newest[side], side)

    def __getitem__(self, side: Subject) -> Pose:
        state = self._state(side)
        if state is None:
            raise KeyError(side)
        return state[self._which]

    def __iter__(self) -> Iterator[Subject]:
        return (s for s in self._newest if self._state(s) is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


class _Player:
    """Carries out a script's actions with a service in memory.

    :ivar now: s, of the virtual clock.
    """

    def __init__(self, plan: Plan[Subject], service_class: type[TopicDevice]) -> None:
        self.now = 0.0
        self._plan, self._service_class = plan, service_class
        self._service = service_class(plan.dialect, plan.sides, plan.objects)
        self.trace = MemoryTrace(endpoints=self._service.endpoints())
        self._codec = codec_for(plan.dialect)
        self._states = _States(self._codec)
        self._topics = {s: self._codec.state_topics[s] for s in plan.sides}
        self._sides: dict[str, list[Subject]] = {}
        for side, topic in self._topics.items():
            self._sides.setdefault(topic, []).append(side)
        self._newest: dict[str, bytes] = {}
        self._joined_at: float | None = None
        self._joined: dict[Subject, float] = {}
        self._stopped: dict[str, float | None] = {}
        self._clients = 0
        self._waited_ns = 0

    def carry_out(self, action: Action) -> Observation:
        """Carry out an action; the clock goes on by its duration."""
        if isinstance(action, Send):
            self._send(action)
            self._advance((action.until_ns - ORIGIN_NS) / 1e9)
            self._waited_ns = action.until_ns
        elif isinstance(action, (Join, Leave)):
            comes = isinstance(action, Join)
            if action.role is Role.MONITOR:
                self._joined_at = self.now if comes else None
            elif action.role is Role.LAGGARD:
                self._service.loaded = comes
        elif isinstance(action, Restart):
            self._clients += 1
            self._advance(self.now + 0.3)
        elif isinstance(action, StopService) and self._service.can_be_stopped:
            self.now += self._service.tick
            self._take(self._service.end())
            self._stopped = {"exit_s": self._service.exit_s, "gone_s": self._service.gone_s}
        elif isinstance(action, StartService):
            plan, before = self._plan, self._service
            # what the old service has left driven goes on meanwhile
            for _ in range(round(_STARTS_S / before.tick)):
                self.now += before.tick
                before.live(before.tick)
            self._service = self._service_class(plan.dialect, plan.sides, plan.objects)
            self._service.take_over(before)
            self._service.begin(self.now)
            self._newest.clear()
        return self._observe()

    def _advance(self, until: float) -> None:
        service, tick = self._service, self._service.tick
        while self.now + 1e-9 < until:
            self.now += tick
            if samples := service.advance(tick):
                self._take(samples)

    def _take(self, samples: Iterable[Sample]) -> None:
        """Record published states, and note the first one for a late reader."""
        now_ns = log_time_ns(self.now)
        log_ns, state_type = now_ns + 100_000, self._plan.dialect.state_type
        for sample in samples:
            topic, payload = sample.topic, sample.payload
            sent_ns = now_ns if sample.sent == self.now else log_time_ns(sample.sent)
            self.trace.put(topic, sample.type_name, log_ns, sent_ns, payload)
            sides = self._sides.get(topic)
            if not sides or sample.type_name != state_type:
                continue
            self._newest[topic] = payload
            if self._joined_at is not None and self._service.serves_late_readers:
                for side in sides:
                    self._joined.setdefault(side, self.now - self._joined_at)

    def _send(self, action: Send) -> None:
        self._service.stamp = self.now - action.age_s
        log_ns, sent_ns = log_time_ns(self.now) + 50_000, log_time_ns(self.now - action.age_s)
        for topic, payload in action.payloads:
            if action.by is Role.STRANGER:
                self._service.foreign(topic, self._codec.foreign.name, payload)
                continue
            self.trace.put(topic, self._plan.dialect.cmd_type, log_ns, sent_ns, payload)
            if self._service.matches_clients:
                client = _RIVAL if action.by is Role.RIVAL else self._clients
                self._service.receive(topic, payload, client)

    def _observe(self) -> Observation:
        newest = {s: self._newest[t] for s, t in self._topics.items() if t in self._newest}
        return Observation(
            # the clock may be a fraction of a nanosecond short of what was waited for
            max(log_time_ns(self.now), self._waited_ns),
            _Poses(self._states, newest, 0),
            _Poses(self._states, newest, 1),
            dict(self._joined),
            dict(self._stopped),
            self._codec.machine,
        )


def run_virtual(plan: Plan[Subject], service_class: type[TopicDevice]) -> MemoryTrace:
    """Play the plan's script to a service of that class; the recording."""
    player = _Player(plan, service_class)
    script = script_for(plan)
    play(script, player.carry_out)
    objects = {s: plan.objects.get(s) for s in plan.sides}
    stimulus = Stimulus(phases=script.phases, objects=objects, virtual=True)
    player.trace.metadata[RECORD] = stimulus.to_metadata()
    service_class.recorded(player.trace)
    return player.trace
