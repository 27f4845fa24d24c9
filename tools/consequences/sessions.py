"""What the users of a hand do in a day, as sessions of clients with a hand on the virtual clock.

Each session measures figures: the same of a wrong hand as of the reference, which are compared in
:mod:`tools.consequences.kinds`.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dexkit.conformance.hands import under_test
from dexkit.conformance.kit.motor_messages import Motor
from dexkit.conformance.stimuli import CommandSession
from dexkit.conformance.stimuli.script import object_places
from dexkit.conformance.virtual import Service
from dexkit.hand import Floats, JointMode, Side, Subject
from dexkit.models import Dialect
from dexkit.teleop import Pose
from tools.consequences.clients import Example, Script, Teleoperation, closed
from tools.consequences.stage import Client, Figure, Stage

__all__ = ["SESSIONS", "measure"]

RIVAL = 1000
"""Number of the second client."""
_OPEN, _SHUT = 0.03, 0.97
"""How far an operator opens and closes: short of the stops."""
_HALF = 1.3
"""Seconds for half a stroke: of a gripper that is slow and late, too."""
_PATIENCE = 5.0
"""Seconds for which an operator waits for a client."""
_NO_GRIP = 0.01
"""N m: a joint that presses with less does not."""
_SHARE = {Side.LEFT: 1.0, Side.RIGHT: 0.8}
"""Part of each goal that a side gets: both never do the same, so that swapped sides show."""
_TOUCH_UNITS = {"dex3-1": 2e4, "inspire-ftp": 400.0}
"""Counts of an element that are 1 in a figure of touch, of the models whose touch is read."""
"""About what a grip adds to an element of touch."""


class Session:
    """A stage, and the figures that have been measured on it.

    :param name: of the client.
    """

    def __init__(
        self,
        name: str,
        made: type[Service],
        spoken: Dialect,
        sides: Sequence[Side],
        touch: Mapping[Subject, float],
    ) -> None:
        self.name = name
        self.stage = Stage(made, spoken, sides, touch)
        self.dialect, self.sides = spoken, tuple(sides)
        self.figures: dict[Figure, float] = {}
        self.grip: dict[Side, Floats] = {}

    # ------------------------------------------------------------------------------ to measure

    def add(self, kind: str, task: str, side: Side, values: Sequence[float] | Floats) -> None:
        """A figure of each joint."""
        for joint, value in enumerate(values):
            self.figures[Figure(kind, self.name, task, str(side), joint)] = float(value)

    def places(self, side: Side, since: float) -> tuple[Floats, Floats]:
        """(seconds since then, place of each joint) as is true."""
        first = bisect_left(self.stage.times, since)
        return np.asarray(self.stage.times[first:]) - since, self.stage.places(side, since)

    def forces(self, side: Side, since: float) -> Floats:
        """Force of contact of each joint, means of 50 ms."""
        values = self.stage.forces(side, since)
        whole = len(values) // 5 * 5
        return np.asarray(values[:whole].reshape(-1, 5, values.shape[1]).mean(axis=1))

    # --------------------------------------------------------------------------- to do and measure

    def parts(self, side: Side, goal: Pose) -> Floats:
        """A goal in parts of each joint's range."""
        return self.stage.part(side, goal)

    def start(self, client: Client, task: str) -> Client:
        """A client starts: how long until it commands."""
        at = self.stage.now
        self.stage.connect(client)
        self.stage.run(0.7)
        while client.began is None and self.stage.now - at < _PATIENCE:
            self.stage.run(0.5)
        waited = math.inf if client.began is None else client.began - at
        for side in self.sides:
            self.add("starts", task, side, [waited])
            _, places = self.places(side, at)
            goal = self.parts(side, client.goals[side])
            self.add("moves", task, side, _outside(places, goal))
        return client

    def move(
        self,
        task: str,
        goals: Mapping[Side, Pose],
        seconds: float,
        *,
        settles: bool = True,
        hurried: bool = False,
    ) -> None:
        """New goals at once: how long a joint takes, how far it comes, and where it ends.

        :param settles: there is time enough for a slow hand, too.
        :param hurried: the move before has not ended when this one begins.
        """
        client = self.stage.client
        assert client is not None
        since = self.stage.now
        client.goals = {**client.goals, **goals}
        self.stage.run(seconds)
        for side in self.sides:
            if side not in client.goals:
                continue
            goal = self.parts(side, client.goals[side])
            t, places = self.places(side, since)
            if settles:
                self.add("ends", task, side, places[-5:].mean(axis=0))
            way = goal - places[0]
            took, made = np.full(len(goal), np.nan), np.full(len(goal), np.nan)
            for joint, length in enumerate(way):
                if abs(length) < 0.2:
                    continue
                progress = (places[:, joint] - places[0, joint]) / length
                # a hand that ends short by less than counts has arrived
                there = np.flatnonzero(progress >= 1.0 - max(0.1, 0.05 / abs(length)))
                late = math.inf if settles else math.nan  # too soon to say
                took[joint] = t[there[0]] if len(there) else late
                made[joint] = max(0.0, float(progress.max()))
            self.add("lags", task, side, took)
            self.add("misses", task, side, made)
            if not hurried:
                self.add("moves", task, side, _outside(places, goal))

    def follow(self, task: str, low: float, high: float, period: float, seconds: float) -> None:
        """The operator moves to and fro slowly: how much later the hand follows."""
        client = self.stage.client
        assert client is not None
        since, sides = self.stage.now, list(client.goals)

        def course(now: float) -> Mapping[Side, Pose]:
            swing = 0.5 - 0.5 * math.cos(2 * math.pi * (now - since) / period)
            every = _both(self, low + (high - low) * swing)
            return {s: every[s] for s in sides}

        client.course = course
        self.stage.run(seconds)
        client.goals, client.course = dict(course(self.stage.now)), None
        for side in sides:
            t, places = self.places(side, since)
            goal = np.array([self.parts(side, course(since + x)[side]) for x in t])
            self.add(
                "lags", task, side, [_delay(g, p) for g, p in zip(goal.T, places.T, strict=True)]
            )
            self.add(
                "misses", task, side, np.ptp(places, axis=0) / np.maximum(np.ptp(goal, axis=0), 0.1)
            )

    def still(self, task: str, seconds: float, *, kind: str = "moves", after: float = 0.0) -> None:
        """Nothing new is commanded: how far each joint moves.

        :param after: seconds from now that do not count.
        """
        self.stage.run(after)
        since = self.stage.now
        self.stage.run(seconds)
        for side in self.sides:
            _, places = self.places(side, since)
            self.add(kind, task, side, np.abs(places - places[0]).max(axis=0))

    def hold(self, task: str, seconds: float) -> None:
        """An object is held: how hard."""
        self.stage.run(0.6)
        since = self.stage.now
        self.stage.run(seconds)
        self.feel(task)
        for side in self.sides:
            self.grip[side] = np.median(self.forces(side, since), axis=0)
            self.add("presses", task, side, self.grip[side])
        self._held(task, since)

    def _held(self, task: str, since: float) -> None:
        """How hard at most, and how little."""
        for side in self.sides:
            forces = self.forces(side, since)
            self.add("presses", f"{task}: most", side, forces.max(axis=0))
            self.add("drops", task, side, [forces.sum(axis=1).min()])

    def feel(self, task: str) -> None:
        """What the elements of touch read, of hands whose touch clients read."""
        unit = _TOUCH_UNITS.get(self.dialect.model)
        for side in self.sides if unit else ():
            touch = self.stage.touch(side)
            values = np.nan_to_num(np.array(touch) / unit, nan=math.inf)
            self.add("touch", task, side, values)

    def held_through(self, task: str, seconds: float) -> None:
        """Something happens while an object is held."""
        since = self.stage.now
        self.stage.run(seconds)
        self._held(task, since)

    def gone(self, task: str, seconds: float = 1.2) -> None:
        """The client has been stopped: what moves and presses after the time-out."""
        self.stage.connect(None)
        self.still(task, seconds, kind="left moving", after=1.3)
        self.left(task)

    def left(self, task: str) -> None:
        """How much of the last grip is left."""
        for side, grip in self.grip.items():
            force = self.forces(side, self.stage.now - 0.4).mean(axis=0)
            known = np.where(grip > _NO_GRIP, grip, np.nan)
            self.add("left pressing", task, side, force / known)
            self.add("lets go", task, side, [force.sum() / max(grip.sum(), _NO_GRIP)])

    def seen(self) -> dict[Side, Pose]:
        """The last q that a client has read of each side; where nothing was read, where it is."""
        found = {}
        for side in self.sides:
            low, stroke = self.stage.limits[side]
            _, shown = self.stage.shown(side)
            places = shown[-1] if len(shown) else self.stage.places(side)[-1]
            found[side] = tuple((places * stroke + low).tolist())
        return found

    def records(self, task: str) -> None:
        """What the client has read, against what was true within the last 0.1 s."""
        times = np.array(self.stage.times)
        for side in self.sides:
            at, shown = self.stage.shown(side)
            places = self.stage.places(side)
            if not len(at):
                continue
            # each state when it comes, and what a frame holds between two of them
            rows = np.minimum(np.searchsorted(times, at), len(times) - 1)
            newest = np.searchsorted(at, times, "right") - 1
            held = (newest >= 0) & self.stage.driven()
            rows = np.concatenate((rows, np.flatnonzero(held)))
            shown = np.concatenate((shown, shown[newest[held]]))
            window = np.stack([places[np.maximum(rows - i, 0)] for i in range(11)])
            self.add("reads", task, side, _apart(shown, window))

    def low_rate(self) -> None:
        """What the low-rate copies held, against what was true within 0.2 s."""
        times = np.array(self.stage.times)
        for side in self.sides:
            places = self.stage.places(side)
            worst: Floats = np.zeros(places.shape[1])
            for now, shown in self.stage.low.get(side, ()):
                window = places[(times > now - 0.2) & (times <= now + 0.01)]
                if len(window):
                    worst = np.maximum(worst, _apart(shown[np.newaxis], window[:, np.newaxis]))
            self.add("reads", "the low-rate copy", side, worst)


