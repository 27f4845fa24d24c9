"""Settings of an emulated robot. Values are assumed unless a source is named."""

from __future__ import annotations

from dataclasses import dataclass, field

from dexkit.errors import UsageError

__all__ = ["Remote", "Settings"]

STEP = 0.002  # seconds of a step of the mechanics: one state


@dataclass(frozen=True)
class Settings:
    """Parameters of an emulated robot.

    The joints of Unitree's robots range from 5 to 300 N·m. Inertia and friction are proportional to
    that, so all joints accelerate alike.

    :param acceleration: of a joint under its full torque, rad/s².
    :param coulomb: friction torque, part of the joint's full torque.
    :param viscous: friction torque per rad/s, part of the joint's full torque.
    :param command_timeout: seconds without a command after which the robot damps; None takes the
        model's.
    :param lenient: obey any mode byte but 0, and commands whose ``mode_machine`` is another
        robot's.
    :param noise: standard deviation of the IMU's readings: 1 is that of a plain MEMS unit
        (0.005 rad/s, 0.05 m/s²), 0 none.
    :param seed: of that noise.
    :param ambient: temperature of all motors at first, degrees Celsius.
    :param heating: temperature rise of a motor after a long time at full torque, K.
    :param warm_up: time constant of warming up, seconds.
    :param idle_power: W that the computers draw.
    :param capacity: of the battery, W·h.
    :param charge: of the battery at first, percent.
    """

    acceleration: float = 1000.0
    coulomb: float = 0.005
    viscous: float = 0.005  # 200 N·m: 1 N·m·s/rad, as in unitree_ros h1_description/mjcf/h1.xml
    command_timeout: float | None = None
    lenient: bool = False
    noise: float = 0.0
    seed: int = 0
    ambient: float = 30.0
    heating: float = 70.0
    warm_up: float = 120.0
    idle_power: float = 100.0
    capacity: float = 864.0
    charge: float = 90.0

    def __post_init__(self) -> None:
        if not (self.acceleration > 0 and self.coulomb >= 0 and self.viscous >= 0):
            raise UsageError("a robot needs acceleration, and friction that is not negative")
        if self.command_timeout is not None and not self.command_timeout > 0:
            raise UsageError(f"a time-out must be positive, not {self.command_timeout}")
        if self.noise < 0:
            raise UsageError(f"noise must not be negative, got {self.noise}")
        # the SDK's CRC cannot pack temperatures above 127 (docs/sources/unitree-dex.md#a7)
        if not 0 <= self.ambient <= 127 or not 0 <= self.heating <= 127 - self.ambient:
            raise UsageError("a motor's temperature must stay between 0 and 127 degrees")
        if not 0 <= self.charge <= 100:
            raise UsageError(f"the charge of a battery is 0 to 100 %, not {self.charge}")


@dataclass(frozen=True)
class Remote:
    """The wireless remote: which keys are held, where the sticks stand.

    :param keys: of :attr:`KEYS`.
    :param sticks: of :attr:`STICKS`, each -1 to 1; those not named are at 0.
    :raises UsageError: there is no such key or stick.

    Names and bits are from "Remote Control Data" in Unitree's G1 developer pages.
    """

    keys: frozenset[str] = frozenset()
    sticks: dict[str, float] = field(default_factory=dict)

    KEYS = (
        *("R1", "L1", "start", "select", "R2", "L2", "F1", "F2"),
        *("A", "B", "X", "Y", "up", "right", "down", "left"),
    )
    STICKS = ("lx", "rx", "ry", "ly")

    def __post_init__(self) -> None:
        for key in self.keys:
            if key not in self.KEYS:
                raise UsageError(
                    f"the remote has no key {key!r}", hint=f"keys: {', '.join(self.KEYS)}"
                )
        for name, value in self.sticks.items():
            if name not in self.STICKS:
                raise UsageError(
                    f"the remote has no stick {name!r}", hint=f"sticks: {', '.join(self.STICKS)}"
                )
            if not -1 <= value <= 1:
                raise UsageError(f"the position of a stick is -1 to 1, not {value}")

    @classmethod
    def parse(cls, text: str) -> Remote:
        """A remote from ``"A,R1,lx=0.5"``: keys, and sticks with their positions; empty: let go.

        :raises UsageError: the text has another form.
        """
        keys, sticks = set(), {}
        for word in filter(None, (part.strip() for part in text.split(","))):
            name, equals, value = word.partition("=")
            if not equals:
                keys.add(name)
                continue
            try:
                sticks[name] = float(value)
            except ValueError:
                raise UsageError(
                    f"{word!r}: no position of the stick is given", hint="for example lx=0.5"
                ) from None
        return cls(frozenset(keys), sticks)

    @property
    def bits(self) -> int:
        """The keys held, as in the remote's 16-bit word."""
        return sum(1 << i for i, key in enumerate(self.KEYS) if key in self.keys)
