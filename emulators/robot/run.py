"""Run an emulated robot on Unitree's topics: state at a fixed rate, commands as they arrive.

with EmulatedRobot(G1, domain=1) as robot:   # a thread of this process
    ...
    robot.robot.position(18)

stop = threading.Event()
run_robot(H1, domain=1, stop=stop)           # in a thread or process of the caller's
"""

from __future__ import annotations

import logging
import threading
from collections import deque

from dexkit.clock import Clock, RealClock
from dexkit.command_age import PAUSE, PauseWatch, SampleAges
from dexkit.dds import DdsNode, Endpoint, Reader, Writer
from dexkit.emulators.robot import motion_switcher
from dexkit.emulators.robot.mechanics import RobotMechanics
from dexkit.emulators.robot.motion_switcher import MotionSwitcher
from dexkit.emulators.robot.settings import Settings
from dexkit.errors import DdsError, EmulatorError, TopicConflict, WireError
from dexkit.messages.unitree_api import Response_
from dexkit.robots import ROBOTS, RobotModel
from dexkit.service import Publisher
from dexkit.single_publisher import NodeTopics, SolePublisher

__all__ = ["EmulatedRobot", "run_robot"]

log = logging.getLogger("dexkit.robot")

_DEPTH = 4  # commands of each client that are kept between two states; only the newest counts
_REQUESTS = 16  # of each client kept from one state to the next
_RESPONSE_WAIT = 10.0  # seconds that a response waits for its client's reader to be discovered
_LIVENESS_PERIOD = 0.2  # seconds between checks that the thread is alive


