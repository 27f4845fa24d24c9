"""Serve a hand on DDS: threads and endpoints around :class:`~dexkit.service.hand_core.HandCore`.

Three activities, each with its own clock:

* *receive* waits for samples and hands the newest command to the core;
* *exchange*, one thread a hand, talks to the hand as fast as its ``io_rate`` allows, and opens
  it again with growing delays when it was lost;
* *publish* writes state at fixed deadlines, whatever the hand does meanwhile; one thread for all
  the services of a process (:class:`~dexkit.service.publisher.Publisher`).

All three share one interpreter lock, so the publishing thread does little: it writes bytes that
were encoded once for each new state.

Each of them detects its own pauses (:class:`~dexkit.command_age.PauseWatch`) and reports them to
the cores, which brake until a command comes that was sent later.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from dexkit.backoff import Backoff
from dexkit.clock import Clock, Rate, RealClock
from dexkit.command_age import PAUSE, PauseWatch, SampleAges
from dexkit.errors import (
    BackendBroken,
    DexkitError,
    HandError,
    TopicConflict,
    UsageError,
    WireError,
)
from dexkit.hand import Hand, HandCommand, HandSpec, Side
from dexkit.messages import message_type
from dexkit.models import Dialect, HandModel, model
from dexkit.models import dialect as dialect_by_name
from dexkit.service.counters import TopicCounters
from dexkit.service.dialects import Fill, StateView, dialect_map
from dexkit.service.hand_core import Estimation, HandCore
from dexkit.service.limp import LimpCommands
from dexkit.service.publisher import Publisher, align
from dexkit.single_publisher import NodeTopics, SolePublisher
from dexkit.threads import Worker

__all__ = ["HandService", "Node"]

log = logging.getLogger("dexkit.service")
_counters_log = logging.getLogger("dexkit.service.counters")

_CONFLICT_HINT = "stop the other service, choose another --domain, or add --force"
_JOIN = 2.0  # seconds that a stopping thread is given beyond the exchange time-out
# seconds between the last state and the end of its writer: a busy reader that discovers the end
# first drops the state, and goes on believing that the hand is driven
_LAST_STATE_DELAY = 0.05
_TICK = 0.05  # seconds after which the receiving thread looks at the clock when nothing comes


class _Writer(Protocol):
    @property
    def matched(self) -> int: ...
    def write_raw(self, data: bytes, source_timestamp_ns: int | None = None) -> bool: ...
    def close(self) -> None: ...


class _Reader(Protocol):
    def take(self) -> Sequence[Any]: ...
    def close(self) -> None: ...


class Node(Protocol):
    """The methods of :class:`dexkit.dds.DdsNode` that the service uses."""

    def writer(  # noqa: D102
        self, topic: str, type_name: str, *, user_data: bytes = b""
    ) -> _Writer: ...
    def reader(  # noqa: D102
        self, topic: str, type_name: str, *, on_data: Callable[[], object] | None = None
    ) -> _Reader: ...
    def endpoints(self) -> Sequence[Any]: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class _ServedHand:
    """One served hand and its thread."""

    def __init__(self, hand: Hand, core: HandCore, clock: Clock) -> None:
        self.hand = hand
        self.core = core
        self.watch = PauseWatch(clock)
        self.side: Side = hand.spec.side
        self.thread: threading.Thread | None = None
        self.problem = ""  # the last error logged, to log each only once
        self.limp = LimpCommands(hand.spec)
        self.adapt: Callable[[HandCommand], HandCommand] | None = getattr(
            hand, "adapt_command", None
        )


class HandService:
    """Serve one hand, or the two hands that share a topic pair, until :meth:`stop`.

    :param hands: a hand, or one of each side for a dialect whose message holds both.
    :param node: DDS node to use; it stays open at stop. Without it one is made and closed.
    :param dialect: by default the first of the hand model's.
    :param state_rate: Hz; by default that of the model.
    :param publisher: publishes the state, at its own rate, also for other services.
    :param phase: when in a period the hand is exchanged with, 0 to 1; state is published at 0.
    :param estimation: when q is predicted, see :class:`~dexkit.service.hand_core.Estimation`.
    :param stall_tau: N·m of tau_est that a joint whose prediction is stalled has at least.
    :param wait_for_device: do not fail when the hand is missing at the start, wait for it.
    :param force: start, and go on, even if another program publishes the state topic.
    :raises UsageError: hands and dialect do not fit.

    A service that is to give way to another one after its start (:mod:`dexkit.single_publisher`)
    brakes and releases its hands; :attr:`failure` then is a :class:`~dexkit.errors.TopicConflict`.

    A hand may have a method ``adapt_command``, which takes each command as it was received and
    returns the one that this hand is set to make of it, and a text ``zero_gains_hint``, which is
    added to the warning of a client without gains.

    A hand may have an attribute ``joint_speeds``: per joint its calibrated speeds toward larger
    and toward smaller q, rad/s. The estimator uses them; without it, each joint's ``dq_max``.
    Another is ``reconnect_interval``: seconds at most between attempts to open it again when it
    was lost, for a hand that costs little to look for.
    """

    def __init__(
        self,
        hands: Hand | Sequence[Hand],
        *,
        node: Node | None = None,
        domain: int = 1,
        interface: str = "lo",
        dialect: str | Dialect | None = None,
        state_rate: float | None = None,
        publisher: Publisher | None = None,
        phase: float = 0.5,
        estimation: Estimation = Estimation.AUTO,
        fill: Fill = Fill.KNOWN,
        wait_for_device: bool = False,
        force: bool = False,
        soft_start: bool | None = None,
        stall_tau: float = 0.0,
        clock: Clock | None = None,
    ) -> None:
        group = list(hands) if isinstance(hands, Sequence) else [hands]
        self.model: HandModel = _one_model(group)
        if dialect is None:
            dialect = self.model.dialects[0]
        self.dialect = dialect_by_name(dialect) if isinstance(dialect, str) else dialect
        sides = [hand.spec.side for hand in group]
        topics = {self.dialect.topics(side) for side in sides}
        if len(set(sides)) != len(sides) or len(topics) != 1:
            raise UsageError(
                f"{len(group)} hands do not share one topic pair of {self.dialect.name}",
                hint="serve each side by its own HandService",
            )
        ((self.cmd_topic, self.state_topic),) = topics
        self.low_rate_topic = self.dialect.low_rate_topic.format(side=sides[0])
        feels = all(hand.spec.n_sensors for hand in group)
        self.touch_topic = self.dialect.touch_topic_of(sides[0]) if feels else ""
        self.state_rate = state_rate if state_rate is not None else self.model.state_rate
        self.counters = TopicCounters()
        self.domain, self.interface = domain, interface
        self._clock: Clock = clock if clock is not None else RealClock()
        if publisher is not None:
            self.state_rate = publisher.hz
        self._phase = phase
        self._publisher = publisher or Publisher(self.state_rate, self._clock)
        self._node, self._own_node = node, node is None
        self._wait_for_device, self._force = wait_for_device, force
        self._sole: SolePublisher | None = None
        self._units = [
            _ServedHand(
                hand,
                HandCore(
                    hand.spec,
                    self.model,
                    self._clock,
                    estimation=estimation,
                    soft_start=soft_start,
                    stall_tau=stall_tau,
                ),
                self._clock,
            )
            for hand in group
        ]
        self._map = dialect_map(self.dialect, {u.side: u.core.spec for u in self._units}, fill)
        self._cmd_type = message_type(self.dialect.cmd_type)
        self._stop = threading.Event()
        self._wake = threading.Event()
        self._ages = SampleAges()
        self._receive_watch = PauseWatch(self._clock)
        self._publish_watch = PauseWatch(self._clock)
        self._publish_allowed = PAUSE + 1.0 / self.state_rate
        self._pause_lock = threading.Lock()
        self._resumed = -math.inf  # when the last pause ended
        self._receiving: threading.Thread | None = None
        self._low_rate_every = self._touch_every = 0
        self._ticks = 0
        self._reader: _Reader | None = None
        self._writer: _Writer | None = None
        self._low_rate_writer: _Writer | None = None
        self._touch_writer: _Writer | None = None
        self._logged: set[str] = set()  # remarks logged, each kind only once
        self._encoded: tuple[tuple[StateView | None, ...], bytes | None] = ((), None)
        self._touch: tuple[tuple[StateView | None, ...], bytes | None] = ((), None)
        self._started = False
        self._failure: Exception | None = None

    # -- start and stop
    # -------------------------------------------------------------------------------

    def __enter__(self) -> HandService:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()

    def start(self) -> None:
        """Open the hands, then create the reader and writers.

        :raises HandError: a hand cannot be opened (unless ``wait_for_device``).
        :raises DdsError: no CycloneDDS, no such interface, ...
        :raises TopicConflict: another program publishes the state topic (unless ``force``).
        """
        if self._started:
            raise UsageError("a service cannot be started twice")
        self._started = True
        try:
            self._start()
        except BaseException:
            self._release()
            raise

    def _start(self) -> None:
        node = self._node
        if node is None:
            from dexkit.dds import DdsNode

            node = self._node = DdsNode(domain=self.domain, interface=self.interface)
        # no hand is touched before it is certain that no other service has these topics
        topics = {self.state_topic, self.low_rate_topic, self.touch_topic} - {""}
        sole = self._sole = SolePublisher(
            [NodeTopics(node, topics)], hint=_CONFLICT_HINT, force=self._force
        )
        sole.search()
        claim = sole.announce()
        self._writer = node.writer(self.state_topic, self.dialect.state_type, user_data=claim)
        if self.low_rate_topic:
            self._low_rate_writer = node.writer(
                self.low_rate_topic, self.dialect.state_type, user_data=claim
            )
        if self.touch_topic:
            self._touch_writer = node.writer(
                self.touch_topic, self.dialect.touch_type, user_data=claim
            )
        sole.settle(self._wake.set)
        for unit in self._units:
            self._open_first(unit)
        if self.low_rate_topic:
            self._low_rate_every = max(1, round(self.state_rate / self.dialect.low_rate))
        if self.touch_topic:
            self._touch_every = max(1, round(self.state_rate / self.dialect.touch_rate))
        self._reader = node.reader(self.cmd_topic, self.dialect.cmd_type, on_data=self._wake.set)
        self._receive_watch.restart()  # from here on commands may wait to be received
        for unit in self._units:
            unit.thread = self._thread(f"exchange-{unit.side}", self._exchange_loop, unit)
            unit.watch.restart()
        self._receiving = self._thread("receive", self._receive_loop)
        for thread in [self._receiving, *(u.thread for u in self._units)]:
            assert thread is not None
            thread.start()
        self._publisher.add(self._tick)

    def stop(self) -> None:
        """Brake, release the hands, publish the last state, leave DDS. May be called twice."""
        if not self._stop.is_set():
            self._release()

    def _release(self) -> None:
        self._stop.set()
        self._wake.set()
        if self._sole is not None:
            self._sole.close()
        self._publisher.remove(self._tick)
        for unit in self._units:
            thread = unit.thread
            if thread is not None and thread.ident is not None:
                thread.join(_JOIN + unit.core.spec.exchange_timeout)
                if thread.is_alive():
                    log.error("%s: the backend hangs in an exchange; closing it", unit.side)
                    self._close_hand(unit)
            else:
                self._close_hand(unit)
        if self._receiving is not None and self._receiving.ident is not None:
            self._receiving.join()
        gave_way = isinstance(self.failure, TopicConflict)
        if self._writer is not None and self._receiving is not None and not gave_way:
            self._publish_now(low_rate=True, touch=True)
            if self.clients:
                time.sleep(_LAST_STATE_DELAY)
        for entity in (self._reader, self._writer, self._low_rate_writer, self._touch_writer):
            if entity is not None:
                entity.close()
        if self._own_node and self._node is not None:
            self._node.close()
            self._node = None

    def _thread(self, name: str, target: Callable[..., None], *args: object) -> Worker:
        return Worker(name, target, *args, failed=self._record_failure)

    def _record_failure(self, error: Exception) -> None:
        self._failure = self._failure or error

    @property
    def failure(self) -> Exception | None:
        """The error that ended a thread of the service, its node or its publisher; or None."""
        return self._failure or self._publisher.failure or getattr(self._node, "failure", None)

    # -- status and counters ----------------------------------------------------------------

    @property
    def node(self) -> Node | None:
        """The DDS node while the service runs."""
        return self._node

    @property
    def clients(self) -> int:
        """Readers of the state topic, of its low-rate copy and of the touch topic."""
        writers = (self._writer, self._low_rate_writer, self._touch_writer)
        return sum(writer.matched for writer in writers if writer is not None)

    @property
    def cores(self) -> dict[Side, HandCore]:
        """The core of each hand, by side."""
        return {unit.side: unit.core for unit in self._units}

    def snapshot(self) -> dict[str, Any]:
        """All counters: of the topic pair and, by side, of the hands."""
        hands = {}
        for unit in self._units:
            hands[str(unit.side)] = {
                **unit.core.counters.snapshot(),
                "resyncs": unit.core.resyncs,
                "connected": unit.core.connected,
            }
        return {
            "cmd_topic": self.cmd_topic,
            "state_topic": self.state_topic,
            **self.counters.snapshot(),
            "rivals": self._sole.rivals if self._sole is not None else 0,
            "hands": hands,
        }

    def log_counters(self) -> None:
        """Log :meth:`snapshot` as one line of JSON."""
        _counters_log.info("counters %s", json.dumps(self.snapshot()))

    # -- receive ----------------------------------------------------------------------------

    def _receive_loop(self) -> None:
        assert self._reader is not None
        assert self._sole is not None
        while not self._stop.is_set():
            self._wake.wait(_TICK)
            self._wake.clear()
            self._check_receive_pause()
            self._sole.poll()
            for sample in self._reader.take():
                self._receive(sample)

    def _receive(self, sample: Any) -> None:
        # in this order: if there is a pause in between, the sample only looks older
        now = self._clock.now()
        received = self._clock.since_boot()
        self._check_receive_pause()
        age = self._ages.age(sample.writer, sample.source_timestamp_ns, received)
        data: bytes = sample.data
        count = self.counters
        count.received += 1
        try:
            message = self._cmd_type.decode(data)
        except WireError as error:
            count.undecodable += 1
            if count.undecodable == 1:
                log.warning("%s: undecodable command: %s", self.cmd_topic, error)
            return
        motors = self._map.motors(message)
        if motors > self._map.length:
            count.overlong += 1
            self._log_once("overlong", f"{motors} motors, the first {self._map.length} are taken")
        short = False
        for unit in self._units:
            command = self._map.command(message, unit.side)
            if command is None:
                short = True
            else:
                self._submit(unit, command, message, now - age)
        if short:
            count.short += 1
            self._log_once(
                "short",
                f"ignored, {motors} motor(s) where {self._map.length} are needed"
                if motors < self._map.length
                else "ignored, it leaves joints without a goal",
            )

    def _submit(self, unit: _ServedHand, command: HandCommand, message: Any, sent: float) -> None:
        counters = unit.core.counters
        clamped, rejected = counters.clamped, counters.rejected
        if unit.adapt is not None:
            command = unit.adapt(command)
        if not unit.core.submit(command, sent):
            if counters.rejected != rejected:
                self._log_once("rejected", "rejected, it is not finite")
            else:
                self._log_stale(sent)
            return
        if counters.clamped != clamped:
            for name, text in _values_beyond_limits(unit.core.spec, command):
                self._log_once(name, f"{text}; brought within the limits")
        if stuck := unit.core.tripped:
            names = ", ".join(unit.core.spec.joints[i].name for i in stuck)
            self._log_once(
                "tripped",
                f"{names} stay braked, because their time-out protection has tripped and the mode "
                "byte asks for it again; send it once with bit 7 = 0",
            )
        if unit.limp.update(command, self._clock.now()):
            counters.zero_gains += 1
            hint = getattr(unit.hand, "zero_gains_hint", "")
            self._log_once(
                "zero_gains",
                "q changes, but kp, kd, dq and tau are all 0, so the hand stays limp; send gains "
                f"(Unitree's client: kp {self.model.gains[0][0]:g}, kd "
                f"{self.model.gains[0][1]:g}){hint}",
            )
        for remark in self._map.remarks(message, unit.side):
            setattr(counters, remark.counter, getattr(counters, remark.counter) + 1)
            self._log_once(remark.counter, remark.text)

    def _log_once(self, kind: str, text: str) -> None:
        """Log the remarks about a command, each kind only once."""
        if kind not in self._logged:
            self._logged.add(kind)
            log.warning("%s: unusual command (counted, logged once): %s", self.cmd_topic, text)

    def _log_stale(self, sent: float) -> None:
        age = self._clock.now() - sent
        if age > PAUSE and math.isfinite(age):
            self._log_once(
                "stale",
                f"ignored, it came {age:.1f} s later than usual for its client; is the network "
                f"slow? What is more than {PAUSE:g} s old never moves a hand",
            )

    # -- pauses -----------------------------------------------------------------------------

    def _check_pause(
        self, watch: PauseWatch, units: Sequence[_ServedHand], allowed: float = PAUSE
    ) -> bool:
        """Whether a loop of this service was paused; if so, these hands brake until a command comes
        that was sent later.
        """
        away = watch.measure_pause(allowed)
        if not away:
            return False
        now = self._clock.since_boot()
        with self._pause_lock:
            first = now - away > self._resumed  # another loop may have reported it already
            self._resumed = now
            for unit in units:
                unit.core.paused()
        if first:
            self.counters.pauses += 1
            self._log_pause(away)
        return True

    def _check_exchange_pause(self, unit: _ServedHand, allowed: float) -> bool:
        """Whether a hand's exchanges or the publishing loop were paused.

        Where exchanges may take long, the publishing loop shows a stop of the process, and this
        thread may be the first to run again.
        """
        stood = self._check_pause(unit.watch, [unit], allowed)
        if self._publish_watch.away() > self._publish_allowed:
            unit.core.paused()
            return True
        return stood

    def _check_receive_pause(self) -> None:
        if self._check_pause(self._receive_watch, self._units):
            self._ages.resumed(self._clock.since_boot())

    def _log_pause(self, away: float) -> None:
        if "paused" not in self._logged:
            self._logged.add("paused")
            log.warning(
                "%s: this program was paused for %.2f s (stopped, suspended, or a machine that is "
                "too busy): braking until a command comes that was sent later (counted, logged "
                "once)",
                self.state_topic,
                away,
            )

    # -- exchange ---------------------------------------------------------------------------

    @property
    def _ending(self) -> bool:
        """Whether the hands are to be braked and released: the service stops, or a thread has died.

        Without its commands or its states a hand must not be driven on.
        """
        return self._stop.is_set() or self.failure is not None

    def _open_first(self, unit: _ServedHand) -> None:
        try:
            self._open(unit)
        except HandError as error:
            if not self._wait_for_device:
                raise
            log.warning("%s: %s; waiting for it", unit.side, error)
            unit.problem = str(error)
        except DexkitError:
            raise
        except Exception as error:  # a backend is other people's code
            raise BackendBroken(
                f"the backend failed to open the {unit.side} hand: {type(error).__name__}: {error}",
                hint=_backend_location(error),
            ) from error

    def _open(self, unit: _ServedHand) -> None:
        """Open the hand and do one exchange, so that there is a state from the first sample on."""
        unit.hand.open()
        speeds = getattr(unit.hand, "joint_speeds", None)
        unit.core.opened(unit.hand.spec, speeds)
        unit.watch.restart()
        if unit.core.predicting and speeds is None:
            log.warning(
                "%s: the backend has no joint_speeds, so predicted positions jump to the measured "
                "ones (docs/backends.md)",
                unit.side,
            )
        if unit.core.lacks_speeds:
            log.warning(
                "%s: the hand is measured less often than clients need, and q is not predicted in "
                "between: the backend has no joint_speeds (docs/backends.md)",
                unit.side,
            )
        try:
            unit.core.measured(unit.hand.exchange(unit.core.next_command()))
        except Exception as error:
            if unit.core.failed(error):
                unit.core.closed()
                self._close_hand(unit)
                raise

    def _exchange_loop(self, unit: _ServedHand) -> None:
        core = unit.core
        longest = getattr(unit.hand, "reconnect_interval", None)
        backoff = Backoff() if longest is None else Backoff(maximum=longest)
        try:
            while not self._ending:
                if not core.connected and not self._reconnect(unit, backoff):
                    continue
                align(self._clock, core.spec.io_rate, self._phase)
                rate = Rate(core.spec.io_rate, self._clock)
                while core.connected and not self._ending:
                    rate.wait()
                    if self._exchange(unit):
                        backoff.reset()
        finally:
            if core.connected:
                self._exchange(unit, HandCommand.brake(core.spec.n_joints))
            self._close_hand(unit)

    def _exchange(self, unit: _ServedHand, command: HandCommand | None = None) -> bool:
        core = unit.core
        # a hand that is slow by itself is no pause
        period = 1.0 / min(core.spec.io_rate, core.measured_rate)
        allowed = max(PAUSE, 2 * period + core.spec.exchange_timeout)
        try:
            if command is None:
                command = core.next_command()
                if self._check_exchange_pause(unit, allowed):
                    command = core.next_command()
            core.measured(unit.hand.exchange(command))
        except Exception as error:  # a backend is other people's code
            self._check_pause(unit.watch, [unit], allowed)
            self._log_hand_error(unit, error)
            if core.failed(error):
                core.closed()
                self._close_hand(unit)
            return False
        if unit.problem:
            log.info("%s: the hand answers again", unit.side)
            unit.problem = ""
        if not core.predicting:
            self._compose()
        return True

    def _reconnect(self, unit: _ServedHand, backoff: Backoff) -> bool:
        if self._stop.wait(backoff.next()):
            return False
        try:
            self._open(unit)
        except Exception as error:  # a backend is other people's code
            unit.core.retry_failed()
            self._log_hand_error(unit, error)
            return False
        unit.core.counters.reconnects += 1
        return True

    def _close_hand(self, unit: _ServedHand) -> None:
        try:
            unit.hand.close()
        except Exception as error:  # it must not keep the rest from being released
            log.warning("%s: closing the hand: %s", unit.side, error)

    def _log_hand_error(self, unit: _ServedHand, error: Exception) -> None:
        text = f"{type(error).__name__}: {error}"
        if text == unit.problem:
            return
        unit.problem = text
        if isinstance(error, DexkitError):
            log.warning("%s: %s%s", unit.side, error, f" ({error.hint})" if error.hint else "")
        else:
            log.error("%s: the backend failed", unit.side, exc_info=error)

    # -- publish ----------------------------------------------------------------------------

    def _tick(self, missed: int) -> None:
        if self.failure is not None:
            return
        self._check_pause(self._publish_watch, self._units, self._publish_allowed)
        self.counters.publish_misses += missed
        self._ticks += 1
        low, touch = (
            every > 0 and self._ticks % every == 0
            for every in (self._low_rate_every, self._touch_every)
        )
        self._publish_now(low_rate=low, touch=touch)

    def _publish_now(self, *, low_rate: bool, touch: bool) -> None:
        try:
            self._publish(self._compose(), low_rate=low_rate)
            if touch and self._touch_writer is not None:
                payload = self._compose_touch()
                if payload is not None:
                    self._write(self._touch_writer, payload)
        except Exception as error:  # a failure must be reported
            log.exception("%s: publishing failed", self.state_topic)
            self._record_failure(error)

    def _compose(self) -> bytes | None:
        """The sample for now; None without a state.

        It is encoded again only if something changed. The exchange thread calls this too, so
        that the publishing thread mostly finds the work done; should both do it at once, both
        get it right.
        """
        views = tuple(unit.core.view() for unit in self._units)
        encoded_views, payload = self._encoded
        if len(views) == len(encoded_views) and all(
            a is b for a, b in zip(views, encoded_views, strict=True)
        ):
            return payload
        known = {u.side: v for u, v in zip(self._units, views, strict=True) if v is not None}
        try:
            payload = self._map.encode(known) if known else None
        except WireError as error:  # a value that the wire cannot hold
            self._count_publish_error(error)
            payload = None
        self._encoded = (views, payload)
        return payload

    def _compose_touch(self) -> bytes | None:
        """Message of the hands' tactile areas; None without a state, or without such areas."""
        views = tuple(unit.core.view() for unit in self._units)
        encoded_views, payload = self._touch
        if len(views) == len(encoded_views) and all(
            a is b for a, b in zip(views, encoded_views, strict=True)
        ):
            return payload
        known = {u.side: v for u, v in zip(self._units, views, strict=True) if v is not None}
        payload = self._map.encode_touch(known) if known else None
        self._touch = (views, payload)
        return payload

    def _publish(self, payload: bytes | None, *, low_rate: bool) -> None:
        if payload is None:
            return
        assert self._writer is not None
        if self._write(self._writer, payload):
            self.counters.published += 1
        if low_rate and self._low_rate_writer is not None:
            self._write(self._low_rate_writer, payload)

    def _write(self, writer: _Writer, payload: bytes) -> bool:
        try:
            written = writer.write_raw(payload)
        except DexkitError as error:
            self._count_publish_error(error)
            return False
        if not written:
            self._count_publish_error(TimeoutError("a reliable reader is too slow"))
        return written

    def _count_publish_error(self, error: Exception) -> None:
        self.counters.publish_errors += 1
        if self.counters.publish_errors == 1:
            log.error("%s: cannot publish: %s", self.state_topic, error)


