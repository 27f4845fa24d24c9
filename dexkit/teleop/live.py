"""The teleoperation client on DDS, against any hand that is served there.

It takes the genuine client's place: its quality of service, its rate (each period's rest is slept,
so the mean is some 2 % below the nominal one), its order of reading and writing. It differs where
the genuine one would be a nuisance: it waits until the hand listens before its first command, and
it leaves the hand at rest (:meth:`LiveClient.leave`).

It differs after a pause of its own, too (stopped, suspended, starved; more than
:data:`~dexkit.command_age.PAUSE`). The genuine client would go on by what it last read, or by where
the operator is by now. This one sends nothing until each hand has published its position *now*,
forgets what it smoothed, and lets the operator go on where he was. After a pause of more than
:data:`~dexkit.command_age.LONG_PAUSE` it does so only with leave.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from dexkit.clock import RealClock
from dexkit.command_age import LONG_PAUSE, PAUSE, SETTLE, PauseWatch
from dexkit.dds import DdsNode, Qos
from dexkit.errors import WireError
from dexkit.hand import Floats, Side
from dexkit.models import Dialect, model
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.teleop.client import JointCommand, Pose, TeleopClient
from dexkit.teleop.client_codec import ClientCodec
from dexkit.teleop.profiles import Operator
from dexkit.teleop.tracking import TrackingFigures, tracking_figures

__all__ = ["LiveClient", "TeleopSession"]

_LEAVING = 0.25  # seconds of commands to stay where it is, at the end
_NAP = 0.1


@dataclass
class TeleopSession:
    """Commands and states of a session, in seconds from the operator's start, without pauses.

    :ivar pauses: when the client was paused, and for how many seconds.
    """

    sides: tuple[Side, ...]
    pauses: list[tuple[float, float]] = field(default_factory=list)
    commands: dict[Side, list[tuple[float, Pose]]] = field(default_factory=dict)
    states: dict[Side, list[tuple[float, Pose]]] = field(default_factory=dict)

    def note(
        self, kind: dict[Side, list[tuple[float, Pose]]], at: float, poses: Mapping[Side, Pose]
    ) -> None:
        """Record poses of one time."""
        for side, pose in poses.items():
            kind.setdefault(side, []).append((at, pose))

    @property
    def duration(self) -> float:
        """Seconds from the first command to the last."""
        times = [t for rows in self.commands.values() for t, _ in (rows[:1] + rows[-1:])]
        return max(times) - min(times) if times else 0.0

    def command_rate(self, side: Side) -> float:
        """Hz of the client, 0 without commands."""
        rows = self.commands.get(side, [])
        return (len(rows) - 1) / (rows[-1][0] - rows[0][0]) if len(rows) > 1 else 0.0

    def tracking(self, operator: Operator, side: Side) -> dict[int, TrackingFigures]:
        """The figures of each joint that the operator moves."""
        rows = self.states.get(side, [])
        if len(rows) < 2:
            return {}
        t: Floats = np.array([at for at, _ in rows])
        q: Floats = np.array([pose for _, pose in rows])
        spoken = operator.dialect
        found = {}
        for i, joint in enumerate(model(spoken.model).joints[side]):
            stroke = spoken.q_open if spoken.is_gripper else joint.stroke
            figures = tracking_figures(
                t,
                q[:, i],
                lambda at, i=i: _joint_value(operator.intent(at, side), i),  # type: ignore[misc]
                stroke,
            )
            if figures.figures():
                found[i] = figures
        return found


def _joint_value(pose: Pose | None, joint: int) -> float | None:
    return None if pose is None else pose[joint]


class LiveClient:
    """A client's endpoints on a node, and its loops.

    :param client: fresh, for the sides that it is to drive.
    :param force: command beside others. Two clients on one hand would alternate, and a real one may
        carry something: this one gives way to other clients.
    :param resume: called after a pause of this program that was longer than
        :data:`~dexkit.command_age.LONG_PAUSE`, with its seconds; returns whether to move the hands
        on. By default they are not.
    :raises TopicConflict: another program commands one of these hands. So do :meth:`wait_ready` and
        :meth:`perform`, when one starts to.
    """

    def __init__(
        self,
        node: DdsNode,
        client: TeleopClient,
        *,
        force: bool = False,
        resume: Callable[[float], bool] = lambda seconds: False,
    ) -> None:
        self._node = node
        self._resume = resume
        self._stale = False
        """The states are from before a pause."""
        self._client = client
        self._wire = ClientCodec(client.dialect)
        self._arrived = threading.Event()
        self._watch = PauseWatch(RealClock())
        dialect: Dialect = client.dialect
        commands = dict.fromkeys(self._wire.command_topics[s] for s in client.sides)
        states = dict.fromkeys(self._wire.state_topics[s] for s in client.sides)
        self._sole = SolePublisher(
            [NodeTopics(node, commands)],
            verb="commands",
            hint="stop that client, choose another --domain, or go on with --force",
            force=force,
            yields=True,
        )
        self._sole.search()
        claim = self._sole.announce()
        self._writers = {
            topic: node.writer(topic, dialect.cmd_type, qos=Qos.writer_default(), user_data=claim)
            for topic in commands
        }
        self._sole.settle(self._arrived.set)
        self._readers = {
            topic: node.reader(
                topic, dialect.state_type, qos=Qos.reader_default(), on_data=self._arrived.set
            )
            for topic in states
        }

    def wait_ready(
        self, stop: threading.Event, report: Callable[[Mapping[Side, str], float], object]
    ) -> bool:
        """Wait until the client has the states that it wants, and the hands listen.

        :param report: called once a second with what is missing by side, and for how long.
        :returns: False when it was stopped, or paused for long without leave to go on.
        """
        begin = time.monotonic()
        reported = 0.0
        while not stop.is_set():
            if away := self._watch.measure_pause():
                if not self._may_go_on(away):
                    return False
                self._restart_after_pause(stop)
            now = time.monotonic()
            self._sole.poll()
            self._read(now)
            if self._client.ready and all(w.matched for w in self._writers.values()):
                return True
            if now - reported >= 1.0:
                reported = now
                report(self._missing(), now - begin)
            self._arrived.wait(_NAP)
            self._arrived.clear()
        return False

    def _missing(self) -> dict[Side, str]:
        found = self._client.missing
        for side in self._client.sides:
            if side not in found and not self._writers[self._wire.command_topics[side]].matched:
                found[side] = "no process reads commands"
        return found

    def perform(
        self,
        operator: Operator,
        duration: float,
        stop: threading.Event,
        progress: Callable[[float, TeleopSession], object] = lambda seconds, session: None,
    ) -> TeleopSession:
        """Run the operator's motion for some seconds, or until stopped.

        After a pause of this program it continues where it was, or ends without leave to go on.

        :param progress: called about twice a second.
        """
        session = TeleopSession(self._client.sides)
        period = self._client.period
        start = reported = seen = time.monotonic()
        while not stop.is_set():
            away = self._watch.measure_pause()
            if away:
                session.pauses.append((seen - start, away))
                if not self._may_go_on(away):
                    break
                self._restart_after_pause(stop)
                start += time.monotonic() - seen
                seen = time.monotonic()
                continue
            now = seen = time.monotonic()
            if now - start >= duration:
                break
            self._sole.poll()
            session.note(session.states, now - start, self._read(now))
            inputs = operator.inputs(now - start, self._client.sides)
            commands = self._client.step(now, {}, inputs)
            if self._watch.away() > PAUSE:  # they were made before a pause
                continue
            self._send(commands)
            session.note(
                session.commands,
                now - start,
                {s: tuple(m.q for m in motors) for s, motors in commands.items()},
            )
            if now - reported >= 0.5:
                reported = now
                progress(now - start, session)
            self._sleep(now + period, start, session)
        return session

    def _may_go_on(self, away: float) -> bool:
        """Whether to move the hands on after a pause."""
        self._stale = not (away <= LONG_PAUSE or self._resume(away))
        return not self._stale

    def _restart_after_pause(self, stop: threading.Event) -> None:
        """After a pause: drop queued states, then wait for a state of each hand."""
        stop.wait(SETTLE)  # for queued states, and for other clients that started meanwhile
        self._sole.poll()
        for reader in self._readers.values():
            reader.take()
        self._client.begin_again()
        while not (stop.is_set() or self._client.ready):
            self._sole.poll()
            self._arrived.wait(_NAP)
            self._arrived.clear()
            self._read(time.monotonic())
        self._watch.restart()

    def leave(self) -> None:
        """Leave the hands at rest, which the genuine client does not do.

        The genuine one just stops sending. A Dex1-1's service then brakes within a second; a
        Dex3-1 keeps its last position for ever. Here each hand is commanded for a quarter of a
        second to stay where it is, with its motors locked where the dialect has a mode byte (status
        0).
        """
        if self._stale or self._watch.away() > PAUSE:  # the hands may be elsewhere by now
            time.sleep(SETTLE)
            for reader in self._readers.values():
                reader.take()
            self._client.begin_again()
            time.sleep(SETTLE)
            self._read(time.monotonic())
        if self._sole.lost:  # another program commands them now
            return
        poses = self._client.receiver.seen
        stay = {
            s: self._client.final_command(q) for s, q in poses.items() if s in self._client.sides
        }
        self._watch.restart()
        end = time.monotonic() + _LEAVING
        while stay and time.monotonic() < end and not self._watch.measure_pause():
            self._send(stay)
            time.sleep(self._client.period)

    def _send(self, commands: Mapping[Side, Sequence[JointCommand]]) -> None:
        now_ns = time.time_ns()  # a command that a stop holds back here is old, and is seen to be
        for topic, payload in self._wire.encode(commands):
            self._writers[topic].write_raw(payload, now_ns)

    def _read(self, now: float) -> dict[Side, Pose]:
        """Read the states, and hand them to the client."""
        found: dict[Side, Pose] = {}
        for topic, reader in self._readers.items():
            for sample in reader.take()[-1:]:
                with contextlib.suppress(WireError):
                    states = self._wire.positions(topic, sample.data)
                    self._client.receive(now, states)
                    found.update((s, q) for s, q in states.items() if s in self._client.sides)
        return found

    def _sleep(self, until: float, start: float, session: TeleopSession) -> None:
        """Sleep until the next turn, while the receiving thread does its work."""
        while True:
            now = time.monotonic()
            left = until - now
            if left <= 0:
                return
            pause = self._client.receiver.wakes_at - now
            if pause > 0:
                time.sleep(min(pause, left))
            elif self._arrived.wait(left):
                self._arrived.clear()
            else:
                return
            now = time.monotonic()
            session.note(session.states, now - start, self._read(now))
