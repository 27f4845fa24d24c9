"""``sim-dex1``: a Dex1-1 gripper that is only mechanics, with no device or wire under it.

The command in force stays in force until the next one, as in the real motor. Nothing is said about
temperature, voltage or noise of the product; those stay NaN.
"""

from __future__ import annotations

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock, RealClock
from dexkit.emulators.dex1_body import STEP, Dex1Body
from dexkit.emulators.mechanics import FixedSteps
from dexkit.errors import HandLost, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, Side
from dexkit.models import DEX1_1

__all__ = ["STEP", "SimHand", "sim_dex1"]

_MOST_CATCH_UP = 0.5  # seconds; a longer pause of the caller is not lived through


class SimHand:
    """A simulated Dex1-1.

    :param side: which hand.
    :param object_pct: opening at which the jaws touch an object, percent of 5.4 rad; None for
        no object.
    :param start_pct: opening at ``open``. Not 0 by default: some clients wait for a position
        that is not exactly zero.
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a percentage is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_pct: float | None = None,
        start_pct: float = 20.0,
        clock: Clock | None = None,
    ) -> None:
        self._spec = DEX1_1.spec(side, io_rate=1000.0, exchange_timeout=0.1, simulated=True)
        self._clock: Clock = clock or RealClock()
        self.body = Dex1Body(object_pct=object_pct, start_pct=start_pct)
        self.joint = self.body.joint
        self._open = False
        self._steps = FixedSteps(STEP, most=_MOST_CATCH_UP)

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
        self.joint.dq = 0.0

    def exchange(self, command: HandCommand) -> HandState:
        """Live up to now under the command before, take this one, and say where the jaws are.

        :raises HandLost: the hand is not open.
        """
        if not self._open:
            raise HandLost("the simulated hand is not open")
        now = self._clock.now()
        self.body.step(self._steps.due(now))
        self._use(command)
        return HandState.of(
            self.joint.q,
            dq=self.joint.dq,
            tau_est=self.body.torque,
            mode=self.body.mode,
            stamp=now,
        )

    def _use(self, command: HandCommand) -> None:
        if not command.mode[0]:
            self.body.brake()
            return
        self.body.drive(
            float(command.q[0]),
            float(command.dq[0]),
            float(command.tau[0]),
            float(command.kp[0]),
            float(command.kd[0]),
        )


def _percent(options: BackendOptions, key: str) -> float | None:
    text = options.settings.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"{key}={text} is not a percentage") from None


def _make(options: BackendOptions) -> SimHand:
    start = _percent(options, "start")
    return SimHand(
        options.side,
        object_pct=_percent(options, "object"),
        start_pct=20.0 if start is None else start,
    )


sim_dex1 = Backend(
    summary="Simulated Dex1-1 gripper: mechanics only, no device",
    model=DEX1_1.name,
    make=_make,
    settings={
        "object": "percent of opening at which an object is touched (default: no object)",
        "start": "percent of opening at first (default: 20)",
    },
)