class EmulatedRobot:
    """A robot in a thread of this process, on one domain.

    :param node: where its topics are; without one, it makes one on ``domain`` and ``interface``.
    :param publisher: runs the robot in its thread, at the model's state rate; without one, a thread
        of its own.
    :param force: start even if another program publishes the state.

    :ivar robot: the robot itself. It belongs to that thread: read it, and assign ``robot.remote``.
    :ivar switcher: its MotionSwitcher service, of that thread, too.

    Errors of clients are logged once each, as warnings of the logger ``dexkit.robot``, and counted
    in ``robot.counters``.
    """

    def __init__(
        self,
        model: RobotModel,
        *,
        node: DdsNode | None = None,
        domain: int = 1,
        interface: str = "lo",
        settings: Settings | None = None,
        publisher: Publisher | None = None,
        force: bool = False,
        clock: Clock | None = None,
    ) -> None:
        self.model = model
        self.domain = node.domain if node is not None else domain
        self.interface = node.interface if node is not None else interface
        self._clock: Clock = clock or RealClock()
        self.robot = RobotMechanics(model, settings, now=self._clock.now(), report=log.warning)
        self.switcher = MotionSwitcher()
        self._failure: Exception | None = None
        self.missed = 0
        self._node = node
        self._own_node: DdsNode | None = None
        self._publisher = publisher or Publisher(model.state_rate, self._clock)
        self._force = force
        self._ages = SampleAges()
        self._watch = PauseWatch(self._clock)
        self._sole: SolePublisher | None = None
        self._remote_every = round(model.state_rate / model.remote_rate)
        self._writer: Writer | None = None
        self._remote: Writer | None = None
        self._commands: Reader | None = None
        self._arm_commands: Reader | None = None
        self._requests: Reader | None = None
        self._responses: Writer | None = None
        self._unsent: deque[tuple[float, Response_]] = deque()

    @property
    def failure(self) -> Exception | None:
        """The error that ended it, or a thread that it needs; None while it runs."""
        node = self._node or self._own_node
        return self._failure or self._publisher.failure or (node.failure if node else None)

    @property
    def clients(self) -> int:
        """Readers of the state."""
        return self._writer.matched if self._writer is not None else 0

    @property
    def commanders(self) -> int:
        """Writers of the two command topics."""
        readers = (self._commands, self._arm_commands)
        return sum(reader.matched for reader in readers if reader is not None)

    def mismatches(self) -> list[str]:
        """Sentences about clients with another type on the same topic; they get no error."""
        node, model = self._node or self._own_node, self.model
        if node is None:
            return []
        ours = dict.fromkeys((model.cmd_topic, model.arm_topic), model.cmd_type)
        ours[model.state_topic] = model.state_type
        found = []
        for topic, kind in sorted({(e.topic, e.type_name) for e in node.endpoints() if not e.own}):
            if topic in ours and kind != ours[topic]:
                others = [b for b in ROBOTS.values() if kind in (b.cmd_type, b.state_type)]
                found.append(
                    f"{topic}: a peer uses {kind}, the {model.name} {ours[topic]}; they never match"
                    + "".join(f". Try dexkit emulate {b.name}" for b in others)
                )
        return found

    def start(self) -> EmulatedRobot:
        """Publish states and obey commands from now on.

        :raises TopicConflict: another program publishes the state (unless ``force``).
        :raises DdsError: the topics cannot be made.
        """
        if self._writer is not None:
            raise EmulatorError(f"this {self.model.name} has been started already")
        node = self._node
        if node is None:
            node = self._own_node = DdsNode(self.domain, self.interface)
        try:
            model = self.model
            sole = self._sole = SolePublisher(
                [NodeTopics(node, {model.state_topic}, self._is_of_another_robot)],
                hint="stop the other robot, choose another --domain, or add --force",
                force=self._force,
            )
            with node.reader(model.state_topic, model.state_type) as states:
                sole.search(lambda: model.state_topic if states.take() else "")
            claim = sole.announce()
            self._remote = node.writer(model.remote_topic, model.remote_type)
            self._writer = node.writer(model.state_topic, model.state_type, user_data=claim)
            sole.settle()
            self._arm_commands = node.reader(model.arm_topic, model.cmd_type, depth=_DEPTH)
            self._commands = node.reader(model.cmd_topic, model.cmd_type, depth=_DEPTH)
            self._responses = node.writer(
                motion_switcher.RESPONSE_TOPIC, motion_switcher.RESPONSE_TYPE
            )
            self._requests = node.reader(
                motion_switcher.REQUEST_TOPIC, motion_switcher.REQUEST_TYPE, depth=_REQUESTS
            )
            self._watch.restart()  # from here on commands may wait to be received
        except BaseException:
            self._close()
            raise
        self._publisher.add(self._tick)
        return self

    def stop(self) -> None:
        """Publish no more. May be called twice."""
        self._publisher.remove(self._tick)
        self._close()

    def __enter__(self) -> EmulatedRobot:
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def _close(self) -> None:
        if self._sole is not None:
            self._sole.close()
        readers = self._commands, self._arm_commands, self._requests
        for handle in (*readers, self._remote, self._responses, self._writer):
            if handle is not None:
                handle.close()
        self._commands = self._arm_commands = self._requests = None
        self._remote = self._responses = self._writer = None
        if self._own_node is not None:
            self._own_node.close()
            self._own_node = None

    def _is_of_another_robot(self, endpoint: Endpoint) -> bool:
        """Whether a writer of the state counts although no state of it has arrived: one of another
        type, which cannot arrive. Some clients have a state writer that they never use.
        """
        return endpoint.type_name != self.model.state_type

    def _tick(self, missed: int) -> None:
        if self.failure is not None:
            return
        try:
            if self._sole is not None:
                self._sole.poll()
            self._advance_robot(missed)
        except TopicConflict as error:
            self._failure = error
            log.error("%s; this %s ends", error, self.model.name)
        except Exception as error:  # the thread may be somebody else's as well
            self._failure = error
            log.error("the %s died: %s: %s", self.model.name, type(error).__name__, error)

    def _advance_robot(self, missed: int) -> None:
        robot, now = self.robot, self._clock.now()
        assert self._writer is not None
        assert self._remote is not None
        assert self._commands is not None
        assert self._arm_commands is not None
        self.missed += missed
        if self._watch.measure_pause(PAUSE + 1.0 / self._publisher.hz):
            self._ages.resumed(self._clock.since_boot())
            robot.paused()
        for reader, obey in (
            (self._commands, robot.command),
            (self._arm_commands, robot.arm_command),
        ):
            for sample in reader.take():
                received = self._clock.since_boot()
                age = self._ages.age(sample.writer, sample.source_timestamp_ns, received)
                if age > PAUSE:
                    robot.counters.stale += 1
                else:
                    obey(sample.data, now - age)
        robot.advance(now)
        self._writer.write_raw(robot.state(now))
        if robot.counters.states % self._remote_every == 0:
            self._remote.write(robot.remote_message())
        self._answer_requests(now)

    def _answer_requests(self, now: float) -> None:
        """Answer the MotionSwitcher's clients.

        A client writes its request as soon as its writer has found our reader. Its own reader may
        not have been discovered yet, and would miss a response that is written at once.
        """
        assert self._requests is not None
        assert self._responses is not None
        for sample in self._requests.take():
            try:
                response = self.switcher.answer(sample.message)
            except WireError as error:
                log.warning("%s: %s", motion_switcher.REQUEST_TOPIC, error)
                continue
            if response is not None:
                self._unsent.append((now, response))
        while self._unsent:
            since, response = self._unsent[0]
            complete = self._responses.matched >= max(1, self._requests.matched)
            if not complete and now - since < _RESPONSE_WAIT:
                return
            self._unsent.popleft()
            self._responses.write(response)


def run_robot(
    model: RobotModel,
    *,
    domain: int = 1,
    interface: str = "lo",
    stop: threading.Event,
    ready: threading.Event | None = None,
    settings: Settings | None = None,
    force: bool = False,
) -> None:
    """Run a robot until ``stop`` is set.

    :param ready: set when its topics are up.
    :raises TopicConflict: another program publishes the state (unless ``force``).
    :raises DdsError: the topics cannot be made, or writing to them failed.
    """
    with EmulatedRobot(
        model, domain=domain, interface=interface, settings=settings, force=force
    ) as robot:
        if ready is not None:
            ready.set()
        while not stop.wait(_LIVENESS_PERIOD):
            if isinstance(robot.failure, TopicConflict):
                raise robot.failure
            if robot.failure is not None:
                raise DdsError(f"the {model.name} failed: {robot.failure}") from robot.failure
