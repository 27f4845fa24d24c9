"""Checks of what is wrong with the stream of numbers in time, and good episodes that are odd."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dexkit.conformance.dataset.checks import frames, frozen, idle, jumps, timing
from dexkit.conformance.dataset.episode import Episode, Gap, Track
from dexkit.conformance.dataset.findings import Finding, Use
from dexkit.conformance.dataset.judge import judge
from dexkit.hand import Floats
from dexkit.models import model
from tests.dataset_episodes import Plant, changed, episode, found

FPS = 30


def _hold(begin: int, end: int, joint: int | None = None) -> object:
    def change(values: Floats) -> Floats:
        columns = slice(None) if joint is None else joint
        values[begin:end, columns] = values[begin, columns]
        return values

    return change


def _taken(source: Episode, index: Floats, *, times: bool = False) -> Episode:
    """All streams at other frames; ``times``: the frames keep their numbers and times."""
    at = np.asarray(index, dtype=int)
    copy = changed(source, "", state=lambda x: x[at], action=lambda x: x[at], fields=True)
    rest = at if times else np.arange(len(at))
    assert source.stamps is not None
    assert source.numbers is not None
    return replace(copy, t=source.t[rest], stamps=source.stamps[rest], numbers=source.numbers[rest])


@pytest.mark.parametrize("fields", [False, True])
@pytest.mark.parametrize("noise", [0.0, 0.0006])
def test_frozen_part(noise: float, fields: bool) -> None:
    good = episode(2, plant=Plant(noise=noise), fields=True)
    bad = changed(good, "left_hand", state=_hold(100, 240), fields=fields)
    [finding] = found(bad, "frozen")
    assert finding.use is Use.DROP
    assert finding.part == "left_hand"
    assert not finding.joints
    assert finding.begin_s == pytest.approx(100 / FPS, abs=0.1)
    assert finding.end_s == pytest.approx(240 / FPS, abs=0.1)
    assert ("numbers froze" in finding.text) == fields


def test_frozen_joint() -> None:
    bad = changed(episode(4), "right_hand", state=_hold(0, 450, 3))
    [finding] = found(bad, "frozen")
    assert finding.joints == (3,)
    assert "middle_0" in finding.text
    assert "whole episode" in finding.text


def test_frozen_all() -> None:
    [finding] = found(changed(episode(5), "", state=_hold(60, 150)), "frozen")
    assert finding.part == ""
    assert "all parts" in finding.text


def test_frozen_action() -> None:
    [finding, *_] = found(changed(episode(8), "left_hand", action=_hold(90, 240)), "frozen")
    assert "stream of actions froze" in finding.text


def test_each_frame_twice() -> None:
    n = 450
    [finding] = found(_taken(episode(1), np.arange(n) // 2 * 2), "repeated")
    assert finding.value == 2
    assert "15 frames per second" in finding.text


def test_run_of_one_frame() -> None:
    index = np.concatenate([np.arange(200), np.full(20, 199), np.arange(200, 430)])
    [finding] = found(_taken(episode(1), index), "repeated")
    assert finding.begin_s == pytest.approx(200 / FPS, abs=0.1)


def test_stretch_again() -> None:
    index = np.arange(450)
    index[300:360] = np.arange(100, 160)
    [finding] = found(_taken(episode(1), index), "repeated")
    assert "earlier" in finding.text
    assert finding.begin_s == pytest.approx(10.0, abs=0.1)


def test_lost_frames() -> None:
    index = np.concatenate([np.arange(200), np.arange(230, 450)])
    [silent] = found(_taken(episode(9), index), "missing")
    assert silent.end_s == pytest.approx(200 / FPS, abs=0.05)
    [told] = found(_taken(episode(9), index, times=True), "missing")
    assert told.value == pytest.approx(29 / FPS, abs=0.05)


def test_lost_observations() -> None:
    index = np.concatenate([np.arange(204), np.arange(229, 450), np.full(25, 449)])
    source = episode(9, kind="sine", arm_kind="sine")
    [finding] = found(changed(source, "", state=lambda x: x[index]), "missing")
    assert finding.end_s == pytest.approx(204 / FPS, abs=0.05)
    assert "observations are missing" in finding.text


def test_one_lost_frame_is_a_remark() -> None:
    index = np.concatenate([np.arange(200), np.arange(201, 450)])
    judged = judge(_taken(episode(3), index, times=True))
    assert judged.use is Use.KEEP
    assert [f.check for f in judged.findings if f.check == "missing"]


def test_not_finite() -> None:
    def nan(values: Floats) -> Floats:
        values[50:60] = np.nan
        values[60:] += 0.3  # what happened meanwhile is no leap
        return values

    assert not found(changed(episode(1), "left_hand", state=nan), "jump")
    [finding] = found(changed(episode(1), "left_hand", state=nan), "missing")
    assert finding.value == 10
    assert finding.part == "left_hand"

    def late(values: Floats) -> Floats:
        values[:20] = np.nan
        return values

    assert not judge(changed(episode(1), "left_hand", action=late)).reasons


def test_gaps_of_a_recording() -> None:
    source = replace(episode(1, stamps=False), measured=True)
    for seconds, use in ((0.2, Use.KEEP), (0.5, Use.REVIEW), (2.0, Use.DROP)):
        bad = replace(source, gaps=[Gap(3.0, 3.0 + seconds, "rt/dex3/left/state")])
        assert judge(bad).use is use
    assert judge(replace(source, gaps=[Gap(3.0, 3.5, "rt/dex3/left/cmd")])).use is Use.KEEP


@pytest.mark.parametrize(
    ("lasting", "size", "words"),
    [(1, 0.6, "out and back"), (9999, 0.5, "in a frame"), (60, 2 * np.pi, "full turn")],
)
def test_jump(lasting: int, size: float, words: str) -> None:
    def leap(values: Floats) -> Floats:
        values[150 : 150 + lasting, 2] += size
        return values

    findings = found(changed(episode(6), "right_arm", state=leap), "jump")
    assert findings
    assert all(f.joints == (2,) and f.part == "right_arm" for f in findings)
    assert words in findings[0].text


@pytest.mark.parametrize("late", [-12, 30])
def test_out_of_step(late: int) -> None:
    index = np.clip(np.arange(450) - late, 0, 449)
    bad = changed(episode(7), "", state=lambda x: x[index])
    [finding] = found(bad, "out-of-step")
    assert all(part in finding.text for part in ("left hand", "right hand", "left arm"))
    lag = judge(bad).figures["lag, s"]
    assert lag == pytest.approx(late / FPS + judge(episode(7)).figures["lag, s"], abs=0.05)


def test_drift() -> None:
    at = np.arange(450) - np.linspace(0, 15, 450)

    def late(values: Floats) -> Floats:
        columns = [np.interp(at, np.arange(450), values[:, j]) for j in range(values.shape[1])]
        return np.stack(columns, axis=1)

    [finding] = found(changed(episode(7), "", state=late), "out-of-step")
    assert "drifts" in finding.text


def test_action_that_is_elsewhere_once() -> None:
    def odd(values: Floats) -> Floats:
        values[100, 4] -= 0.7
        return values

    [finding] = found(changed(episode(6), "left_arm", action=odd), "jump")
    assert finding.part == "left_arm"
    assert finding.joints == (4,)


def test_action_of_an_arm_that_is_elsewhere_for_some_frames() -> None:
    def odd(values: Floats) -> Floats:
        values[60:63, 4] += 1.0
        return values

    [finding] = found(changed(episode(6, fps=10), "right_arm", action=odd), "jump")
    assert (finding.part, finding.joints) == ("right_arm", (4,))
    # a trigger may be pressed for a moment
    assert not found(changed(episode(6, fps=10), "right_hand", action=odd), "jump")


def test_drift_beyond_any_lag_of_a_part_of_the_episode() -> None:
    at = np.arange(300) - np.linspace(0, 45, 300)

    def late(values: Floats) -> Floats:
        columns = [np.interp(at, np.arange(300), values[:, j]) for j in range(values.shape[1])]
        return np.stack(columns, axis=1)

    [finding] = found(changed(episode(7, seconds=10), "", state=late), "out-of-step")
    assert "drifts" in finding.text


def test_hand_that_an_object_stops_is_not_before_its_action() -> None:
    """As the action goes on, and comes back slowly: the state moves first, and then again last."""
    t = np.arange(600) / 50
    asked = 0.5 + 0.5 * np.cos(2 * np.pi * (t + 1.0) / 8)
    wanted = np.repeat(asked[:, None], 6, axis=1) + 0.01 * np.sin(t[:, None] + np.arange(6))
    seen = np.maximum(wanted, 0.4) + np.random.default_rng(1).normal(0, 5e-4, wanted.shape)
    source = episode(8, fps=50, seconds=12, hand="", joints=6)
    held = changed(source, "right_hand", state=lambda _: seen, action=lambda _: wanted)
    assert not found(held, "out-of-step")


def test_observation_of_an_unknown_hand_that_is_renewed_too_seldom() -> None:
    def stale(every: int) -> Episode:
        index = np.arange(600) // every * every
        source = episode(9, fps=50, seconds=12, hand="", joints=6)
        return changed(source, "left_hand", state=lambda x: x[index])

    assert not found(stale(10), "repeated")  # as Inspire's do
    assert found(stale(12), "repeated")


def test_rows_again_in_a_part_of_the_episode() -> None:
    index = np.arange(450)
    index[150:350] = index[150:350] // 3 * 3
    [finding] = found(_taken(episode(3), index), "repeated")
    assert finding.begin_s == pytest.approx(5.0, abs=0.2)
    index = np.arange(450)
    for begin in (150, 159, 171, 180, 194, 210):
        index[begin : begin + 6] = begin
    [finding] = found(_taken(episode(3), index), "repeated")
    assert finding.begin_s == pytest.approx(5.0, abs=0.2)


def test_numbers_that_skip_without_stamps() -> None:
    source = episode(3)
    index = np.concatenate([np.arange(200), np.arange(240, 450)])
    bad = replace(_taken(source, index), t=source.t[index], stamps=None, numbers=None)
    [finding] = found(bad, "missing")
    assert finding.use is Use.DROP


def test_measured_and_stated_rate() -> None:
    source = replace(episode(3, fps=20.0), stamps=None, numbers=None, measured=True)
    [finding] = found(replace(source, fps=30.0), "fps")
    assert finding.value == pytest.approx(20)


def test_rate_of_stamps() -> None:
    good = episode(1)
    assert good.stamps is not None
    [finding] = found(replace(good, stamps=good.stamps * 1.5), "fps")
    assert finding.value == pytest.approx(20)
    [finding] = found(replace(good, stamps=good.stamps * 0), "fps")
    assert "the same" in finding.text


def test_rate_by_velocities() -> None:
    good = episode(1, fields=True)
    assert good.stamps is not None
    bad = replace(good, fps=15.0, t=good.t * 2, stamps=good.stamps * 2)
    findings = found(bad, "fps")
    assert findings
    assert findings[0].value == pytest.approx(0.5, abs=0.05)


def test_idle() -> None:
    index = np.concatenate([np.arange(450), np.full(300, 449)])
    good = episode(1, seconds=25)
    bad = changed(good, "", state=lambda x: x[index], action=lambda x: x[index])
    [finding] = found(bad, "idle")
    assert finding.value == pytest.approx(10, abs=1.5)
    assert judge(bad).figures["idle, %"] > 35


def _odd_values(rng: np.random.Generator, frames: int, joints: int) -> Floats | None:
    """Numbers as broken sources have them."""
    values: Floats = rng.normal(0, 1, (frames, joints))
    kind = rng.integers(0, 9)
    if kind == 0:
        return None
    if kind == 1:
        values[:] = 0
    elif kind == 2:
        values = np.cumsum(values, axis=0) * 0.1
    elif kind == 3:
        values[rng.random(frames) < 0.3] = np.nan
    elif kind == 4:
        values[:] = np.nan
    elif kind == 5:
        values[2:-1] = values[2:3]
    elif kind == 6:
        values[:1] = np.inf
        values[1:] *= 1e300
    return np.asarray(values)


@pytest.mark.parametrize("seed", range(6))
def test_odd_data_end_no_check(seed: int) -> None:
    rng = np.random.default_rng(seed)
    checks = [*frozen.CHECKS, *frames.CHECKS, *jumps.CHECKS, *timing.CHECKS, *idle.CHECKS]
    for _ in range(40):
        count = int(rng.choice([0, 1, 2, 3, 5, 9, 20, 60, 150]))
        fps = float(rng.choice([0.5, 5, 30, 1000]))
        tracks = []
        for part in ("left_hand", "right_arm", "robot"):
            hand = model("dex3-1") if part == "left_hand" and rng.random() < 0.5 else None
            joints = 7 if hand else int(rng.integers(1, 9))
            values = [_odd_values(rng, count, joints) for _ in range(4)]
            names = tuple(f"joint_{i}" for i in range(joints))
            tracks.append(Track(part, names, *values, model=hand))
        t = np.arange(count) / fps
        odd = Episode("odd", "LeRobot v3.0", fps, t, tracks, stamps=t * rng.choice([0, 1, 2]))
        for check in checks:
            for what in check.run(odd):
                if isinstance(what, Finding) and what.value is not None:
                    assert np.isfinite(what.value)


GOOD: dict[str, Episode] = {
    "coarse": episode(20, plant=Plant(steps=64)),
    "coarse, slow, simulated": episode(21, plant=Plant(steps=64, noise=0.0), pace=0.3),
    "noisy": episode(22, plant=Plant(noise=0.012)),
    "slow hand": episode(23, plant=Plant(delay_s=0.3, tau_s=0.15, fastest=0.8)),
    "slow hand, trigger": episode(24, plant=Plant(delay_s=0.3, fastest=0.8), kind="trigger"),
    "taught": episode(25, same="state"),
    "next state": episode(26, same="next"),
    "object": episode(27, plant=Plant(block=0.45)),
    "object, simulated": episode(28, plant=Plant(block=0.45, noise=0.0), kind="trigger"),
    "slow registers": episode(29, hand="inspire-ftp", plant=Plant(delay_s=0.35, renew_s=0.12)),
    "behind a slow bridge": episode(41, plant=Plant(delay_s=0.37, tau_s=0.1)),
    "simulated": episode(30, plant=Plant(noise=0.0), arm_plant=Plant(noise=0.0)),
    "sag": episode(31, arm_plant=Plant(sag=0.05)),
    "quick": episode(32, pace=2.5),
    "10 fps": episode(33, fps=10),
    "60 fps": episode(34, fps=60, seconds=8),
    "2 s": episode(35, seconds=2),
    "opens": episode(36, hand="dex1-1", kind="opens"),
    "unknown six joints": episode(37, hand="", joints=6),
    "one hand": episode(38, hands=["right_hand"], arms=False, hand="dex1-1"),
    "rhythm": episode(39, kind="sine"),
    "fields": episode(40, hand="dex5-1", fields=True, plant=Plant(fastest=2.0)),
}


@pytest.mark.parametrize("name", GOOD)
def test_good(name: str) -> None:
    judged = judge(GOOD[name])
    assert not judged.reasons
