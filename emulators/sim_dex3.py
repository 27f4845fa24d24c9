"""``sim-dex3``: a Dex3-1 that is only a body, with no device or wire around it.

See :mod:`dexkit.emulators.dex3_body` for what is modelled, what is tuned and what is not there.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.emulators.dex3_body import STEP, Dex3Body
from dexkit.emulators.mechanics import FixedSteps
from dexkit.errors import HandLost, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, Side
from dexkit.models import DEX3_1

__all__ = ["SimDex3", "sim_dex3"]


class SimDex3:
    """A simulated Dex3-1.

    :param side: which hand.
    :param object_at: how far the fingers close until they touch an object, percent; None for no
        object.
    :param start: how far they are closed at ``open``, percent; None for a relaxed pose, which
        is not all zero, because clients wait for a position that is not.
    :param supply_v: voltage of the supply, V.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_at: float | None = None,
        start: float | None = None,
        supply_v: float = 24.0,
        clock: Clock | None = None,
    ) -> None:
        self._spec = DEX3_1.spec(
            side, io_rate=DEX3_1.state_rate, exchange_timeout=0.1, simulated=True
        )
        self._clock: Clock = clock or RealClock()
        self._steps = FixedSteps(STEP)
        self._open = False
        self.body = Dex3Body(side, object_at=object_at, start=start, supply_v=supply_v)

    @property
    def spec(self) -> HandSpec:
        """What this hand is."""
        return self._spec

    def open(self) -> None:
        """Start to live; brakes until the first command."""
        self.body.brake()
        self._steps.restart(self._clock.now())
        self._open = True

    def close(self) -> None:
        """Stop where it is."""
        self._open = False
        self.body.stop()

    def exchange(self, command: HandCommand) -> HandState:
        """Live up to now under the command before, take this one, and say where the hand is.

        :raises HandLost: the hand is not open.
        """
        if not self._open:
            raise HandLost("the simulated hand is not open")
        now = self._clock.now()
        self.body.step(self._steps.due(now))
        self.body.use(command)
        return self.body.state(now)


def _number(options: BackendOptions, key: str) -> float | None:
    text = options.settings.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{key}={text} is not a number") from None


def _make(options: BackendOptions) -> SimDex3:
    supply = _number(options, "supply")
    return SimDex3(
        options.side,
        object_at=_number(options, "object"),
        start=_number(options, "start"),
        supply_v=24.0 if supply is None else supply,
    )


sim_dex3 = Backend(
    summary="Simulated Dex3-1 hand: motors, touch and heat, no device",
    model=DEX3_1.name,
    make=_make,
    settings={
        "object": "percent of closing at which the fingers touch an object (default: no object)",
        "start": "percent of closing at first (default: relaxed, about 20)",
        "supply": "volts of the supply, 24 to 58 (default: 24)",
    },
)