def _apart(shown: Floats, window: Floats) -> Floats:
    """How far each joint was shown from all places of its window, at the most.

    :param window: first the places, then as ``shown``.
    """
    off = np.maximum(window.min(axis=0) - shown, shown - window.max(axis=0))
    return np.asarray(np.nan_to_num(off, nan=math.inf).max(axis=0))


def _outside(places: Floats, goal: Floats) -> Floats:
    """How far each joint goes beyond its way from where it is to its goal."""
    low, high = np.minimum(places[0], goal), np.maximum(places[0], goal)
    return np.asarray(np.maximum(np.maximum(low - places, places - high).max(axis=0), 0.0))


def _delay(goal: Floats, place: Floats) -> float:
    """Seconds by which a place follows its goal; infinite if it hardly does."""
    if np.ptp(place) < 0.3 * np.ptp(goal):
        return math.inf
    shifts = range(0, 60)
    use = slice(60, None)
    errors = [float(np.square(place[use] - goal[60 - k : len(goal) - k]).mean()) for k in shifts]
    return 0.01 * float(np.argmin(errors))


class Pace(NamedTuple):
    """How quickly an operator moves a hand: no quicker than good ones follow.

    :ivar stroke: seconds for a whole stroke.
    :ivar quick: for a stroke that is not waited for.
    :ivar joint: for a joint alone.
    :ivar settled: after which a hand that hears nothing has arrived.
    """

    stroke: float = 1.2
    quick: float = 0.5
    joint: float = 0.35
    settled: float = 0.3


