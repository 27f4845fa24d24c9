"""Do a live run: start the backend, play the stimulus script on DDS, record all topics.

The kit creates three DDS participants: the commanding client, the recorder, and later a monitor
that joins during the run. A fourth one sends the messages of the calibration, and leaves before
the first command.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dexkit.clock import RealClock
from dexkit.command_age import PauseWatch
from dexkit.conformance.kit.backend_processes import Rig, RigOptions
from dexkit.conformance.kit.calibration import POLL, Loopback
from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.heartbeat import Heartbeat
from dexkit.conformance.kit.known_backends import EXTERNAL
from dexkit.conformance.kit.motor_messages import MotorCodec
from dexkit.conformance.kit.phased_script import play
from dexkit.conformance.kit.requirements import Requirement
from dexkit.conformance.kit.robot import codec_for
from dexkit.conformance.kit.run_queue import RunQueue, Watched
from dexkit.conformance.kit.run_record import RECORD as RUN
from dexkit.conformance.kit.run_record import run_record
from dexkit.conformance.kit.stimulus_record import RECORD, Stimulus
from dexkit.conformance.kit.suspension import sleep_awake
from dexkit.conformance.stimuli import (
    Action,
    CommandSession,
    Join,
    Leave,
    Observation,
    Plan,
    Restart,
    Role,
    Script,
    Send,
    StartService,
    StopService,
    script_for,
)
from dexkit.conformance.stimuli.script import Pose, object_places
from dexkit.dds import DdsNode, Qos, Reader, Writer
from dexkit.errors import ConformanceError, WireError
from dexkit.hand import Side, Subject
from dexkit.interpreter import timely_threads
from dexkit.models import DIALECTS
from dexkit.service.realtime import real_time
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.traces.dds_recording import DdsRecording
from dexkit.traces.recorder import Recorder

__all__ = ["LiveOptions", "record_run"]

TOOLS = "dexkit.tools"
"""Metadata record with the last lines that each process of the run printed."""
DISCOVERY_TIMEOUT = 5.0
GONE_TIMEOUT = 3.0
"""Seconds that the publishers of a service that has ended are given to vanish."""


@dataclass(frozen=True)
class LiveOptions:
    """A live run.

    :param phases: of the stimulus.
    :param force: go on although somebody else commands the hand.
    :param usb: play the USB script at the devices first, before a service takes them.
    :param rounds: of the stimulus; see :class:`~dexkit.conformance.stimuli.Plan`.
    :param requirements: those that the run is judged by, for the run record.
    :param claims: likewise.
    """

    rig: RigOptions
    phases: frozenset[str]
    session: CommandSession | None = None
    force: bool = False
    usb: bool = False
    rounds: int = 1
    requirements: tuple[Requirement, ...] = ()
    claims: Claims = field(default_factory=Claims)

    def plan(self) -> Plan[Subject]:
        """The plan of the stimulus script."""
        dialect = self.rig.dialect
        return Plan(
            dialect=dialect,
            sides=self.rig.sides,
            objects=object_places(dialect, self.rig.objects),
            session=self.session,
            phases=self.phases,
            rounds=self.rounds,
        )


def record_run(
    options: LiveOptions,
    path: Path,
    *,
    report: Callable[[str], None] = lambda text: None,
    stop: threading.Event | None = None,
) -> bool:
    """Do the run and write its recording to ``path``.

    :param report: called with progress messages for the user.
    :param stop: ends the run early when set; what was recorded is kept.
    :returns: False when it was ended early.
    :raises ConformanceError: the hand's process cannot be started, or has died.
    :raises TopicConflict: somebody else commands this hand, or begins to.
    """
    rig_options = options.rig
    stop = stop or threading.Event()
    with contextlib.ExitStack() as stack:
        # a pause of the kit in the reading of states would look like one of the hand
        stack.enter_context(timely_threads())
        # a service that has real-time priority would starve an ordinary process
        stack.enter_context(real_time())
        recorder_node = stack.enter_context(_node(rig_options))
        recorder = stack.enter_context(
            Recorder(path, overwrite=True, metadata={"conformance": rig_options.backend})
        )
        dialect = rig_options.dialect
        topics = {
            t
            for s in Side
            for t in (
                *dialect.topics(s),
                dialect.low_rate_topic.format(side=s),
                dialect.touch_topic_of(s),
            )
            if t
        }
        # the recorder starts before the backend, so that it records the hand's first samples
        heart = Heartbeat()
        recording = stack.enter_context(
            DdsRecording(
                recorder_node,
                recorder,
                sorted(topics),
                poll=POLL,
                on_late=heart.note_late,
                # a backend of the kit's own starts later, on a domain that is free until then
                fresh=rig_options.backend != EXTERNAL,
            )
        )
        if rig_options.backend != EXTERNAL:
            report(f"starting {rig_options.backend} on domain {rig_options.domain}")
        rig = stack.enter_context(Rig(rig_options, stop))
        if options.usb and not _judge_usb(rig, recorder, report, stop):
            return False
        # before the services: a busy machine shows in their first states already
        stack.enter_context(heart)
        queue = stack.enter_context(RunQueue(lambda: _processes(rig, recorder_node)))
        rig.start_services()
        if rig_options.backend == EXTERNAL and not stop.is_set():
            _require_hand(recorder_node, options)
        # a second client would interfere, and a real hand may hold something
        sole = SolePublisher(
            [NodeTopics(recorder_node, {dialect.topics(s)[0] for s in rig_options.sides})],
            hint="stop that client, or choose another --domain",
            force=options.force,
            yields=True,
        )
        sole.search()
        # while the services start
        about = run_record(
            subject=rig_options.subject,
            dialect=dialect.name,
            sides=rig_options.sides,
            phases=options.phases,
            rounds=options.rounds,
            requirements=options.requirements,
            claims=options.claims,
        )
        recorder.add_metadata(RUN, about)
        rig.wait_ready()
        if stop.is_set():
            return False
        loopback = stack.enter_context(
            Loopback(recorder_node, domain=rig_options.domain, interface=rig_options.interface)
        )
        plan = options.plan()
        script = script_for(plan, report)
        player = stack.enter_context(_LivePlayer(rig, plan, sole))
        sole.settle()
        _wait_for_endpoints(recorder_node, plan)
        # the calibration goes on while the script listens
        finished = player.play_script(script, stop)
        recording.stop()
        player.close()
        queue.stop()
        rig.stop()
        # last output of the services and emulated devices, with their counters
        recorder.add_metadata(TOOLS, {repr(tool): tool.last_lines for tool in rig.tools})
        stimulus = Stimulus(
            phases=[p for p in script.phases if p.end_ns],
            objects={s: plan.objects.get(s) for s in plan.sides},
            stalls=heart.stalls,
            beats=heart.beats,
            calibration=loopback.result(),
            waits=queue.waits,
        )
        recorder.add_metadata(RECORD, stimulus.to_metadata())
    return finished


def _judge_usb(
    rig: Rig, recorder: Recorder, report: Callable[[str], None], stop: threading.Event
) -> bool:
    """Play the USB script, before a service opens the devices; False when it was stopped."""
    from dexkit.conformance.usb.run import run

    server = rig.options.usb_server
    devices = {
        side: f"{server}/{where}" if server and "://" not in where else where
        for side, where in rig.devices.items()
    }
    report(f"the {' and the '.join(map(str, devices))} hand on USB")
    return run(devices, recorder, report=report, stop=stop, processes=rig.watched)


def _node(options: RigOptions) -> DdsNode:
    return DdsNode(domain=options.domain, interface=options.interface)


def _processes(rig: Rig, node: DdsNode) -> list[Watched]:
    """The processes on this machine that the hands consist of.

    Those that the kit has started; of an external hand those that publish its state.
    """
    if rig.options.backend != EXTERNAL:
        return rig.watched()
    dialect, sides = rig.options.dialect, rig.options.sides
    host = socket.gethostname()
    here = {
        p.key: p for p in node.discovery.participants() if p.pid and p.host == host and not p.own
    }
    subjects: dict[int, set[Subject]] = {}
    for endpoint in node.endpoints():
        if endpoint.kind == "writer" and endpoint.participant in here:
            found = subjects.setdefault(here[endpoint.participant].pid, set())
            found.update(s for s in sides if dialect.topics(s)[1] == endpoint.topic)
    return [
        Watched("the service", pid, tuple(s for s in sides if s in whose))
        for pid, whose in subjects.items()
        if whose
    ]


def _require_hand(node: DdsNode, options: LiveOptions) -> None:
    """Refuse a run without a hand: all its failures would have that one cause.

    :raises ConformanceError: no endpoint of another program is on the hand's topics.
    """
    rig = options.rig
    topics = {t for s in rig.sides for t in rig.dialect.topics(s)}
    if node.discovery.wait(
        lambda endpoints: any(e.topic in topics and not e.own for e in endpoints),
        timeout=DISCOVERY_TIMEOUT,
    ):
        return
    from dexkit.doctor.hand_domains import elsewhere_hint

    states = ", ".join(rig.dialect.topics(s)[1] for s in rig.sides)
    others = sorted({e.topic for e in node.endpoints() if not e.own and e.topic.startswith("rt/")})
    speaks = [d.name for d in DIALECTS.values() if any(d.topics(s)[1] in others for s in Side)]
    raise ConformanceError(
        f"no hand on domain {rig.domain}: no program publishes {states} or subscribes to the "
        "commands",
        hint=f"there is {', '.join(others)}"
        + (f": --dialect {' or '.join(speaks)}" if speaks else "")
        if others
        else elsewhere_hint(node)
        or f"is it served on this domain, and on the interface {rig.interface}? 0 is the robot's "
        "domain, 1 that of simulated hands; 'dexkit doctor' examines the network",
    )


def _wait_for_endpoints(node: DdsNode, plan: Plan[Subject]) -> None:
    """Wait until the hands' endpoints are discovered; a check reports missing ones."""
    wanted = {t for s in plan.sides for t in plan.dialect.topics(s)}
    node.discovery.wait(
        lambda endpoints: wanted <= {e.topic for e in endpoints if not e.own},
        timeout=DISCOVERY_TIMEOUT,
    )