def _values_beyond_limits(spec: HandSpec, command: HandCommand) -> Iterator[tuple[str, str]]:
    """(joint and field, sentence) of each value of ``command`` that is beyond the limits."""
    angle, torque = model(spec.model).unit, model(spec.model).torque_unit
    for i, joint in enumerate(spec.joints):
        ranges = {
            "q": (joint.q_min, joint.q_max, angle),
            "dq": (-joint.dq_max, joint.dq_max, f"{angle}/s"),
            "tau": (-joint.tau_max, joint.tau_max, torque),
            "kp": (0.0, math.inf, f"{torque}/{angle}"),
            "kd": (0.0, math.inf, f"{torque} s/{angle}"),
        }
        for name, (low, high, unit) in ranges.items():
            value = float(getattr(command, name)[i])
            if not low <= value <= high:
                yield (
                    f"{spec.side} {joint.name} {name}",
                    f"{name} of {joint.name} = {value:.7g} {unit} is outside {low:g} .. {high:g}",
                )


def _one_model(hands: Sequence[Hand]) -> HandModel:
    names = {hand.spec.model for hand in hands}
    if len(names) != 1:
        raise UsageError(f"a service needs hands of one model, got {sorted(names)}")
    return model(names.pop())


def _backend_location(error: BaseException) -> str:
    """File and line where the code that is not dexkit's began to fail."""
    package = os.path.dirname(os.path.dirname(__file__)) + os.sep
    frames = traceback.extract_tb(error.__traceback__)
    frame = next((f for f in frames if not f.filename.startswith(package)), frames[-1])
    return f"at {frame.filename}:{frame.lineno}, in {frame.name}"
