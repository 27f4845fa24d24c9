"""The judge of datasets: what the numbers of state and action mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from dexkit.conformance.dataset.episode import Episode, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.hand import Floats
from tests.dataset_episodes import Plant, blamed, changed, episode, found

FPS = 30.0
HANDS = ("dex1-1", "dex3-1", "dex5-1", "brainco-revo2", "inspire-dfx")
NOISE = 0.002


@cache
def made(hand: str = "dex3-1", seed: int = 1, **more: Any) -> Episode:
    """Two hands and two arms, whose joints move each for itself."""
    options = {"kind": "apart", "plant": Plant(noise=NOISE), "arm_kind": "apart", **more}
    return episode(seed, hand=hand, seconds=12.0, **options)


def only(source: Episode, check: str) -> Finding:
    """The one finding, which is of this check."""
    reasons = judge(source).reasons
    assert [f.check for f in reasons] == [check], reasons
    return reasons[0]


def unknown(source: Episode) -> Episode:
    """The same with hands whose model nobody knows."""
    tracks = [
        replace(t, model=None, joints=tuple(f"{t.part}_{i}" for i in range(len(t.joints))))
        for t in source.tracks
    ]
    return replace(source, tracks=tracks)


def off(begin: float, end: float) -> Callable[[Floats], Floats]:
    """A stretch in which nothing drives the joints: they stay, and their encoders have noise."""

    def apply(state: Floats) -> Floats:
        first, last = round(begin * FPS), round(end * FPS)
        noise = np.random.default_rng(3).normal(0, NOISE, state[first:last].shape)
        state[first:last] = state[first] + noise
        return state

    return apply


# -- good episodes -----------------------------------------------------------------------------

GOOD: dict[str, dict[str, Any]] = {
    "plain": {},
    "fingers together": {"kind": "smooth"},
    "an object met early": {"plant": Plant(block=0.25)},
    "an object met late": {"plant": Plant(block=0.6)},
    "an object for all fingers": {"plant": Plant(block=0.4), "kind": "smooth"},
    "a slow hand": {"plant": Plant(delay_s=0.3, tau_s=0.2, fastest=1.2)},
    "noisy encoders": {"plant": Plant(noise=0.015)},
    "coarse encoders": {"plant": Plant(steps=64)},
    "no noise at all": {"plant": Plant(noise=0.0)},
    "10 fps": {"fps": 10.0},
    "60 fps": {"fps": 60.0},
    "kinesthetic teaching": {"same": "state"},
    "the action is the next state": {"same": "next"},
    "a trigger": {"kind": "trigger"},
    "a trigger and an object": {"kind": "trigger", "plant": Plant(block=0.3)},
    "only opens": {"kind": "opens"},
    "never used": {"kind": "still"},
    "to and fro": {"kind": "sine"},
    "gravity": {"arm_plant": Plant(sag=0.06)},
}


@pytest.mark.parametrize("hand", HANDS)
@pytest.mark.parametrize("how", GOOD)
def test_good_episodes_are_not_blamed(hand: str, how: str) -> None:
    good = made(hand, **GOOD[how])
    assert blamed(good) == []
    if len(good.hands[0].joints) == 6:
        assert blamed(unknown(good)) == []


@pytest.mark.parametrize("contact", [0.2, 0.4, 0.6])
@pytest.mark.parametrize("hand", ["brainco-revo2", "dex1-1", "inspire-dfx"])
def test_an_object_that_is_held_all_the_time_is_not_blamed(hand: str, contact: float) -> None:
    base = made(hand, arms=False)
    t = base.t
    way = np.clip(contact + t / 40 + 0.1 * np.sin(2 * t), 0, 1)[:, None]

    def at(part: Floats) -> Callable[[Floats], Floats]:
        low, high = base.tracks[0].limits or (0.0, 1.0)
        closing = base.tracks[0].closing
        assert closing is not None
        start, end = np.where(closing > 0, low, high), np.where(closing > 0, high, low)
        return lambda q: start + part * (end - start)

    noise = np.random.default_rng(2).normal(0, NOISE, (len(t), 1))
    held = changed(base, "", state=at(contact + noise), action=at(way))
    assert blamed(held) == []
    if hand != "dex1-1":
        assert blamed(unknown(held)) == []


# -- not followed ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["dex3-1", "brainco-revo2", "inspire-dfx"])
def test_a_hand_that_is_off_is_found(name: str) -> None:
    fault = only(changed(made(name), "left_hand", state=off(0, 12)), "not-followed")
    assert (fault.use, fault.part) == (Use.DROP, "left_hand")
    assert "off" in fault.text


def test_a_hand_that_trips_is_found_where_it_does() -> None:
    (fault,) = found(changed(made(), "right_hand", state=off(4, 10)), "not-followed")
    assert fault.part == "right_hand"
    assert fault.begin_s is not None
    assert fault.end_s is not None
    assert 4 <= fault.begin_s < fault.end_s <= 11


def test_an_arm_that_is_off_is_found() -> None:
    (fault,) = found(changed(made(), "left_arm", state=off(3, 10)), "not-followed")
    assert fault.part == "left_arm"


def test_a_hand_that_moves_far_less_is_found() -> None:
    weak = changed(made(), "left_hand", state=lambda s: s[0] + 0.3 * (s - s[0]))
    assert "30 %" in only(weak, "not-followed").text


def test_one_joint_that_stays_is_found() -> None:
    def stuck(state: Floats) -> Floats:
        return np.where(np.arange(state.shape[1]) == 4, off(0, 12)(state.copy()), state)

    assert only(changed(made(), "left_hand", state=stuck), "not-followed").joints == (4,)


@pytest.mark.parametrize(("fingers", "most"), [(2, False), (7, True)])
def test_few_fingers_may_be_hooked_for_a_moment(fingers: int, most: bool) -> None:
    good, _ = holding("dex3-1")
    at, until = round(9.1 * FPS), round(11.6 * FPS)  # it is told to open from 9 to 10 s

    def hooked(state: Floats) -> Floats:
        here = np.arange(state.shape[1]) >= state.shape[1] - fingers
        noise = np.random.default_rng(3).normal(0, NOISE, (until - at, state.shape[1]))
        state[at:until] = np.where(here, state[at], state[at:until]) + noise
        return state

    assert bool(found(changed(good, "left_hand", state=hooked), "not-followed")) is most


# -- units -------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["state", "action"])
@pytest.mark.parametrize("part", ["left_hand", "right_arm"])
def test_degrees_of_one_are_found(part: str, which: str) -> None:
    bad = changed(made(), part, **{which: np.rad2deg})
    fault = only(bad, "units")
    assert fault.part == part
    assert fault.use is Use.DROP
    assert "in degrees" in fault.text
    assert ("observation" if which == "state" else "action") in fault.text


@pytest.mark.parametrize("part", ["left_hand", "right_arm"])
def test_degrees_of_both_are_found(part: str) -> None:
    fault = only(changed(made(), part, state=np.rad2deg, action=np.rad2deg), "units")
    assert fault.part == part
    assert "observation and action are in degrees" in fault.text


@pytest.mark.parametrize("whole", [1.0, 100.0, 1000.0])
@pytest.mark.parametrize("name", ["dex1-1", "dex3-1"])
def test_parts_of_the_way_are_found_in_radians(name: str, whole: float) -> None:
    base = made(name)
    limits = base.tracks[0].limits
    assert limits is not None
    low, high = limits

    def parts(q: Floats) -> Floats:
        return whole * (q - low) / (high - low)

    assert only(changed(base, "left_hand", state=parts), "units").part == "left_hand"
    assert only(changed(base, "left_hand", action=parts), "units").part == "left_hand"
    assert only(changed(base, "left_hand", state=lambda q: whole - parts(q)), "units")


@pytest.mark.parametrize("known", [True, False])
def test_other_parts_of_the_travel_are_found(known: bool) -> None:
    base = made("inspire-dfx")
    if not known:
        base = unknown(base)
    for whole in (100.0, 1000.0):
        both = changed(
            base, "left_hand", state=lambda q, w=whole: w * q, action=lambda q, w=whole: w * q
        )
        assert only(both, "units").use is Use.REVIEW
        assert only(changed(base, "left_hand", state=lambda q, w=whole: w * q), "units")
    assert "1 to 0" in only(changed(base, "left_hand", state=lambda q: 1 - q), "units").text


# -- sides, order, signs -----------------------------------------------------------------------


def exchanged(base: Episode, first: str, second: str, *fields: str) -> Episode:
    a, b = (next(t for t in base.tracks if t.part == part) for part in (first, second))
    other = {
        first: replace(a, **{f: getattr(b, f) for f in fields}),
        second: replace(b, **{f: getattr(a, f) for f in fields}),
    }
    return replace(base, tracks=[other.get(t.part, t) for t in base.tracks])


@pytest.mark.parametrize("field", ["state", "action"])
@pytest.mark.parametrize("what", ["hand", "arm"])
@pytest.mark.parametrize("name", ["dex1-1", "dex3-1", "inspire-dfx"])
def test_exchanged_sides_are_found(name: str, what: str, field: str) -> None:
    bad = exchanged(made(name), f"left_{what}", f"right_{what}", field)
    assert {f.check for f in judge(bad).reasons} == {"sides"}


def test_hands_that_are_exchanged_altogether_are_found_by_their_range() -> None:
    bad = exchanged(made("dex3-1"), "left_hand", "right_hand", "state", "action")
    assert {f.check for f in judge(bad).reasons} == {"sides"}


def test_sides_that_the_importer_has_corrected_are_told() -> None:
    text = "states of left and right hand exchanged: in the source, states follow the other side"
    assert only(replace(made(), problems=[text]), "sides").use is Use.REVIEW


@pytest.mark.parametrize("part", ["left_hand", "left_arm"])
def test_another_order_is_found(part: str) -> None:
    places = [0, 3, 2, 1, 4, 5, 6]
    fault = only(changed(made(), part, state=lambda s: s[:, places]), "order")
    assert fault.part == part
    assert fault.joints == (1, 3)


def test_another_order_of_both_is_found_by_the_limits() -> None:
    def by_place(values: Floats) -> Floats:
        return values[:, [3, 4, 5, 6, 0, 1, 2]]

    fault = only(changed(made(), "left_hand", state=by_place, action=by_place), "order")
    assert fault.part == "left_hand"


@pytest.mark.parametrize("part", ["left_hand", "left_arm"])
def test_an_inverted_joint_is_found(part: str) -> None:
    signs = np.where(np.arange(7) == 4, -1, 1)
    fault = only(changed(made(), part, state=lambda s: s * signs), "sign")
    assert fault.part == part
    assert fault.joints == (4,)


# -- metadata ----------------------------------------------------------------------------------


@pytest.mark.parametrize("tasks", [[], [""], ["todo"], ["N/A"], [" none "]])
def test_a_missing_task_is_found(tasks: list[str]) -> None:
    assert only(replace(made(), tasks=tasks), "task").use is Use.REVIEW


def test_a_task_that_says_nothing_is_a_remark() -> None:
    judged = judge(replace(made(), tasks=["test"]))
    assert judged.use is Use.KEEP
    assert [f.check for f in judged.findings] == ["task"]


def stated(values: Floats) -> dict[str, Floats]:
    v = np.float32(values).astype(np.float64)
    return {
        "min": v.min(axis=0),
        "max": v.max(axis=0),
        "mean": v.mean(axis=0),
        "std": v.std(axis=0, ddof=1),
        "q01": v.min(axis=0),
        "count": np.array([float(len(v))]),
    }


def test_statistics_are_compared() -> None:
    base = made()
    values = np.concatenate([t.state for t in base.tracks if t.state is not None], axis=1)
    good = stated(values)
    about = {"observation.state": values}

    def with_stats(**other: Floats) -> Episode:
        return replace(base, features=about, stated={"observation.state": {**good, **other}})

    assert blamed(with_stats()) == []
    for name in ("min", "max", "mean", "std"):
        text = only(with_stats(**{name: good[name] + 0.3}), "statistics").text
        assert name in text
        assert "observation.state" in text
    assert "count" in only(with_stats(count=np.array([12.0])), "statistics").text
    assert only(with_stats(mean=good["mean"][:-1]), "statistics")
    assert only(with_stats(mean=good["mean"] * np.nan), "statistics")


def test_what_could_not_be_read_is_told() -> None:
    lost = "the file is cut or damaged; it is read up to its last whole item"
    body = "body: states have 15 joints and actions 3; they are kept as two groups"
    assert blamed(replace(made(), problems=[body])) == []  # speeds of the legs
    harmless = "left_hand may be one of inspire-dfx, inspire-ftp; it is kept as a group of joints"
    assert only(replace(made(), problems=[lost]), "readable").text == lost
    judged = judge(replace(made(), problems=[harmless]))
    assert judged.use is Use.KEEP
    assert judged.findings[0].text == harmless


def test_an_episode_without_actions_is_found() -> None:
    base = made()
    bare = replace(base, tracks=[replace(t, action=None) for t in base.tracks])
    assert "no action" in only(bare, "readable").text
    bare = replace(base, tracks=[replace(t, state=None) for t in base.tracks])
    assert "no observation" in only(bare, "readable").text


# -- clipped actions, grasps -------------------------------------------------------------------


@pytest.mark.parametrize("part", ["left_hand", "left_arm"])
def test_actions_that_are_cut_off_are_found(part: str) -> None:
    def cut(action: Floats) -> Floats:
        low, high = action.min(axis=0), action.max(axis=0)
        return np.clip(action, low + 0.35 * (high - low), high)

    fault = only(changed(made(), part, action=cut), "clipped")
    assert fault.part == part
    assert fault.use is Use.DROP


def losing(track: Track, at: int) -> Track:
    """A hand whose object is gone from a frame on."""
    assert track.state is not None
    assert track.action is not None
    way = np.clip((np.arange(len(track.state)) - at) / 8, 0, 1)[:, None]
    noise = np.random.default_rng(5).normal(0, NOISE, track.state.shape)
    return replace(track, state=track.state + way * (track.action - track.state) + noise)


def holding(hand: str, trembles: float = 0.0) -> tuple[Episode, int]:
    """A hand that closes, holds an object from 2 to 9 s, and opens; and a frame in between.

    :param trembles: parts of the way that its action goes to and fro.
    """
    base = made(hand, arms=False, hands=("left_hand",))
    t = base.t
    told = np.interp(t, [1, 2, 9, 10], [0.05, 0.9, 0.9, 0.05])[:, None]
    told = told + trembles * np.sin(9 * t)[:, None]
    track = base.tracks[0]
    assert track.limits is not None
    assert track.closing is not None
    low, high = track.limits
    start, end = np.where(track.closing < 0, high, low), np.where(track.closing < 0, low, high)
    noise = np.random.default_rng(1).normal(0, NOISE, (len(t), len(low)))
    late = np.concatenate((told[:2], told[:-2]))
    track = replace(
        track,
        action=start + told * (end - start),
        state=start + np.minimum(late, 0.5) * (end - start) + noise,
    )
    return replace(base, tracks=[track]), round(5.5 * FPS)


@pytest.mark.parametrize("trembles", [0.0, 0.03])
@pytest.mark.parametrize("hand", HANDS)
def test_an_object_that_is_lost_is_found(hand: str, trembles: float) -> None:
    good, at = holding(hand, trembles)
    assert blamed(good) == []
    fault = only(replace(good, tracks=[losing(good.tracks[0], at)]), "grasp")
    assert fault.part == "left_hand"
    assert fault.begin_s is not None
    assert fault.end_s is not None
    assert fault.begin_s <= at / FPS + 0.3 <= fault.end_s + 0.4
    figures = judge(good).figures
    assert figures["left hand holds, s"] > 5
    assert figures["left hand closings"] == 1


@pytest.mark.parametrize("field", ["touch", "tau"])
def test_pressure_that_falls_in_a_closed_hand_is_found(field: str) -> None:
    good, at = holding("dex3-1")
    n = len(good)
    press = ((good.t > 2) & (good.t < 9))[:, None] * np.ones((1, 7))
    size, level = (2000.0, 100_000.0) if field == "touch" else (0.5, 0.0)
    noise = np.random.default_rng(4).normal(0, 0.02 * size, (n, 7))
    values = level + size * press + noise

    def with_field(v: Floats) -> Episode:
        return replace(good, tracks=[replace(good.tracks[0], **{field: v})])  # type: ignore[arg-type]

    assert blamed(with_field(values)) == []
    gone = np.where(np.arange(n)[:, None] > at, level + noise, values)
    assert only(with_field(gone), "grasp").part == "left_hand"


def test_joints_whose_names_say_nothing_may_be_a_hand() -> None:
    def is_hand(*joints: str, part: str = "robot") -> bool:
        return Track(part, joints).is_hand

    assert is_hand("joint_0", "joint_1")  # an object may stop them
    assert is_hand("a", part="robot_hand")
    assert not is_hand("left_shoulder_pan.pos", "joint_1")
    assert not is_hand("kLeftElbow", part="left_arm")
    assert not is_hand("waist_yaw_joint")