@dataclass
class _LivePlayer:
    """Carries out the script's actions on DDS."""

    rig: Rig
    plan: Plan[Subject]
    sole: SolePublisher
    _newest: dict[str, bytes] = field(default_factory=dict)
    _others: dict[Role, _Client | _Monitor] = field(default_factory=dict)
    _stopped: dict[str, float | None] = field(default_factory=dict)

    def __enter__(self) -> _LivePlayer:
        self._codec = codec_for(self.plan.dialect)
        self._clock = RealClock()
        self._watch = PauseWatch(self._clock)
        # log times are wall clock; the offset to the monotonic clock is constant during a run
        self._offset = time.time_ns() - round(self._clock.now() * 1e9)
        self._client: _Client | None = self._new_client()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the domain. May be called twice."""
        for part in (self._client, *self._others.values()):
            if part is not None:
                part.close()
        self._client = None
        self._others.clear()

    @property
    def now_ns(self) -> int:
        """The present log time."""
        return round(self._clock.now() * 1e9) + self._offset

    def play_script(self, script: Script[Subject], stop: threading.Event) -> bool:
        """Run the script; False when it was stopped."""
        return play(script, self._carry_out, stop.is_set)

    def _carry_out(self, action: Action) -> Observation:
        self.sole.poll()
        self._do(action)
        dead = self.rig.dead()
        if dead is not None:
            raise ConformanceError(f"{dead!r} has ended", hint=dead.last_lines)
        return self._observe()

    def _do(self, action: Action) -> None:
        if isinstance(action, Send):
            self._send(action)
        elif isinstance(action, Join):
            self._others[action.role] = self._create_participant(action.role)
        elif isinstance(action, Leave):
            self._others.pop(action.role).close()
        elif isinstance(action, Restart):
            assert self._client is not None
            self._client.close()
            self._client = None
            time.sleep(0.1)  # a real restart takes longer; the hand must see the old writer leave
            self._client = self._new_client()
            self._client.wait_matched(1.0)
        elif isinstance(action, StopService):
            self._stop_service()
        elif isinstance(action, StartService):
            self._newest.clear()
            self.rig.start_services()
            self.rig.wait_ready()

    def _send(self, action: Send) -> None:
        sender = self._client if action.by is None else self._others[action.by]
        assert isinstance(sender, _Client)
        stamp = None if not action.age_s else time.time_ns() - round(action.age_s * 1e9)
        # after a pause of the kit's own process the command would be stale
        if not self._watch.measure_pause():
            for topic, payload in action.payloads:
                sender.send(topic, payload, stamp)
        sleep_awake(self._clock, (action.until_ns - self._offset) / 1e9)

    def _new_client(self, type_name: str | None = None) -> _Client:
        claim = self.sole.announce()
        return _Client(self.rig.options, self._codec, self.plan.sides, claim, type_name)

    def _create_participant(self, role: Role) -> _Client | _Monitor:
        if role is Role.RIVAL:
            rival = self._new_client()
            rival.wait_matched(1.0)
            return rival
        if role is Role.STRANGER:
            return self._new_client(self._codec.foreign.name)
        qos = Qos("reliable", depth=None) if role is Role.LAGGARD else Qos.reader_default()
        return _Monitor(self.rig.options, self._codec, self.plan.sides, qos)

    def _stop_service(self) -> None:
        """End the services; measure the time until they have exited and their writers are gone."""
        assert self._client is not None
        begin = time.monotonic()
        polite = self.rig.end_services()
        if polite is None:
            return
        ended = time.monotonic()
        gone = self._client.wait_alone(GONE_TIMEOUT)
        self._stopped = {
            "exit_s": ended - begin if polite else None,
            "gone_s": time.monotonic() - ended if gone else None,
        }

    def _observe(self) -> Observation:
        q: dict[Subject, Pose] = {}
        dq: dict[Subject, Pose] = {}
        if self._client is not None:
            self._newest.update(self._client.newest())
        for side in self.plan.sides:
            payload = self._newest.get(self._codec.state_topics[side])
            if payload is None:
                continue
            with contextlib.suppress(WireError):
                state = self._codec.read_state(payload, side)
                if state is not None:
                    q[side], dq[side] = state
        joined: dict[Subject, float] = {}
        for role, other in self._others.items():
            if isinstance(other, _Monitor):
                if role is Role.MONITOR:
                    joined = other.first_states()
                else:
                    other.read_slowly()
        machine = self._codec.machine
        self._watch.restart()
        return Observation(self.now_ns, q, dq, joined, self._stopped, machine)


class _Client:
    """The commanding client, with the official clients' QoS.

    :param claim: the publisher claim that all clients of one run announce.
    :param type_name: another type for its commands, in the role of a stranger.
    """

    def __init__(
        self,
        rig: RigOptions,
        codec: MotorCodec,
        sides: tuple[Subject, ...],
        claim: bytes,
        type_name: str | None = None,
    ) -> None:
        self._node = _node(rig)
        commands = {codec.command_topics[s] for s in sides}
        states = {codec.state_topics[s] for s in sides} if type_name is None else set()
        self._states = states
        kind = type_name or codec.command
        self._writers: dict[str, Writer] = {
            t: self._node.writer(t, kind, qos=Qos.writer_default(), user_data=claim)
            for t in commands
        }
        self._readers: dict[str, Reader] = {
            t: self._node.reader(t, codec.state, qos=Qos.reader_default(), polled=True)
            for t in states
        }

    def send(self, topic: str, payload: bytes, stamp_ns: int | None = None) -> None:
        """Publish a command; ``stamp_ns`` is its source timestamp, by default now."""
        self._writers[topic].write_raw(payload, stamp_ns)

    def wait_matched(self, timeout: float) -> None:
        """Wait until readers of the hands are matched with this client's writers."""
        end = time.monotonic() + timeout
        for writer in self._writers.values():
            writer.wait_matched(max(0.0, end - time.monotonic()))

    def wait_alone(self, timeout: float) -> bool:
        """Wait until no participant publishes state any more; False when one still does."""
        return self._node.discovery.wait(
            lambda endpoints: (
                not any(e.kind == "writer" and e.topic in self._states for e in endpoints)
            ),
            timeout=timeout,
        )

    def newest(self) -> Mapping[str, bytes]:
        """The newest state on each topic that has got a new one."""
        found: dict[str, bytes] = {}
        for topic, reader in self._readers.items():
            samples = reader.take()
            if samples:
                found[topic] = samples[-1].data
        return found

    def close(self) -> None:
        """Leave the domain."""
        self._node.close()


