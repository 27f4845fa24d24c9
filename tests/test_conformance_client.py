"""Test the requirements about the client of a recorded session."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from dexkit.cli.check import command
from dexkit.conformance.behaviours.client import slow_stretches
from dexkit.conformance.checks import Context, Outcome, check_of
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.motor_messages import Motor, MotorCodec
from dexkit.conformance.kit.recording import Commands, Recording, SideView, States, joints_of
from dexkit.conformance.kit.requirements import catalogue, parse
from dexkit.conformance.kit.result_file import as_document, read_json
from dexkit.conformance.kit.results import Overall, Result, RunResult, Verdict
from dexkit.conformance.layers import layer
from dexkit.conformance.report.html import render
from dexkit.conformance.report.junit import write_junit
from dexkit.conformance.report.markdown import render_markdown
from dexkit.conformance.virtual import MemoryTrace
from dexkit.conformance.virtual.client import ReferenceClient, run_client
from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.models import DIALECTS, dialect, model
from dexkit.traces import Recorder, open_trace, sample_path
from tests.conformance_helpers import failed, result_of, short_run
from tests.each import each

BAD = {Verdict.FAIL, Verdict.WARN, Verdict.ERROR}
BY_ID = {r.id: r for r in catalogue(None, "client")}
GO = dialect("unitree_go")


def bad(results: list[Result]) -> set[tuple[str, str]]:
    return {(r.requirement.id, r.side) for r in results if r.verdict in BAD}


# --------------------------------------------------------------------------------- the catalogue


def test_every_prefix_of_spoils_names_requirements_of_the_hand() -> None:
    for requirement in BY_ID.values():
        of_hand = [r.id for r in catalogue(requirement.model)]
        for prefix in requirement.spoils:
            assert any(name.startswith(prefix) for name in of_hand), (requirement.id, prefix)


def test_only_requirements_about_the_client_spoil_others() -> None:
    text = (
        'model = "dex1-1"\n[[requirement]]\nid = "DEX1-RATE-01"\narea = "a"\nlevel = "MUST"\n'
        'title = "t"\nsentence = "s"\nrationale = "r"\nsource = "s"\nconfidence = "inferred"\n'
        'needs = "state"\nadvice = "a"\nspoils = ["DEX1-TRACK"]\n'
    )
    with pytest.raises(UsageError, match="only a requirement about the client"):
        parse(text)
    spoiling = [r for r in catalogue(None, None) if r.spoils]
    assert spoiling
    assert all(r.about_client for r in spoiling)


# ---------------------------------------------------------------- genuine clients, and good ones


@each("name", [n for n, d in DIALECTS.items() if d.is_gripper])
def test_reference_client_and_hands_meet_every_requirement(name: str) -> None:
    trace = run_client(ReferenceClient, dialect(name))
    result = judge(recording_of(trace, name, ()))
    assert not bad([*result.results, *result.client])
    applies = {i for i, r in BY_ID.items() if name in r.dialects}
    assert {r.requirement.id for r in result.client if r.verdict is Verdict.PASS} == applies
    assert (
        result_of(result, f"{next(iter(applies)).partition('-')[0]}-TRACK-01").verdict
        is Verdict.PASS
    )


def test_run_of_the_kit_has_no_results_about_the_client() -> None:
    result = judge(Recording.decode(short_run()))
    assert result.client == []
    assert result.client_sentence() == ""
    assert as_document(result)["client"] is None


# ------------------------------------------- genuine hands with clients that send something wrong


@cache
def genuine() -> MemoryTrace:
    trace = open_trace(sample_path("dex1_pick_place"))
    rows = {
        (topic, found.type_name): list(
            zip(
                found.log_time_ns.tolist(),
                found.publish_time_ns.tolist(),
                found.payloads,
                strict=True,
            )
        )
        for topic, found in trace.load().items()
    }
    return MemoryTrace(endpoints=list(trace.endpoints), rows=rows)


Change = Callable[[int, tuple[Motor, ...]], "list[Motor] | None"]


def spoiled(change: Change, side: Side = Side.LEFT) -> MemoryTrace:
    """The genuine session with changed commands to one hand; None leaves one out."""
    codec, source = MotorCodec(GO), genuine()
    trace = MemoryTrace(endpoints=source.endpoints, rows=dict(source.rows))
    key = (codec.command_topics[side], GO.cmd_type)
    changed = []
    for number, (log_ns, sent_ns, payload) in enumerate(source.rows[key]):
        motors = change(number, codec.read_command(payload, side) or ())
        if motors is not None:
            changed.append((log_ns, sent_ns, codec.encode({side: motors})[0][1]))
    trace.rows[key] = changed
    return trace


def five_hertz(number: int, motors: tuple[Motor, ...]) -> list[Motor] | None:
    return list(motors) if number % 39 == 0 else None


def in_percent(number: int, motors: tuple[Motor, ...]) -> list[Motor]:
    return [replace(m, q=100.0 * m.q / GO.q_open) for m in motors]


def two_motors(number: int, motors: tuple[Motor, ...]) -> list[Motor]:
    return [*motors, Motor(q=1.0)]


@each(
    ("change", "requirement", "told"),
    [
        (five_hertz, "DEX1-CLIENT-05", "5.0[0-9] Hz from 0.95 s on"),
        (in_percent, "DEX1-CLIENT-03", "up to 100; the range is 0.00 to 5.40 rad"),
        (two_motors, "DEX1-CLIENT-01", "4026 of 4026 commands hold 2 motors instead of 1"),
    ],
)
def test_fault_of_the_client_fails_no_hand(change: Change, requirement: str, told: str) -> None:
    result = judge(Recording.decode(spoiled(change)))
    assert failed(result) == set()
    assert {name for name, side in bad(result.client)} == {requirement}
    assert {side for _, side in bad(result.client)} == {"left"}
    track = result_of(result, "DEX1-TRACK-01")
    assert (track.verdict, track.blocked_by) == (Verdict.BLOCKED, requirement)
    assert track.reason.startswith(f"blocked by {requirement}, a fault of the client: ")
    (guilty,) = (r for r in result.client if r.verdict is Verdict.FAIL)
    assert re.search(told, guilty.observed)
    assert guilty.requirement.advice.startswith("In the client:")
    # the other hand is judged
    assert result_of(result, "DEX1-TRACK-01", "right").verdict is Verdict.PASS
    assert result.overall is Overall.INCONCLUSIVE
    assert f"because of the client ({requirement})" in result.sentence()


def test_only_the_client_is_selected() -> None:
    thin = Recording.decode(spoiled(five_hertz))
    wanted = [r for r in BY_ID.values() if r.model == "dex1-1"]
    result = judge(thin, requirements=wanted)
    assert result.results == []
    assert result.overall is Overall.FAIL
    assert result.sentence().startswith("the client: FAIL")
    good = judge(Recording.decode(genuine()), requirements=wanted)
    assert good.overall is Overall.PASS
    assert good.judged == 20


def test_what_blocks_a_selected_requirement_is_reported_with_it() -> None:
    thin = Recording.decode(spoiled(five_hertz))
    result = judge(thin, requirements=[r for r in catalogue("dex1-1") if r.id == "DEX1-TRACK-01"])
    assert {r.requirement.id for r in result.client} == {"DEX1-CLIENT-05"}


# ----------------------------------------------------------------------------------------- reports


@cache
def thin_result() -> RunResult:
    return judge(Recording.decode(spoiled(five_hertz)), subject={"recording": "thin.mcap"})


def test_check_exits_by_the_hand_and_names_the_client(tmp_path: Path) -> None:
    path, out = tmp_path / "thin.mcap", tmp_path / "r.json"
    with Recorder(path) as recorder:
        for (topic, kind), rows in spoiled(five_hertz).rows.items():
            for log_ns, sent_ns, payload in rows:
                recorder.put(topic, kind, payload, log_time_ns=log_ns, publish_time_ns=sent_ns)
    run = CliRunner().invoke(command, [str(path), "--result", str(out)])
    assert run.exit_code == Overall.INCONCLUSIVE.exit_code, run.output
    assert "DEX1-CLIENT-05 (MUST) client, left: fail" in run.output
    assert "because of the client (DEX1-CLIENT-05)" in run.output
    assert "the client: FAIL: a MUST is not met" in run.output
    assert json.loads(out.read_text())["client"]["overall"] == "fail"
    again = read_json(out)
    assert again.sentence() in run.output
    assert again.client_sentence() in run.output
    assert [r.requirement.id for r in again.client] == [
        r.requirement.id for r in thin_result().client
    ]
    alone = CliRunner().invoke(command, [str(path), "--require", "DEX1-CLIENT"])
    assert alone.exit_code == Overall.FAIL.exit_code, alone.output


def test_reports_call_the_client_by_its_name(tmp_path: Path) -> None:
    result = thin_result()
    page, summary = render(result), render_markdown(result)
    assert "The client that commanded it is at fault" in page
    assert '<b class="bad">fail</b> of the client' in page
    assert "`DEX1-CLIENT-05` Rate of commands (client, left)" in summary
    assert "The client: FAIL: a MUST is not met" in summary
    write_junit(result, tmp_path / "r.xml")
    suite = ElementTree.parse(tmp_path / "r.xml").getroot()
    assert suite.get("failures") == "0"
    case = next(c for c in suite.iter("testcase") if c.get("name") == "DEX1-CLIENT-05-left")
    skipped = case.find("skipped")
    assert skipped is not None
    assert str(skipped.get("message")).startswith("a fault of the client, not of the hand: ")


# ------------------------------------------------------------- boundaries of the single checks


def context(name: str, t: Floats, q: Floats, **columns: Floats) -> Context:
    """Commands to a left hand, and states of a hand that is always where it is commanded.

    :param q: shape (n, n_joints), as all columns.
    """
    requirement = BY_ID[name]
    spoken = dialect(requirement.dialects[0])
    joints = joints_of(spoken, Side.LEFT)
    gains = model(spoken.model).gains
    kp, kd = (np.tile([g[i] for g in gains], (len(t), 1)) for i in (0, 1))
    zero, length = np.zeros_like(q), np.full(len(t), spoken.length)
    given_columns = {"kp": kp, "kd": kd, "dq": zero, "tau": zero, "mode": zero, **columns}
    count = np.asarray(given_columns.pop("length", length), dtype=np.intp)
    topic, state = spoken.topics(Side.LEFT)
    commands = Commands(topic, t, t, count, q, **given_columns)
    states = States(state, t, t, length, q, zero, zero, zero, zero)
    view = SideView(Side.LEFT, states, commands, joints)
    recording = Recording(
        spoken, 0, float(t[-1]), {Side.LEFT: view}, [], [], None, judged=(Side.LEFT,)
    )
    return layer("client").context.load()(recording, view, requirement)


def judged(ctx: Context) -> Outcome:
    return check_of(ctx.requirement)(ctx)


def still(count: int, rate: float = 200.0, joints: int = 1) -> tuple[Floats, Floats]:
    return np.arange(count) / rate, np.zeros((count, joints))


@given(
    rate=st.floats(1.0, 1000.0),
    limit=st.sampled_from([25.0, 90.0, 180.0]),
    window=st.sampled_from([0.5, 1.0]),
)
def test_steady_client_passes_from_the_limit_on(rate: float, limit: float, window: float) -> None:
    t = np.asarray(np.arange(0.0, 3.0, 1.0 / rate), dtype=np.float64)
    least, found = slow_stretches(t, limit, window)
    assert bool(found) is (rate < limit * (1.0 - 1e-6))
    assert least == pytest.approx(rate, rel=1e-6)


def test_zero_gains_stop_a_joint_at_the_end_and_nowhere_else() -> None:
    t, q = still(100)
    for rows, met in ((slice(90, 100), True), (slice(0, 10), True), (slice(40, 50), False)):
        kp, kd = np.full((100, 1), 5.0), np.full((100, 1), 0.05)
        kp[rows], kd[rows] = 0.0, 0.0
        assert judged(context("DEX1-CLIENT-09", t, q, kp=kp, kd=kd)).met is met


@given(speed=st.floats(-10.0, 10.0), hold=st.integers(1, 10))
def test_one_client_at_full_speed_is_not_taken_for_two(speed: float, hold: int) -> None:
    t = np.arange(800) / 200.0
    q = 2.7 + 2.5 * np.sin(speed * (np.arange(800) // hold * hold) / 200.0)
    assert judged(context("DEX1-CLIENT-11", t, q[:, None])).met


def test_session_ends_at_rest_or_with_a_stop() -> None:
    t, q = still(400)
    moving = np.linspace(0.0, 3.0, 400)[:, None]
    for goal, stop, met in ((q, False, True), (moving, False, False), (moving, True, True)):
        kp = np.full((400, 1), 5.0)
        kd = np.full((400, 1), 0.05)
        if stop:
            kp[-1], kd[-1] = 0.0, 0.0
        ctx = context("DEX1-CLIENT-13", t, goal, kp=kp, kd=kd)
        assert judged(ctx).reason == "the recording ends before the client does"
        later = np.append(ctx.states.t, t[-1] + 1.0)
        at_end = np.append(ctx.states.q, ctx.states.q[-1:], axis=0)
        states = replace(ctx.states, t=later, sent=later, q=at_end)
        outcome = judged(replace(ctx, hand=replace(ctx.hand, states=states)))
        assert outcome.met is met, outcome


# ------------------------------------------------------------- mode bytes that a hand does not need


MODES = {"dex3": ("DEX3", 1), "dex5": ("DEX5", 0)}
"""A byte for all motors that is wrong by the documents, and that some real hands move by."""


@cache
def session_of_good_hands(name: str) -> Recording:
    return recording_of(run_client(ReferenceClient, dialect(name)), None, ())


def with_mode(name: str, *, follows: bool, value: int) -> RunResult:
    """A session of good hands whose client sends one mode byte to every motor."""
    recording = session_of_good_hands(name)
    sides = {}
    for side, view in recording.sides.items():
        states, commands = view.states, view.commands
        mode = np.full_like(commands.mode, value)
        held = np.tile(states.q[:1], (len(states), 1))
        states = states if follows else replace(states, q=held, dq=np.zeros_like(held))
        sides[side] = replace(view, states=states, commands=replace(commands, mode=mode), known={})
    return judge(replace(recording, sides=sides))


@each("name", MODES)
def test_wrong_mode_byte_that_a_hand_follows_is_a_warning_and_spoils_nothing(name: str) -> None:
    prefix, value = MODES[name]
    result = with_mode(name, follows=True, value=value)
    (one, *_) = [r for r in result.client if r.requirement.id == f"{prefix}-CLIENT-10"]
    assert one.verdict is Verdict.WARN
    assert "the hand follows them all the same" in one.observed
    assert result_of(result, f"{prefix}-TRACK-01").verdict is Verdict.PASS
    assert not any("CLIENT-10" in r.blocked_by for r in result.results)


@each("name", MODES)
def test_wrong_mode_byte_that_a_hand_obeys_is_the_clients_failure(name: str) -> None:
    prefix, value = MODES[name]
    result = with_mode(name, follows=False, value=value)
    (one, *_) = [r for r in result.client if r.requirement.id == f"{prefix}-CLIENT-10"]
    assert one.verdict is Verdict.FAIL
    assert result_of(result, f"{prefix}-TRACK-01").blocked_by == f"{prefix}-CLIENT-10"
