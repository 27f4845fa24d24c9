"""Run a :class:`ReplayMachine` on DDS: endpoints and loop."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from dexkit.clock import RealClock, wait_until
from dexkit.command_age import LONG_PAUSE, PAUSE, PauseWatch
from dexkit.errors import TopicConflict, WireError
from dexkit.models import DIALECTS
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.teleop.client_codec import ClientCodec
from dexkit.traces.player import SPIN
from dexkit.traces.replay.machine import Commands, End, Phase, ReplayMachine
from dexkit.traces.replay.states import HandStateCodec

if TYPE_CHECKING:
    import threading

    from dexkit.dds import DdsNode

__all__ = ["LiveReplay"]

_NAP = 0.05


def _refuse(seconds: float) -> bool:
    return False


class LiveReplay:
    """A machine's endpoints on a node, and its loop.

    :param force: command although other clients do. By default the replay stops if another client
        commands the hands.
    :param resume: called after a pause of this program that was longer than
        :data:`~dexkit.command_age.LONG_PAUSE`, with its seconds; returns whether to move the hands
        on. By default they are not.
    :raises TopicConflict: another program commands one of the hands. So does :meth:`play`, when one
        starts to.
    """

    def __init__(
        self,
        node: DdsNode,
        machine: ReplayMachine,
        *,
        force: bool = False,
        resume: Callable[[float], bool] = _refuse,
    ) -> None:
        from dexkit.dds import Qos

        self.node, self.machine = node, machine
        plan = machine.plan
        self._resume = resume
        self._encode = ClientCodec(plan.dialect)
        self._states = HandStateCodec(plan.dialect)
        self.command_topics = tuple(
            dict.fromkeys(self._encode.command_topics[s] for s in plan.sides)
        )
        self._watch = PauseWatch(RealClock())
        self._sole = SolePublisher(
            [NodeTopics(node, self.command_topics)],
            verb="commands",
            hint="stop that client, choose another --domain, or go on with --force",
            force=force,
            yields=True,
        )
        self._sole.search()
        claim = self._sole.announce()
        self._writers = {
            topic: node.writer(
                topic, plan.dialect.cmd_type, qos=Qos.writer_default(), user_data=claim
            )
            for topic in self.command_topics
        }
        self._sole.settle()
        self._readers = {
            topic: node.reader(topic, plan.dialect.state_type, qos=Qos.reader_default())
            for topic in dict.fromkeys(self._states.topics[s] for s in plan.sides)
        }

    @property
    def unsubscribed(self) -> list[str]:
        """Command topics without a reader."""
        return [topic for topic, writer in self._writers.items() if not writer.matched]

    def advice(self) -> str:
        """Advice if no hand is found."""
        seen = {(e.topic, e.type_name) for e in self.node.endpoints() if e.kind == "writer"}
        spoken = self.machine.plan.dialect
        for d in DIALECTS.values():
            sides = [
                s for s, topic in HandStateCodec(d).topics.items() if (topic, d.state_type) in seen
            ]
            if sides and d == spoken:
                there = " and ".join(map(str, sides))
                return f"there is the {there} hand: --side, --set swap-sides=yes"
            if sides:
                same = d.model == spoken.model
                return f"there is a hand of the dialect {d.name}" + (
                    f": --dialect {d.name}" if same else f", which is a {d.model}"
                )
        return (
            "start the hand first ('dexkit serve'), check --domain and --interface; "
            "'dexkit publish' publishes without a hand"
        )

    def wait_ready(
        self, stop: threading.Event, waiting: Callable[[float], object] = lambda seconds: None
    ) -> bool:
        """Wait until the hands have a command reader and have published their state.

        :param waiting: called every 50 ms with the seconds so far; may raise.
        :returns: False when it was stopped, or paused for long without leave to go on.
        """
        begin = time.monotonic()
        while not stop.is_set():
            if (away := self._watch.measure_pause()) and not self._may_go_on(away):
                return False
            self._sole.poll()
            self._read()
            if not self.unsubscribed and not self.machine.missing:
                return True
            waiting(time.monotonic() - begin)
            stop.wait(_NAP)
        return False

    def play(self, turn: Callable[[ReplayMachine], object] = lambda machine: None) -> None:
        """Play until the machine's end.

        :param turn: called in every cycle; it may stop the machine, and must not block. If it
            raises, the hands are brought to rest first.
        """
        try:
            self._run(turn)
        except TopicConflict as conflict:
            self.machine.abandon(End.ASKED, conflict.message)
            raise
        except BaseException:
            self._resume = _refuse
            self.machine.stop(End.ASKED, "this program failed")
            self._run(lambda machine: None)
            raise

    def _may_go_on(self, away: float) -> bool:
        """Start over after a pause: no state from before counts. Whether to move the hands on."""
        allowed = away <= LONG_PAUSE or self.machine.end is not None or self._resume(away)
        self._watch.restart()
        for reader in self._readers.values():
            reader.take()
        self.machine.pause(time.monotonic())
        return allowed

    def _run(self, turn: Callable[[ReplayMachine], object]) -> None:
        machine, clock = self.machine, RealClock()
        while machine.phase is not Phase.END:
            if (away := self._watch.measure_pause()) and not self._may_go_on(away):
                turn(machine)  # a stop that was asked for comes first
                machine.stop(End.SUSPENDED, f"this program was suspended for {away:.1f} s")
            turn(machine)
            self._sole.poll()
            self._read()
            commands = machine.step(clock.now())
            if self._watch.away() <= PAUSE:  # otherwise they date from before a pause
                self._send(commands)
            now = clock.now()
            wait_until(clock, machine.wakes_at(now), spin=SPIN)

    def _send(self, commands: Commands) -> None:
        # timestamp first: a command delayed here by a stopped process is then recognised as stale
        now_ns = time.time_ns()
        for topic, payload in self._encode.encode(commands):
            self._writers[topic].write_raw(payload, now_ns)

    def _read(self) -> None:
        now = time.monotonic()
        for topic, reader in self._readers.items():
            for sample in reader.take()[-1:]:
                with contextlib.suppress(WireError):
                    for side, seen in self._states.seen(topic, sample.data).items():
                        self.machine.receive(now, side, seen)
