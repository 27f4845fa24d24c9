"""Decide commands and state of one hand: watchdog, limits, faults; no threads, DDS or devices.

:class:`HandCore` gets events (a command came, an exchange succeeded or failed, the
link was opened) and returns what follows: the command for the next exchange and the state to
publish. Its time is the injected clock's, so every rule here is tested on a manual clock.

Who calls it: the receiving thread :meth:`HandCore.submit`, the exchange thread
:meth:`~HandCore.next_command` and the events, the publishing thread :meth:`~HandCore.view`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from dexkit.clock import Clock
from dexkit.command_age import PAUSE
from dexkit.errors import CommandRejected, HandError, HandFault, HandTimeout
from dexkit.hand import (
    CommandGate,
    Floats,
    HandCommand,
    HandSpec,
    HandState,
    JointMode,
    MotorError,
)
from dexkit.models import HandModel
from dexkit.service.counters import HandCounters
from dexkit.service.dialects import StateView
from dexkit.service.estimator import StateEstimator

__all__ = ["Estimation", "HandCore"]

_PATIENCE = 0.5  # seconds of failed exchanges before the link is given up
_STALE = 0.25  # seconds beyond the expected exchange before a state counts as stale
_RATE_WINDOW = 0.5  # seconds over which the rate of measurements is taken
_START_SPEED = 1.0  # strokes a second until a real hand has caught up with its first commands
_CAUGHT_UP = 1e-3  # of the stroke


class Estimation(str, Enum):
    """When q is predicted between measurements.

    ``AUTO`` predicts while fewer measurements come than clients need (the model's
    ``min_state_rate``); above that a measurement is published again until the next one comes. It
    does not predict a hand of several joints that obey gains and whose speeds are not known.
    """

    AUTO = "auto"
    OFF = "off"
    PREDICT = "predict"


class HandCore:
    """The state of one served hand.

    :param soft_start: limit the velocity of the first motion; by default for real hands only.
    :param stall_tau: see :class:`~dexkit.service.estimator.StateEstimator`.
    """

    def __init__(
        self,
        spec: HandSpec,
        model: HandModel,
        clock: Clock,
        *,
        estimation: Estimation = Estimation.AUTO,
        soft_start: bool | None = None,
        stall_tau: float = 0.0,
    ) -> None:
        self.spec = spec
        self.counters = HandCounters()
        self._clock = clock
        self._timeout = model.command_timeout
        self._min_rate = model.min_state_rate
        self._obeys_gains = spec.n_joints > 1 and not model.dialects[0].position_servo
        self._estimation = estimation
        self._gate = CommandGate(spec)
        self._brake = HandCommand.brake(spec.n_joints)
        # guards the estimator, which all three threads touch, and the time-outs, which two do
        self._lock = threading.Lock()
        self._stall_tau = stall_tau
        self._estimator = StateEstimator(spec, stall_tau=stall_tau)
        self._speeds: Sequence[tuple[float, float]] | None = None
        self._following = self._brake  # what the estimator is to follow when it is needed
        self._resyncs = 0  # of estimators before this one
        self._soft_start = not spec.simulated if soft_start is None else soft_start
        self._starting = self._soft_start
        self._start_q: Floats | None = None
        self._start_time = 0.0
        self._command: tuple[HandCommand, float] | None = None  # and when it was sent
        # the newest command, and what is left of it when it is too old
        self._held: tuple[tuple[HandCommand, float], HandCommand] | None = None
        self._tripped: tuple[bool, ...] = ()  # per joint; empty where none has
        self._late: tuple[HandCommand, float] | None = None  # the command found too old
        self._not_before = clock.now()  # what was sent earlier does not count
        self._resumed = -math.inf  # when the last pause of this program ended
        self._driving = False
        self._holding = False
        self._connected = False
        self._faulted: tuple[int, ...] | None = None
        self._answered = clock.now()  # when the device last showed that it is there
        self.measured_rate = spec.io_rate  #: measurements a second; at first as the hand declares
        self._slow = spec.io_rate < self._min_rate
        self._window = (clock.now(), 0)  # start, exchanges since
        self._missed = 0
        self._view: StateView | None = None

    # -- what happened ----------------------------------------------------------------------

    def submit(self, command: HandCommand, sent: float | None = None) -> bool:
        """Take a command. False when it is rejected or stale: the one before stays in force, and
        the watchdog is not fed. A command is stale that was sent more than
        :data:`~dexkit.command_age.PAUSE` seconds ago, or before the link was opened, a fault ended
        or a pause did.

        :param sent: when it was sent, on the core's clock: as it was received, less its age;
            minus infinity if it may be older than a pause. None: just now.
        """
        now = self._clock.now()
        if sent is None:
            sent = now
        if now - sent > PAUSE:
            self.counters.stale += 1
            return False
        try:
            admitted = self._gate.admit(command)
        except CommandRejected:
            self.counters.rejected = self._gate.rejected
            return False
        with self._lock:
            if sent < self._not_before:
                self.counters.stale += 1
                return False
            self.counters.accepted += 1
            self.counters.clamped = self._gate.clamped
            self._time_out(now)  # before this one hides how long there was none
            if admitted.timeout is not None and self._tripped:
                # a command without the bit clears it
                still = np.array(self._tripped) & admitted.timeout
                self._tripped = tuple(still.tolist()) if still.any() else ()
                admitted = _with_brakes(admitted, still)
            self._command = (admitted, sent)
            if self._connected and not self._starting and self._faulted is None:
                self._follow(admitted, now)
        return True

    def opened(self, spec: HandSpec, speeds: Sequence[tuple[float, float]] | None = None) -> None:
        """The link is open. Commands from before do not count any more.

        :param spec: the spec of the opened hand; its ``io_rate`` may have become exact.
        :param speeds: calibrated speeds per joint, see
            :class:`~dexkit.service.estimator.StateEstimator`.
        """
        now = self._clock.now()
        self.spec = spec
        with self._lock:
            self._speeds = speeds
            self._begin_prediction(now)
        self.measured_rate = self.spec.io_rate
        self._slow = self.spec.io_rate < self._min_rate
        self._window = (now, 0)
        self._answered = now
        self._only_newer(now)
        self._faulted = None
        self._starting = self._soft_start
        self._start_q = None
        self._connected = True

    def measured(self, state: HandState) -> None:
        """An exchange returned ``state``.

        :raises HandError: it is no state, has the wrong shape or a q that is not finite; count it
            as a failed exchange.
        """
        n = self.spec.n_joints
        given: object = state  # a backend is other people's code
        if not isinstance(given, HandState):
            raise HandError(
                f"the backend returned a {type(given).__name__}, not a HandState",
                hint="exchange ends with: return HandState.from_values(q, stamp=time.monotonic())",
            )
        if state.q.shape != (n,) or not all(map(math.isfinite, state.q.tolist())):
            raise HandError(f"the backend returned q = {state.q}, not {n} finite value(s)")
        now = self._clock.now()
        predicted = self.predicting
        self._observe_rate(now)
        self._answered = now
        self._missed = 0
        if self._faulted is not None:  # what was commanded before or during a fault is stale
            self._faulted = None
            self._only_newer(now)
        self.counters.exchanges += 1
        if self.predicting:
            with self._lock:
                if not predicted:
                    self._begin_prediction(now)
                self._estimator.measure(state, now)
        self._view = StateView(state, tuple(state.fault.tolist()), tripped=self._tripped)

    def failed(self, error: Exception) -> bool:
        """An exchange raised ``error``. True when the link should be given up and reopened.

        A fault is not a lost link: the device answers, and exchanging goes on, so that the
        backend can recover it. Time-outs are given half a second to pass. Anything else (the
        device is gone, or the backend is broken) means reopening.
        """
        self.counters.exchange_errors += 1
        self._missed += 1
        bits: tuple[int, ...] = ()
        if isinstance(error, HandFault):
            self.counters.faults += 1
            self._answered = self._clock.now()
            bits = error.bits
        if self._view is not None:
            previous = self._view.fault if self._faulted is not None else ()
            fault = tuple(
                _bits_of(bits, joint) | _bits_of(previous, joint)
                for joint in range(self.spec.n_joints)
            )
            if isinstance(error, HandFault):
                self._faulted = fault
            self._view = replace(self._view, fault=fault, missed=self._missed)
        elif isinstance(error, HandFault):
            self._faulted = bits
        patient = isinstance(error, (HandTimeout, HandFault, CommandRejected))
        since = max(self._answered, self._resumed)  # the device had no chance during a pause
        return not patient or self._clock.now() - since > _PATIENCE

    def paused(self) -> None:
        """A pause of the program has ended. The hand brakes until a command comes that was sent
        later.
        """
        self._resumed = self._clock.now()
        # a clock that stands still in suspend: what was sent just before bears the same time
        self._only_newer(math.nextafter(self._resumed, math.inf))

    def closed(self) -> None:
        """The link was given up."""
        self._connected = False
        self._driving = self._holding = False
        self.counters.losses += 1
        with self._lock:
            self._follow(self._brake, self._clock.now())

    def retry_failed(self) -> None:
        """An attempt to open the link again failed."""
        self._missed += 1
        if self._view is not None:
            self._view = replace(self._view, missed=self._missed)

    # -- what follows -----------------------------------------------------------------------

    @property
    def connected(self) -> bool:
        """Whether the link is open."""
        return self._connected

    @property
    def driving(self) -> bool:
        """Whether the last exchange carried a client's command rather than the brake."""
        return self._driving

    @property
    def predicting(self) -> bool:
        """Whether q is predicted between measurements now."""
        if self._estimation is Estimation.AUTO:
            return self._slow and not self.lacks_speeds
        return self._estimation is Estimation.PREDICT

    @property
    def lacks_speeds(self) -> bool:
        """Whether q would be predicted if the joints' speeds were known.

        Fingers that obey gains are sent away softly as well: at their top speed, a prediction would
        report motion that does not happen.
        """
        unknown = self._obeys_gains and self._speeds is None
        return self._estimation is Estimation.AUTO and self._slow and unknown

    @property
    def resyncs(self) -> int:
        """Times that the prediction was more than 10 % of the stroke off."""
        return self._resyncs + self._estimator.resyncs

    @property
    def tripped(self) -> tuple[int, ...]:
        """The joints that the time-out protection has stopped."""
        return tuple(i for i, tripped in enumerate(self._tripped) if tripped)

    @property
    def holding(self) -> bool:
        """Whether the hand is driven without fresh commands, its protection being off."""
        return self._holding

    def next_command(self) -> HandCommand:
        """The command for the next exchange: the newest one, or the brake.

        The brake before the first command, during a fault, and after a (re)connection, a fault or
        a pause until a command comes that is newer.

        When the newest command is older than the model's command time-out: the brake, where the
        dialect has no time-out bit. Where it has one (the Dex3-1 manual, RIS_Mode), a joint whose
        bit was set *trips*: it brakes until a command comes with the bit clear. A joint whose bit
        was clear is unprotected and keeps its position command, without the feed-forward
        velocity and torque, which would move it on.
        """
        now = self._clock.now()
        with self._lock:
            command = self._command_in_force(now)
            if command is self._brake or command.is_brake:
                if self._driving and command is self._brake:
                    self.counters.brakes += 1
                self._driving = False
                self._start_q = None
                self._follow(self._brake, now)
                return command
            self._driving = True
            if self._starting:
                command = self._slew(command, now)
                self._follow(command, now)
        return command

    def view(self) -> StateView | None:
        """The state to be published now; None before the first exchange.

        The same object is returned until something changes.
        """
        view = self._view
        if view is None:
            return None
        now = self._clock.now()
        if not self._connected or now - self._answered > self._overdue():
            return self._mark_stale(view)
        if self.predicting:
            with self._lock:
                state = self._estimator.predict(now)
            if state is not None:
                return replace(view, state=state)
        return view

    # -- details ----------------------------------------------------------------------------

    def _only_newer(self, now: float) -> None:
        """Ignore all commands that were sent until now."""
        with self._lock:
            self._not_before = now

    def _command_in_force(self, now: float) -> HandCommand:
        late = self._time_out(now)
        newest = self._command
        if newest is None or newest[1] < self._not_before or self._faulted is not None:
            self._holding = False
            return self._brake
        if not late:
            self._holding = False
            return newest[0]
        if newest[0].timeout is None:
            return self._brake
        if self._held is None or self._held[0] is not newest:
            self._held = (newest, _at_rest(_with_brakes(newest[0], np.array(self._tripped))))
            self._follow(self._held[1], now)
        if not self._holding and not self._held[1].is_brake:
            self._holding = True
            self.counters.holds += 1
        return self._held[1]

    def _time_out(self, now: float) -> bool:
        """Whether the newest command is too old; trips the joints that it asks to protect."""
        newest = self._command
        if newest is None or now - newest[1] < self._timeout:
            return False
        if newest[0].timeout is not None and newest is not self._late:
            self._late = newest
            before = np.array(self._tripped or (False,) * self.spec.n_joints)
            tripped = before | newest[0].timeout
            if self._driving and (tripped & ~before & (newest[0].mode > 0)).any():
                self.counters.brakes += 1
            self._tripped = tuple(tripped.tolist()) if tripped.any() else ()
        return True

    def _follow(self, command: HandCommand, now: float) -> None:
        self._following = command
        if self.predicting:  # a hand of seven joints that is fast enough need not pay for it
            self._estimator.follow(command, now)

    def _begin_prediction(self, now: float) -> None:
        self._resyncs += self._estimator.resyncs
        self._estimator = StateEstimator(self.spec, self._speeds, stall_tau=self._stall_tau)
        self._estimator.follow(self._following, now)

    def _mark_stale(self, view: StateView) -> StateView:
        link = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
        if all(bits & link for bits in view.fault):
            return view
        stale = replace(view, fault=tuple(b | link for b in view.fault), missed=max(view.missed, 1))
        if self._view is view:
            self._view = stale
        return stale

    def _observe_rate(self, now: float) -> None:
        """Count exchanges over half a second: one late answer must not switch the estimator on."""
        if self._missed or now - self._answered > self._overdue():
            self._window = (now, 0)
            return
        start, count = self._window[0], self._window[1] + 1
        self._window = (start, count)
        if count < 3 or now - start < _RATE_WINDOW:
            return
        self.measured_rate = count / (now - start)
        self._window = (now, 0)
        # a margin, so that a rate near the limit does not switch to and fro
        self._slow = self.measured_rate < self._min_rate * (1.1 if self._slow else 0.9)

    def _overdue(self) -> float:
        return 2 / self.measured_rate + self.spec.exchange_timeout + _STALE

    def _slew(self, command: HandCommand, now: float) -> HandCommand:
        """Limit the velocity of the position command until it has been caught up with."""
        stroke = self.spec.q_max - self.spec.q_min
        if self._start_q is None:
            view = self._view
            self._start_q = np.array(view.state.q) if view is not None else np.array(command.q)
            self._start_time = now
        step = _START_SPEED * stroke * (now - self._start_time)
        self._start_time = now
        self._start_q = self._start_q + np.clip(command.q - self._start_q, -step, step)
        if (np.abs(command.q - self._start_q) <= _CAUGHT_UP * stroke).all():
            self._starting = False
            return command
        return replace(command, q=self._start_q)


def _with_brakes(command: HandCommand, joints: NDArray[np.bool_]) -> HandCommand:
    if not joints.any():
        return command
    return replace(command, mode=np.where(joints, JointMode.BRAKE, command.mode).astype(np.uint8))


def _at_rest(command: HandCommand) -> HandCommand:
    nothing = np.zeros_like(command.q)
    return replace(command, dq=nothing, tau=nothing)


def _bits_of(bits: Sequence[int], joint: int) -> int:
    return bits[joint] if joint < len(bits) else 0
