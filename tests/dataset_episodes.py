"""Episodes for tests of the checks of datasets: an operator, hands and arms that follow.

Everything is a function of the seed. Hands follow with a delay, a time constant, a limit of speed,
sensor noise and an encoder's steps, and stop at an object.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Judgement, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.hand import Floats, Side
from dexkit.models import HandModel, model

__all__ = ["Plant", "action_of", "blamed", "changed", "episode", "found", "track"]


@dataclass(frozen=True)
class Plant:
    """How a part follows its action.

    :param delay_s: before anything happens; ``tau_s`` is the time constant after it.
    :param fastest: speed limit, strokes per second.
    :param noise: of the sensor, strokes; ``steps`` of the encoder over the stroke, 0 for none.
    :param renew_s: time between two values of the sensor; 0 for a value a frame.
    :param sag: constant offset, strokes.
    :param block: part of the way to closed at which an object stops the hand; None without.
    """

    delay_s: float = 0.04
    tau_s: float = 0.05
    fastest: float = 4.0
    noise: float = 0.0006
    steps: int = 0
    renew_s: float = 0.0
    sag: float = 0.0
    block: float | None = None


def action_of(
    rng: np.random.Generator,
    fps: float,
    seconds: float,
    joints: int,
    *,
    kind: str = "smooth",
    pace: float = 1.0,
    share: float = 1.0,
) -> Floats:
    """Commanded positions as parts of the stroke, 0 open, shape (frames, joints).

    :param kind: ``smooth`` (reaches with pauses), ``apart`` (the same, each joint for itself),
        ``trigger`` (steps), ``opens`` (once, from closed), ``still``, ``tremble`` (smooth and
        never still), ``sine``.
    :param pace: how quick the operator is.
    :param share: of the stroke that is used.
    """
    n = round(seconds * fps)
    t = np.arange(n) / fps
    if kind == "still":
        return np.repeat(rng.uniform(0.1, 0.6, (1, joints)), n, axis=0)
    if kind == "sine":
        phase = rng.uniform(0, 6, joints)
        return 0.5 + 0.4 * share * np.sin(2 * np.pi * 0.5 * pace * t[:, None] + phase)
    if kind == "apart":
        each = [action_of(rng, fps, seconds, 1, pace=pace, share=share) for _ in range(joints)]
        return np.concatenate(each, axis=1)
    q = np.zeros((n, joints))
    weights = rng.uniform(0.6, 1.0, joints)
    now, target = (1.0 if kind == "opens" else 0.05), 0.05
    when = rng.uniform(0.3, 1.0) / pace
    level = np.full(n, now)
    while when < seconds:
        target = 0.05 if now > 0.4 else rng.uniform(0.6, 0.95)
        took = 1e-6 if kind == "trigger" else rng.uniform(0.5, 1.1) / pace
        s = np.clip((t - when) / took, 0, 1)
        level = np.where(
            t >= when, now + (target - now) * (10 * s**3 - 15 * s**4 + 6 * s**5), level
        )
        now = target
        when += took + rng.uniform(0.2, 1.4) / pace
        if kind == "opens":
            break
    q = level[:, None] * weights * share
    if kind != "trigger":
        # fingers do not move together to the millisecond
        late = rng.integers(0, max(1, round(0.08 * fps)) + 1, joints)
        q = np.stack(
            [np.interp(np.arange(n) - k, np.arange(n), q[:, j]) for j, k in enumerate(late)], 1
        )
    if kind == "tremble":
        q = (
            q
            + np.cumsum(rng.normal(0, 0.002, q.shape), axis=0) * 0.3
            + rng.normal(0, 0.001, q.shape)
        )
    return np.asarray(np.clip(q, 0, 1))


def follow(rng: np.random.Generator, action: Floats, fps: float, plant: Plant) -> Floats:
    """What the sensors of a part say while it follows, as parts of the stroke."""
    n, joints = action.shape
    fine = 4
    times = np.arange(n * fine) / (fps * fine)
    goal = action[np.clip(np.floor((times - plant.delay_s) * fps).astype(int), 0, n - 1)]
    q = np.empty((n, joints))
    now = goal[0] if plant.block is None else np.minimum(goal[0], plant.block)
    dt = 1 / (fps * fine)
    gain = 1 - np.exp(-dt / plant.tau_s) if plant.tau_s else 1.0
    for i in range(n * fine):
        if i % fine == 0:
            q[i // fine] = now
        step = np.clip((goal[i] - now) * gain, -plant.fastest * dt, plant.fastest * dt)
        now = now + step
        if plant.block is not None:
            now = np.minimum(now, plant.block)
    q = q + plant.sag
    if plant.noise:
        q = q + rng.normal(0, plant.noise, q.shape)
    if plant.steps:
        q = np.round(q * plant.steps) / plant.steps
    if plant.renew_s * fps > 1:
        every = plant.renew_s * fps
        q = q[(np.floor(np.arange(n) / every) * every).astype(int)]
    return q


def _scaled(part: str, hand: HandModel | None, values: Floats) -> Floats:
    """Parts of the stroke as positions: a hand's by its limits, an arm's within 1.5 rad."""
    if hand is None:
        return values * 1.5 - 0.4
    specs = hand.joints[Side(part.split("_")[0])]
    low = np.array([s.q_max if s.closing < 0 else s.q_min for s in specs])
    high = np.array([s.q_min if s.closing < 0 else s.q_max for s in specs])
    return low + (high - low) * values


def track(
    rng: np.random.Generator,
    part: str,
    fps: float,
    seconds: float,
    *,
    hand: str = "",
    joints: int = 7,
    kind: str = "smooth",
    plant: Plant = Plant(),
    pace: float = 1.0,
    share: float = 1.0,
    fields: bool = False,
    same: str = "",
) -> Track:
    """A part that follows its action.

    :param fields: with velocities and torques.
    :param same: ``state`` for an action that equals the state, ``next`` for the next one.
    """
    profile = model(hand) if hand else None
    count = len(profile.joints[Side.LEFT]) if profile else joints
    a = action_of(rng, fps, seconds, count, kind=kind, pace=pace, share=share)
    s = follow(rng, a, fps, plant)
    state, action = _scaled(part, profile, s), _scaled(part, profile, a)
    if same:
        action = state if same == "state" else np.concatenate([state[1:], state[-1:]])
    dq = tau = None
    if fields:
        dq = np.gradient(state, axis=0) * fps + rng.normal(0, 0.01, state.shape)
        tau = 0.3 * (action - state) + rng.normal(0, 0.003, state.shape)
    names = (
        tuple(j.name for j in profile.joints[Side(part.split("_")[0])])
        if profile
        else tuple(f"joint_{i}" for i in range(count))
    )
    return Track(part, names, state, action.copy(), dq, tau, None, profile)


def episode(
    seed: int = 0,
    *,
    fps: float = 30.0,
    seconds: float = 15.0,
    hand: str = "dex3-1",
    arms: bool = True,
    hands: Sequence[str] = ("left_hand", "right_hand"),
    stamps: bool = True,
    arm_kind: str = "tremble",
    arm_plant: Plant = Plant(delay_s=0.06, tau_s=0.06, noise=0.0003),
    name: str = "episode",
    **options: object,
) -> Episode:
    """A good episode of two hands, and arms beside them.

    :param options: of :func:`track`, for the hands.
    """
    rng = np.random.default_rng(seed)
    tracks = [track(rng, part, fps, seconds, hand=hand, **options) for part in hands]  # type: ignore[arg-type]
    if arms:
        for part in ("left_arm", "right_arm"):
            tracks.append(track(rng, part, fps, seconds, kind=arm_kind, plant=arm_plant, pace=0.7))
    n = len(tracks[0].state) if tracks[0].state is not None else 0
    t = np.arange(n) / fps
    return Episode(
        name=name,
        form="LeRobot v3.0",
        fps=fps,
        t=t,
        tracks=tracks,
        stamps=t.astype(np.float32).astype(float) if stamps else None,
        numbers=np.arange(n, dtype=float) if stamps else None,
        tasks=["pick up the cube"],
    )


def changed(
    source: Episode,
    part: str,
    *,
    state: Callable[[Floats], Floats] | None = None,
    action: Callable[[Floats], Floats] | None = None,
    fields: bool = False,
) -> Episode:
    """A copy in which a part, or every part (``""``), is changed.

    :param state: takes and returns the observed positions; ``fields``: and whatever else is
        observed of the part.
    """

    def of(values: Floats | None, change: Callable[[Floats], Floats] | None) -> Floats | None:
        return values if values is None or change is None else change(values.copy())

    tracks = [
        t
        if part and t.part != part
        else replace(
            t,
            state=of(t.state, state),
            action=of(t.action, action),
            dq=of(t.dq, state if fields else None),
            tau=of(t.tau, state if fields else None),
        )
        for t in source.tracks
    ]
    return replace(source, tracks=tracks)


def found(result: Episode | Judgement, check: str) -> list[Finding]:
    """The findings of a check that ask for more than to keep the episode."""
    judged = judge(result) if isinstance(result, Episode) else result
    return [f for f in judged.reasons if f.check == check]


def blamed(result: Episode) -> list[str]:
    """What asks for more than to keep it, as texts; for tables of good episodes."""
    return [f"{f.check} {f.part}: {f.text}" for f in judge(result).reasons if f.use != Use.KEEP]
