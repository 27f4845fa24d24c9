"""Base class of drivers for devices with goal registers and no command time-out.

Each exchange writes the goals where they have changed, and reads what is measured. The device moves
to its last goal and stays there, even if the host has gone. To hold a joint, the driver writes its
last measured position as its goal; ``close`` does so for every joint.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.channel import Channel
from dexkit.drivers.request_line import LATE, RequestLine, RequestStatistics
from dexkit.errors import HandError, HandLost, HandNotFound, HandTimeout
from dexkit.hand import HandCommand, HandSpec, HandState, Side
from dexkit.models import HandModel

__all__ = ["GoalHand"]

log = logging.getLogger(__name__)

_ATTEMPTS = 3  # while a hand is being opened

FoundT = TypeVar("FoundT")
SelfT = TypeVar("SelfT", bound="GoalHand")


class GoalHand(ABC):
    """A hand with goals in its registers.

    :param name: of the device, for the log.
    :param model: of the hand.
    :param side: which hand.
    :param timeout: seconds to wait for an answer.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds."""

    def __init__(
        self, name: str, model: HandModel, side: Side, timeout: float, clock: Clock | None
    ) -> None:
        self.statistics = RequestStatistics()
        self._name = name
        self._line = RequestLine(self.statistics, timeout)
        self._clock: Clock = clock or RealClock()
        self._channel: Channel | None = None
        self._written: list[int] | None = None
        """The goals that the device has acknowledged."""
        self._spec = model.spec(
            side, io_rate=model.state_rate, exchange_timeout=2 * (timeout + LATE)
        )
        joints = len(self._spec.joints)
        self._positions = [0] * joints
        """Last measured positions, device counts."""
        self._held: list[int | None] = [None] * joints
        """Goals of joints that hold; device counts."""

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    # --- what a device does in its own way

    @abstractmethod
    def _connect(self) -> Channel:
        """Open the connection to the device.

        :raises HandError: it cannot be.
        """

    @abstractmethod
    def _prepare(self) -> None:
        """Make the device ready without motion, and measure the positions.

        :raises HandTimeout: an answer was lost; it is done again.
        """

    @abstractmethod
    def _absent(self, place: str) -> HandNotFound:
        """Error text for a place where no hand answers."""

    @abstractmethod
    def _goals(self, command: HandCommand) -> list[int]:
        """Convert a command to goal registers."""

    @abstractmethod
    def _put_goals(self, goals: list[int], before: WriteDeadline | None = None) -> None:
        """Write goal registers as returned by :meth:`_goals`."""

    @abstractmethod
    def _holding_goals(self) -> list[int]:
        """Goal registers that hold every joint at its measured position."""

    @abstractmethod
    def _measure(self, command: HandCommand) -> HandState:
        """Read the state under the given command."""

    # --- opening and closing

    def open(self) -> None:
        """Open the connection, make the device ready and read the positions. No motion.

        :raises HandNotFound: no place was named or there is none, or the hand does not answer.
        :raises HandRefused: another program uses the port, or it is the wrong hand.
        :raises HandLost: the connection breaks.
        """
        if self._channel is not None:
            return
        self._channel = self._connect()
        self._line.restart()
        self._written = None
        self._held = [None] * len(self._held)
        place = self._channel.place
        try:
            self._prepare_patiently()
        except HandTimeout as error:
            self._close_channel()
            raise self._absent(place) from error
        except BaseException:
            self._close_channel()
            raise
        log.info("%s on %s: at %s", self._name, place, self._positions)

    def _prepare_patiently(self) -> None:
        for left in reversed(range(_ATTEMPTS)):
            try:
                self._prepare()
                return
            except HandTimeout:
                if not left:
                    raise

    def close(self) -> None:
        """Hold every joint and close the connection. Failures are logged, not raised."""
        channel = self._channel
        if channel is None:
            return
        try:
            self._put_goals(self._holding_goals())
        except HandError as error:
            log.warning("could not hold: %s; the hand goes to its last goal", error)
        finally:
            self._close_channel()
            log.info("%s on %s closed: %s", self._name, channel.place, self.statistics)

    def _close_channel(self) -> None:
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def __enter__(self: SelfT) -> SelfT:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Write the goals if they have changed, and read the state.

        :raises HandLost: the device has gone away, or is not open.
        :raises HandTimeout: no intact answer in time, or this program was paused before the goals
            were written.
        """
        deadline = WriteDeadline(self._clock)
        if self._channel is None:
            raise HandLost("the driver is not connected to the hand", hint="call open() first")
        goals = self._goals(command)
        if goals != self._written:
            self._written = None
            self._put_goals(goals, deadline)
            self._written = goals
        return self._measure(command)

    def _hold(self, joint: int) -> int:
        """Position at which a joint began to hold; device counts."""
        held = self._held[joint]
        if held is None:
            held = self._held[joint] = self._positions[joint]
        return held

    def _ask(self, request: Callable[[Channel], FoundT]) -> FoundT:
        """Run one request; close the channel if the device has gone."""
        channel = self._channel
        if channel is None:
            raise HandLost("the driver is not connected to the hand", hint="call open() first")
        try:
            return request(channel)
        except HandTimeout:
            raise
        except HandError:
            self._close_channel()
            raise
