"""Decide which commands of a client are fresh, although they have no timestamp.

LeRobot's commands have no timestamp. Its socket keeps the newest command and sends it again to a
restarted server, however old it is; commands sent during a network outage or a pause of this
program wait in buffers. So a command that may have waited does not count: after a connection, a
pause of this program or a gap between commands, commands must arrive steadily for a while first.
"""

from __future__ import annotations

from dexkit.clock import Clock
from dexkit.command_age import PAUSE, QUIET, PauseWatch

__all__ = ["CommandStream"]


class CommandStream:
    """The command stream of the connected client. For one thread.

    A command counts if commands have come for more than
    :data:`~dexkit.command_age.QUIET` seconds without a gap of more than
    :data:`~dexkit.command_age.PAUSE`, from exactly one client.

    :param clock: :meth:`~dexkit.clock.Clock.since_boot` of it is used.

    :ivar clients: connections that are open.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._watch = PauseWatch(clock)
        self._began: float | None = None  # of the commands without a gap
        self._last = 0.0
        self.clients: set[int] = set()

    def detect_pause(self) -> float:
        """Detect a pause of this program. Call it periodically, and before :meth:`counts`.

        :returns: seconds that this program was paused until now, or 0.
        """
        away = self._watch.measure_pause()
        if away:
            self._began = None
        return away

    def connected(self, client: int) -> None:
        """A client has connected; it may first send an old command."""
        self.clients.add(client)
        self._began = None

    def disconnected(self, client: int) -> None:
        """A client has disconnected."""
        self.clients.discard(client)
        self._began = None

    def counts(self) -> bool:
        """Note a command; return whether it counts."""
        now = self._clock.since_boot()
        last, self._last = self._last, now
        if self._began is None or now - last > PAUSE:
            self._began = now
        return now - self._began > QUIET and len(self.clients) == 1