class _Monitor:
    """A second participant that reads states: the late joiner, or a slow reader."""

    def __init__(
        self, rig: RigOptions, codec: MotorCodec, sides: tuple[Subject, ...], qos: Qos
    ) -> None:
        self._node = _node(rig)
        self._sides = sides
        self._codec = codec
        self._readers = {
            t: self._node.reader(t, codec.state, qos=qos, polled=True)
            for t in {codec.state_topics[s] for s in sides}
        }
        self._begin = time.monotonic()
        self._matched: dict[str, float] = {}
        self._first: dict[str, float] = {}
        self._last_read = self._begin

    def read_slowly(self) -> None:
        """Take the samples, at most twice a second."""
        if time.monotonic() - self._last_read >= 0.5:
            self._last_read = time.monotonic()
            for reader in self._readers.values():
                reader.take()

    def first_states(self) -> dict[Subject, float]:
        """Seconds from being matched to the first state, for the sides that have sent one."""
        now = time.monotonic()
        for topic, reader in self._readers.items():
            if topic not in self._matched and reader.matched:
                self._matched[topic] = now
            if topic not in self._first and reader.take():
                self._first[topic] = now - self._matched.get(topic, now)
        return {
            s: self._first[self._codec.state_topics[s]]
            for s in self._sides
            if self._codec.state_topics[s] in self._first
        }

    def close(self) -> None:
        """Leave the domain."""
        self._node.close()
