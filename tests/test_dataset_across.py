"""Episodes of a set compared with each other: duplicates, and one that is out of step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexkit.conformance.dataset.across import across
from dexkit.conformance.dataset.episode import Episode
from dexkit.conformance.dataset.findings import Judgement, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.hand import Floats
from tests.dataset_episodes import changed, episode


@pytest.fixture(scope="module")
def takes() -> dict[str, Judgement]:
    return {f"take {i}": judge(episode(100 + i, hands=["left_hand"], seconds=10)) for i in range(9)}


def _cut(source: Episode, begin: int, end: int, noise: float) -> Episode:
    rng = np.random.default_rng(5)

    def part(values: Floats) -> Floats:
        return values[begin:end] + rng.normal(0, noise, values[begin:end].shape)

    copy = changed(source, "", state=part, action=part)
    count = end - begin
    assert copy.stamps is not None
    assert copy.numbers is not None
    return replace(
        copy,
        t=copy.t[:count],
        stamps=copy.stamps[:count],
        numbers=copy.numbers[:count],
        tasks=["another text"],
    )


def test_takes_of_one_task(takes: dict[str, Judgement]) -> None:
    assert not across(takes)


@pytest.mark.parametrize(
    ("begin", "end", "noise", "use"),
    [
        (0, 300, 0.0, Use.DROP),
        (0, 300, 0.002, Use.REVIEW),
        (0, 289, 0.0, Use.REVIEW),
        (7, 300, 0.001, Use.REVIEW),
    ],
)
def test_duplicate(
    takes: dict[str, Judgement], begin: int, end: int, noise: float, use: Use
) -> None:
    copy = judge(_cut(episode(103, hands=["left_hand"], seconds=10), begin, end, noise))
    found = across({**takes, "copy": copy})
    assert list(found) == ["copy"]
    [finding] = found["copy"]
    assert finding.check == "duplicate"
    assert finding.use is use
    assert "take 3" in finding.text


def test_the_better_one_stays(takes: dict[str, Judgement]) -> None:
    def spike(values: Floats) -> Floats:
        values[200, 0] += 0.7
        return values

    bad = judge(changed(episode(103, hands=["left_hand"], seconds=10), "left_hand", state=spike))
    assert bad.use is not Use.KEEP
    assert list(across({"bad": bad, **takes})) == ["bad"]


@pytest.mark.parametrize(("frames", "part"), [(5, ""), (11, "left_hand"), (6, None)])
def test_later_than_the_others(takes: dict[str, Judgement], frames: int, part: str | None) -> None:
    index = np.clip(np.arange(300) - frames, 0, 299)
    source = episode(120, hands=["left_hand"], seconds=10)
    late = changed(source, part or ("left_hand" if part is None else ""), state=lambda v: v[index])
    found = across({**takes, "late": judge(late)})
    if part is None:
        assert not found  # a slow hand
        return
    assert list(found) == ["late"]
    [finding] = found["late"]
    assert finding.check == "out-of-step"
    assert finding.part == part


def test_an_episode_without_a_camera_that_the_others_have() -> None:
    judgements = {f"e{i}": Judgement(cameras=["head", "wrist"]) for i in range(6)}
    judgements["e6"] = Judgement(cameras=["head"])
    ((name, (finding,)),) = across(judgements).items()
    assert (name, finding.check, finding.part) == ("e6", "camera-missing", "camera wrist")
    judgements |= {f"f{i}": Judgement(cameras=["head"]) for i in range(6)}
    assert not across(judgements)  # two ways to record