def _pace(spoken: Dialect) -> Pace:
    """That of a gripper is for a slow one at xr_teleoperate's lead; that of a position servo for
    one of half the speed, or that obeys 0.2 s late as real ones do
    (docs/sources/real-hands.md#dfx-begin).
    """
    if spoken.position_servo:
        return Pace(stroke=1.8, quick=0.9, joint=0.9, settled=0.9)
    return Pace(stroke=1.8) if spoken.is_gripper else Pace()


def _both(session: Session, *parts: float) -> dict[Side, Pose]:
    """A goal of every side: not the same, so that it shows when they are exchanged."""
    return {
        s: closed(session.dialect, s, [part * _SHARE[s] for part in parts]) for s in session.sides
    }


# ----------------------------------------------------------------------------------- the sessions


def teleoperate(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> Session:
    """A day with xr_teleoperate and free hands."""
    s = Session("xr_teleoperate", made, spoken, sides, {})
    pace = _pace(spoken)
    stroke = pace.stroke
    s.still("before the first client", 1.2)
    client = Teleoperation(spoken, sides)
    client.goals = _both(s, 0.5)
    s.start(client, "start")
    s.move("a first stroke", _both(s, _OPEN), stroke)
    s.move("close", _both(s, _SHUT), stroke)
    s.move("open", _both(s, _OPEN), stroke)
    s.move("half way", _both(s, 0.5), _HALF)
    s.still("hold still", 1.0)
    s.move("a small step", _both(s, 0.42), 1.0)
    s.follow("follow slowly", 0.1, 0.9, 3.0, 4.5)
    s.move("half way again", _both(s, 0.5), _HALF, hurried=True)
    for i, part in enumerate((_SHUT, _OPEN, _SHUT, _OPEN)):
        s.move(f"quickly {i + 1}", _both(s, part), pace.quick, settles=False, hurried=True)
    s.move("to rest", _both(s, 0.5), _HALF, hurried=True)
    _one_at_a_time(s, client)
    _events(s, client)
    s.records("all that it reads")
    return s


def _one_at_a_time(s: Session, client: Teleoperation) -> None:
    """One side, then one joint of each, moves alone; the others must not."""
    if len(s.sides) > 1:
        for side in s.sides:
            s.move(f"only {side}", {side: closed(s.dialect, side, (_SHUT,))}, _HALF)
            s.move(f"only {side} back", {side: closed(s.dialect, side, (0.5,))}, _HALF)
    joints, seconds = s.stage.codec.joints, _pace(s.dialect).joint
    if joints == 1:
        return
    for joint in range(joints):
        parts = [0.5] * joints
        parts[joint] = 0.9
        s.move(f"joint {joint} alone", _both(s, *parts), seconds, settles=False)
    s.move("all back", _both(s, 0.5), 0.8)


def _events(s: Session, client: Teleoperation) -> None:
    """What goes wrong in a life."""
    stage, codec = s.stage, s.stage.codec
    mid, pace = _both(s, 0.5), _pace(s.dialect)
    stroke = pace.stroke

    # a slow subscriber joins: a viewer that does not keep up
    stage.service.loaded = True
    s.follow("follow while a slow viewer is there", 0.2, 0.8, 2.0, 3.0)
    stage.service.loaded = False
    s.move("half way after it", mid, _HALF, hurried=True)

    # the network pauses in a move, for less and for longer than the time-out
    for seconds in (0.4, 1.4):
        client.goals = _both(s, _SHUT)
        stage.run(0.15)
        stage.connected = False
        stage.run(min(seconds, pace.settled))
        if seconds > pace.settled:
            s.still(f"network away for {seconds} s", seconds - pace.settled)
        client.goals = _both(s, 0.3)
        stage.run(0.1)
        stage.connected = True
        s.move(f"open after {seconds} s", _both(s, _OPEN), stroke)
        s.move(f"half way after {seconds} s", mid, _HALF)

    hold = Script(s.dialect, s.sides)
    good = {side: hold.motors(side, q) for side, q in mid.items()}
    bad = _with_nan(good)
    if codec.holds_nan:
        _nan(s, bad)

    # a script sends degrees, then radians again; or beyond the range a little
    far = {side: [replace(m, q=m.q * 57.3 + 300.0) for m in ms] for side, ms in good.items()}
    near = _beyond(s, good)
    stage.connect(None)
    for name, wrong in (("degrees", far), ("a little too far", near)):
        _burst(s, wrong, round(100 * stroke))
        for side in s.sides:
            s.add("ends", name, side, stage.places(side, stage.now - 0.05)[-1])
    stage.connect(client)
    s.move(f"half way after {name}", mid, _HALF)

    more = [Motor(mode=codec.mode(0))] * codec.joints
    # a message without motors, with too few, with too many; of another hand's type
    for name, payloads in (
        ("empty messages", codec.encode_empty(s.sides)),
        ("short messages", codec.encode_shorter(good) if codec.joints > 1 else []),
        ("long messages", codec.encode_longer(good, more) if codec.holds_nan else []),
    ):
        for _ in range(20):
            stage.send(payloads, 0)
            stage.run(0.01)
        s.still(name, 0.3)
    foreign = codec.encode_foreign(
        {side: hold.motors(side, closed(s.dialect, side, (_SHUT,))) for side in s.sides}
    )
    for _ in range(20):
        for topic, payload in foreign:
            stage.service.foreign(topic, codec.foreign.name, payload)
        stage.run(0.01)
    s.still("messages of another type", 0.3)

    # two clients by mistake
    other = Script(s.dialect, s.sides)
    rival = codec.encode({side: other.motors(side, q) for side, q in _both(s, 0.7).items()})
    for _ in range(100):
        stage.send(rival, RIVAL)
        stage.run(0.01)
    s.move("half way when the second client has gone", mid, _HALF)
    s.move("close when the second client has gone", _both(s, _SHUT), stroke)

    twin = codec.encode({side: other.motors(side, q) for side, q in _both(s, _OPEN).items()})
    client.goals = _both(s, _OPEN)
    for _ in range(round(100 * stroke)):
        stage.send(twin, RIVAL)
        stage.run(0.01)
    for side in s.sides:
        s.add("ends", "open with two clients that agree", side, stage.places(side)[-1])
    s.move("half way with one of them", mid, _HALF)

    # stopped in a move, and started again
    client.goals = _both(s, _OPEN)
    stage.run(0.15)
    s.gone("stopped in a move")
    second = Teleoperation(s.dialect, s.sides, 1)
    second.goals = mid
    s.start(second, "a second client")
    s.move("close, second client", _both(s, _SHUT), stroke)
    s.move("open, second client", _both(s, _OPEN), stroke)
    if codec.holds_nan:
        s.still("a NaN of the second client", 0.4, after=_burst(s, bad, 10, 1))

    # the hand's service is restarted; the client goes on, if it can
    s.move("to rest before the restart", mid, _HALF)
    s.gone("stopped before the restart")
    stage.restart()
    s.still("the service restarts", 2.2)
    s.still("after the restart", 0.8)
    if not s.dialect.is_gripper:  # its process has no way to a new reader
        second = Teleoperation(s.dialect, s.sides, 2)
    second.goals, second.began = mid, None
    s.start(second, "a client after the restart")
    s.move("close after the restart", _both(s, _SHUT), stroke)
    s.move("open after the restart", _both(s, _OPEN), stroke)

    # its computer's clock is behind
    second.stamp_age = 5.0
    s.move("close, with a clock that is behind", _both(s, _SHUT), stroke)
    s.move("open, with a clock that is behind", _both(s, _OPEN), stroke)


def _with_nan(good: Mapping[Side, list[Motor]]) -> dict[Side, list[Motor]]:
    """Inverse kinematics fails for one joint."""
    return {side: [replace(m[0], q=math.nan), *m[1:]] for side, m in good.items()}


def _nan(s: Session, bad: Mapping[Side, list[Motor]]) -> None:
    """NaN for one joint, for one cycle and for long; then for one side alone."""
    stroke, hold = _pace(s.dialect).stroke, Script(s.dialect, s.sides)
    s.still("one NaN", 0.5, after=_burst(s, bad, 1))
    s.still("a second of NaN", 0.6, after=_burst(s, bad, 100))
    s.move("close after NaN", _both(s, _SHUT), stroke)
    s.move("open after NaN", _both(s, _OPEN), stroke)
    if len(s.sides) > 1:
        first, other = s.sides
        mixed = {side: hold.motors(side, q) for side, q in _both(s, _SHUT).items()}
        _burst(s, {**mixed, first: bad[first]}, round(100 * stroke))
        s.add("ends", "NaN for the other side", other, s.stage.places(other)[-1])
        s.move("half way after NaN for one side", _both(s, 0.5), _HALF)


def _beyond(s: Session, good: Mapping[Side, list[Motor]]) -> dict[Side, list[Motor]]:
    """Goals a tenth of the range beyond the closed ends."""
    found = {}
    for side, motors in good.items():
        low, stroke = s.stage.limits[side]
        shut = s.parts(side, closed(s.dialect, side, (1.0,)))
        goals = np.where(shut > 0.5, 1.1, -0.1) * stroke + low
        found[side] = [replace(m, q=float(q)) for m, q in zip(motors, goals, strict=True)]
    return found


def _burst(s: Session, motors: Mapping[Side, list[Motor]], count: int, number: int = 0) -> float:
    """Send so many commands at the client's rate, in place of the client's own; then it goes on."""
    payloads = s.stage.codec.encode(motors)
    client, s.stage.client = s.stage.client, None
    for _ in range(count):
        s.stage.send(payloads, number)
        s.stage.run(0.01)
    s.stage.client = client
    if client is not None:
        client.due = s.stage.now
    return 0.0


def grasp(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> Session:
    """xr_teleoperate with an object in each hand: grasp, lift, let go, and what goes wrong."""
    percents = under_test(spoken.model).objects
    percent = next(iter(percents.values()))
    touch = object_places(spoken, dict.fromkeys(sides, percent))
    s = Session("xr_teleoperate", made, spoken, sides, touch)
    stage = s.stage
    stage.run(0.3)
    client = Teleoperation(spoken, sides)
    client.goals = _both(s, 0.2)
    s.start(client, "start with an object")
    stage.run(0.5)
    s.feel("before the grip")
    deep = _both(s, 0.95)
    s.move("grasp", deep, _HALF)
    s.hold("lift", 3.0)
    s.move("let go", _both(s, 0.1), _HALF)
    s.move("grasp again", deep, _HALF)
    s.hold("lift again", 1.0)
    if len(sides) > 1:  # one side works while the other one holds
        for part, task in ((0.1, "let go with one side"), (0.95, "grasp with one side")):
            s.move(task, {sides[0]: closed(spoken, sides[0], (part,))}, _HALF)
            s.feel(task)
    hold = Script(spoken, sides)
    if stage.codec.holds_nan:
        bad = _with_nan({side: hold.motors(side, q) for side, q in deep.items()})
        stage.send(stage.codec.encode(bad), 0)
        s.held_through("NaN in a grip", 0.3)
        _burst(s, bad, 220)
        s.left("two seconds of NaN in a grip")
        s.move("grasp after NaN", deep, _HALF)
    stage.connected = False
    s.held_through("network away for 0.9 s in a grip", 0.9)
    stage.connected = True
    s.held_through("network back in a grip", 0.5)
    s.gone("stopped in a grip", 2.4)
    second = Teleoperation(spoken, sides, 1)
    second.goals = deep
    s.start(second, "a second client in a grip")
    s.hold("lift, second client", 0.6)
    s.move("let go, second client", _both(s, 0.1), _HALF)
    s.move("grasp, second client", deep, _HALF)
    s.hold("lift once more", 0.4)
    stage.connect(None)
    stage.restart()
    # genuine servos keep their last goal, and with it the grip (docs/sources/unitree-dex.md#j2)
    lets_go = not spoken.position_servo
    for task, seconds in (("has ended", 1.9), ("starts", 0.9)):
        s.still(f"the service {task} in a grip", seconds, kind="left moving")
        if lets_go:
            s.left(f"the service {task} in a grip")
    third = Teleoperation(spoken, sides, 2)
    third.goals = deep
    s.start(third, "a client after a restart in a grip")
    s.hold("lift after the restart", 0.6)
    s.move("let go after the restart", _both(s, 0.1), _HALF)
    s.move("grasp after the restart", deep, _HALF)
    if not spoken.position_servo:
        # LeRobot disconnects: one command without gains, where the hand is
        # (docs/sources/lerobot.md#a1)
        stage.connect(None)
        limp = {
            side: [replace(m, kp=0.0, kd=0.0) for m in hold.motors(side, q)]
            for side, q in s.seen().items()
        }
        stage.send(stage.codec.encode(limp), 2)
        stage.run(0.6)
        s.left("disconnected without gains")
    s.records("all that it reads with an object")
    return s


def listen(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> Session:
    """A ROS 2 node with the usual, reliable, reader listens: whether it gets a state."""
    s = Session("a ROS 2 node", made, spoken, sides, {})
    s.stage.run(0.8)
    heard = s.stage.published and s.stage.service.writer_reliability == "reliable"
    for side in sides:
        s.add("starts", "listens", side, [0.0 if heard else math.inf])
    return s


def example(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> Session:
    """Unitree's example program: turns, grips and stops one hand; other models have none."""
    s = Session("Unitree's example", made, spoken, sides, {})
    if spoken.model not in Example.MODELS:
        return s
    stage = s.stage
    stage.run(0.8)
    if spoken.low_rate_topic:
        for side in sides:
            s.add("starts", "the low-rate copy", side, [0.0 if stage.low else math.inf])
    used = sides if spoken.commands_both else sides[:1]
    client = Example(spoken, used)

    def every(part: float) -> dict[Side, Pose]:
        return {side: closed(spoken, side, (part,)) for side in used}

    client.goals = every(_OPEN)
    stage.connect(client)
    if spoken.is_gripper:
        stage.run(_pace(spoken).stroke)
        s.follow("to and fro", _OPEN, _SHUT, 4.0, 6.0)
    else:
        client.gains, client.period = client.TURN, client.fast
        for i, part in enumerate((0.3, 0.7, 0.3, 0.7)):
            s.move(f"turn {i}", every(part), 0.5, settles=False)
        client.gains, client.period, client.timeout = client.GRIP, 1.0, True
        s.move("grip", every(0.5), 2.5)
        client.gains, client.status = client.STOP, int(JointMode.FOC)
        stage.run(2.2)  # limp: it may sink
        client.gains, client.timeout, client.period = client.TURN, False, client.fast
        s.move("turn again", every(0.3), 1.0)
    s.gone("ended")
    s.low_rate()
    return s


def replay(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> Session:
    """A recorded session of the genuine controllers, replayed as it is."""
    s = Session("a replay", made, spoken, sides, {})
    if not under_test(spoken.model).session:
        return s
    session = CommandSession.default(spoken.model)
    sides = [side for side in sides if side in session.sides]
    stage = s.stage
    stage.run(0.8)
    begin = stage.now
    for at, motors in session.timeline(sides, spoken):
        if at / 1e9 + begin > stage.now:
            stage.run(at / 1e9 + begin - stage.now)
        stage.send(stage.codec.encode(motors), 0)
    for side in sides:
        _, places = s.places(side, begin)
        s.add("ends", "the end of the session", side, places[-1])
        s.add("misses", "the session", side, np.ptp(places, axis=0))
    s.gone("the end of the session")
    return s


SESSIONS: tuple[Callable[[type[Service], Dialect, Sequence[Side]], Session], ...] = (
    teleoperate,
    grasp,
    listen,
    example,
    replay,
)


def measure(made: type[Service], spoken: Dialect, sides: Sequence[Side]) -> dict[Figure, float]:
    """All figures of a hand."""
    found: dict[Figure, float] = {}
    for session in SESSIONS:
        figures = session(made, spoken, sides).figures
        assert not found.keys() & figures.keys(), "two sessions measure the same"
        found |= figures
    return found
