"""The judge of datasets: what only the episodes of a set together show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dexkit.conformance.dataset.across import across
from dexkit.conformance.dataset.checks.grasps import CLOSED, CLOSINGS, HOLDS
from dexkit.conformance.dataset.findings import Judgement, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.conformance.dataset.whole_set import WholeSet
from dexkit.hand import Floats
from tests.dataset_episodes import episode


def grip(closed: float, holds: float, closings: float = 1, hand: str = "left hand") -> dict:
    return {hand + CLOSED: closed, hand + HOLDS: holds, hand + CLOSINGS: closings}


def found(figures: list[dict], check: str) -> list[str]:
    judgements = {str(i): Judgement(figures=f) for i, f in enumerate(figures)}
    return [n for n, fs in across(judgements).items() if any(f.check == check for f in fs)]


def test_a_hand_that_closes_on_nothing_is_found() -> None:
    others = [grip(50.0 + i, 3.0) for i in range(5)]
    assert found([*others, grip(95.0, 0.0)], "grasp") == ["5"]
    assert found([*others, grip(52.0, 0.0)], "grasp") == []  # stopped where the others are
    assert found([*others, grip(95.0, 0.0, closings=3)], "grasp") == ["5"]  # all there is to do
    assert found([*others, grip(95.0, 0.5)], "grasp") == ["5"]  # it turned at once
    assert found([*others[:3], grip(95.0, 0.0)], "grasp") == []  # too few to say what is usual
    assert found([*others, *[grip(95.0, 0.0)] * 3], "grasp") == []  # not unusual


def test_gestures_of_both_hands_are_not_blamed() -> None:
    both = [grip(50.0, 3.0) | grip(55.0, 3.0, hand="right hand") for _ in range(6)]
    gesture = grip(95.0, 0.0) | grip(95.0, 0.0, hand="right hand")
    assert found([*both, gesture], "grasp") == []
    assert found([*both, grip(95.0, 0.0) | grip(55.0, 3.0, hand="right hand")], "grasp") == ["6"]
    again = grip(95.0, 0.0, closings=3) | grip(55.0, 3.0, hand="right hand")
    assert found([*both, again], "grasp") == []  # the other hand does the task


def test_a_hand_that_never_holds_says_nothing_of_the_one_that_does() -> None:
    idle = grip(60.0, 0.0, hand="right hand")
    others = [grip(50.0 + i, 3.0) | idle for i in range(6)]
    assert found([*others, grip(95.0, 0.0, closings=3) | idle], "grasp") == ["6"]


def of_set(count: int = 6) -> tuple[dict[str, Judgement], list[dict[str, Floats]]]:
    judged, features = {}, []
    for seed in range(count):
        made = episode(seed, hand="dex1-1", seconds=6.0, arms=False)
        columns = {
            "observation.state": np.concatenate([t.state for t in made.tracks], axis=1),  # type: ignore[arg-type]
            "action": np.concatenate([t.action for t in made.tracks], axis=1),  # type: ignore[arg-type]
        }
        features.append(columns)
        judged[f"{seed}"] = judge(replace(made, features=columns))
    return judged, features


def test_statistics_of_a_set_are_compared_with_its_frames() -> None:
    judged, features = of_set()
    values = np.concatenate([f["action"] for f in features])
    stated = {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([float(len(values))]),
    }

    def said(**other: Floats) -> list[str]:
        whole = WholeSet(
            "set", "LeRobot v3.0", 30.0, tuple(range(6)), stated={"action": {**stated, **other}}
        )
        return [f.text for f in across(judged, whole).get("set", [])]

    assert said() == []
    assert "mean" in said(mean=stated["mean"] + 0.5)[0]
    assert "std" in said(std=stated["std"] * 0.5)[0]
    assert "count" in said(count=np.array([3.0]))[0]


def test_a_gripper_that_counts_to_one_among_others_that_do_not_is_found() -> None:
    judged, features = of_set()
    made = episode(9, hand="dex1-1", seconds=6.0, arms=False)
    parts = {
        name: np.concatenate([v / 5.4 for v in values], axis=1)
        for name, values in {
            "observation.state": [t.state for t in made.tracks if t.state is not None],
            "action": [t.action for t in made.tracks if t.action is not None],
        }.items()
    }
    small = [
        replace(t, state=t.state / 5.4, action=t.action / 5.4)
        for t in made.tracks
        if t.state is not None and t.action is not None
    ]
    judged["small"] = judge(replace(made, tracks=small, features=parts))
    (name,) = [n for n, fs in across(judged).items() if any(f.check == "units" for f in fs)]
    assert name == "small"
    assert all(f.use is Use.REVIEW for f in across(judged)[name])
    assert features
