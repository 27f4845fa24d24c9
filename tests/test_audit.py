"""An audit judges every file as ``dexkit check`` does; what is wrong with a file is a row."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from dexkit.cli import main
from dexkit.conformance.audit import objects
from dexkit.conformance.audit.audit import Audit, AuditProgress, in_this_process
from dexkit.conformance.audit.examine import Task, examine
from dexkit.conformance.audit.journal import Journal
from dexkit.conformance.audit.records import EpisodeRecord, RequirementFinding, State
from dexkit.conformance.audit.result_tables import EPISODE, FINDINGS, have_parquet
from dexkit.conformance.audit.summary_page import Summary, render
from dexkit.conformance.audit.units import Unit, find
from dexkit.conformance.audit.workers import Pool, WorkerLost
from dexkit.conformance.kit.decoding import recording_of
from dexkit.conformance.kit.judge import judge
from dexkit.conformance.kit.results import Verdict
from dexkit.errors import DexkitError, OutputError, UsageError
from dexkit.records import to_record
from dexkit.traces import open_trace, sample_path
from tests.audit_work import work
from tests.trace_helpers import CMD_TYPE, Shape, mcap_bytes, rows

SAMPLE = "dex1_legacy_v1_1"


def copied(folder: Path, name: str, sample: str = SAMPLE) -> Path:
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(sample_path(sample), target)
    return target


def small(path: Path, count: int = 40) -> Path:
    """A session of a moment, which is inconclusive: its client spoils what little there is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(mcap_bytes(rows(count), Shape(), metadata={"session": {"Operator": "ann"}}))
    return path


def examined(unit: Unit, known: str = "", max_size: int = 2**33) -> EpisodeRecord:
    (record,) = examine(Task((unit,), known, max_size))
    return record


def audited(
    folder: Path, out: Path, **options: Any
) -> tuple[AuditProgress, dict[str, EpisodeRecord]]:
    outcome = Audit([str(folder)], out, **options).run(in_this_process)
    with Journal(out / "journal.jsonl") as journal:
        found = [journal.read(entry) for entry in journal.entries.values()]
    return outcome, {Path(r.name).name: r for r in found}


def test_a_file_gets_the_verdicts_of_dexkit_check(tmp_path: Path) -> None:
    path = copied(tmp_path, "a.mcap", "dex1_hand_dropout")
    found = examined(Unit("a.mcap", str(path), path.stat().st_size, "1"))
    result = judge(recording_of(open_trace(path), None, ()))
    assert found.state is State.JUDGED
    assert (found.overall, found.exit_code) == (str(result.overall), result.exit_code())
    expected = [
        (r.requirement.id, r.side, r.verdict, r.observed) for r in (*result.results, *result.client)
    ]
    assert [(f.requirement, f.side, f.verdict, f.observed) for f in found.findings] == expected
    gap = found.facts["sides"]["left"]["states"]["max_s"]
    assert gap == pytest.approx(1.502, abs=0.001)
    failure = next(f for f in found.findings if f.verdict is Verdict.FAIL)
    assert failure.requirement == "DEX1-RATE-03"
    assert failure.evidence_s == pytest.approx(9.496, abs=0.01)
    assert failure.value > failure.limit
    assert EpisodeRecord.of_line(found.as_line()) == found


def test_unusable_file_becomes_a_row(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    good = copied(archive, "good.mcap").read_bytes()
    small(archive / "small.mcap")
    (archive / "empty.mcap").write_bytes(b"")
    (archive / "text.mcap").write_text("not a recording\n")
    (archive / "cut.mcap").write_bytes(good[: len(good) // 2])
    damaged = bytearray(good)
    damaged[len(good) // 3 : len(good) // 3 + 64] = bytes(64)
    (archive / "damaged.mcap").write_bytes(damaged)
    (archive / "other.mcap").write_bytes(
        mcap_bytes([("rt/x", t, p, d) for _, t, p, d in rows(4)], types={"rt/x": CMD_TYPE})
    )
    (archive / "folder.mcap").mkdir()
    os.mkfifo(archive / "pipe.mcap")
    (archive / "dangling.mcap").symlink_to("nowhere")
    (archive / "notes.txt").write_text("no session")
    outcome, found = audited(archive, tmp_path / "out")
    states = {name: (str(r.state), r.exit_code) for name, r in found.items()}
    assert states == {
        "good.mcap": ("judged", 0),
        "small.mcap": ("judged", 2),
        "empty.mcap": ("unreadable", 2),
        "text.mcap": ("unreadable", 2),
        "cut.mcap": ("judged", found["cut.mcap"].exit_code),
        "damaged.mcap": ("judged", 2),
        "other.mcap": ("unreadable", 2),
        "pipe.mcap": ("unreadable", 2),
        "dangling.mcap": ("gone", 2),
    }
    assert found["cut.mcap"].facts["truncated"]
    assert found["damaged.mcap"].error.startswith("damaged: ")
    assert "no hand of the Dex family" in found["other.mcap"].error
    assert all(r.error for r in found.values() if r.exit_code == 2)
    assert (outcome.done, outcome.total) == (9, 9)
    assert (outcome.failing, outcome.unusable) == (0, 7)
    assert (outcome.exit_code(), outcome.exit_code("fail")) == (2, 0)


def test_exit_code_follows_fail_on() -> None:
    def code(fail_on: str, **counts: int) -> int:
        return AuditProgress(total=2, done=2, **counts).exit_code(fail_on)

    assert AuditProgress().exit_code("fail") == 2  # nothing was done, which is not a pass
    assert [code(on, failing=1, unusable=1) for on in ("never", "fail", "unusable")] == [0, 1, 1]
    assert [code(on, unusable=1, warned=1) for on in ("fail", "unusable", "warn")] == [0, 2, 2]
    assert [code(on, warned=1) for on in ("unusable", "warn")] == [0, 1]


def test_tables_have_a_row_for_each_file_and_finding(tmp_path: Path) -> None:
    small(tmp_path / "archive/day/a.mcap")
    (tmp_path / "archive/b.mcap").write_bytes(b"")
    out = tmp_path / "out"
    audited(tmp_path / "archive", out, parquet=False)
    lines = {
        name: [json.loads(line) for line in (out / f"{name}.jsonl").open()]
        for name in ("episodes", "findings")
    }
    b, a = lines["episodes"]
    assert list(a) == list(EPISODE)
    assert (a["operator"], a["state"], b["state"]) == ("ann", "judged", "unreadable")
    assert {f["side"] for f in lines["findings"]} == {"left"}
    assert all(list(f) == list(FINDINGS) for f in lines["findings"])
    with Journal(out / "journal.jsonl") as journal:
        assert len(lines["findings"]) == len(journal.read(journal.entries[a["episode"]]).findings)
    if not have_parquet():
        with pytest.raises(UsageError, match="pyarrow"):
            audited(tmp_path / "archive", out, parquet=True)
        return
    import pyarrow.parquet as pq

    audited(tmp_path / "archive", out, parquet=True)
    assert not list(out.glob("f*.jsonl"))
    for name, expected in lines.items():
        assert pq.read_table(out / f"{name}.parquet").to_pylist() == expected


def test_unchanged_files_are_not_judged_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive, out = tmp_path / "archive", tmp_path / "out"
    paths = [small(archive / f"{name}.mcap", count) for name, count in (("a", 40), ("b", 44))]
    judged: list[str] = []

    def run() -> tuple[int, list[str]]:
        judged.clear()
        outcome, _ = audited(archive, out)
        return outcome.reused, [Path(name).name for name in judged]

    genuine = recording_of

    def counted(trace: Any, *rest: Any) -> Any:
        judged.append(str(trace.path))
        return genuine(trace, *rest)

    monkeypatch.setattr("dexkit.conformance.audit.examine.recording_of", counted)
    assert run() == (0, ["b.mcap", "a.mcap"])  # the largest first
    assert run() == (2, [])
    os.utime(paths[0], ns=(1, 1))  # another time, the same content
    assert run() == (1, [])
    assert run() == (2, [])
    small(paths[0], 48)
    assert run() == (1, ["a.mcap"])
    journal = out / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-100])  # as a kill leaves it
    assert run() == (1, ["a.mcap"])
    monkeypatch.setattr("dexkit.conformance.audit.examine.__version__", "0.0.0")
    assert run() == (0, ["a.mcap", "b.mcap"])
    paths[1].unlink()
    assert run() == (1, [])
    tables = out / ("episodes.parquet" if have_parquet() else "episodes.jsonl")
    assert b"b.mcap" not in tables.read_bytes()


def test_a_stop_leaves_a_partial_result_that_the_next_audit_completes(tmp_path: Path) -> None:
    archive, out = tmp_path / "archive", tmp_path / "out"
    for count in (40, 44, 48):
        small(archive / f"{count}.mcap", count)
    stop: list[bool] = []

    def after_two(outcome: AuditProgress) -> None:
        if outcome.done == 2:
            stop.append(True)

    audit = Audit([str(archive)], out, parquet=False)
    outcome = audit.run(in_this_process, stop, after_two)
    assert (outcome.done, outcome.total, outcome.stopped) == (2, 3, True)
    assert len((out / "episodes.jsonl").read_text().splitlines()) == 2
    assert "1 episode not examined" in (out / "summary.html").read_text()
    outcome = audit.run(in_this_process)
    assert (outcome.done, outcome.reused, outcome.stopped) == (3, 2, False)
    assert len((out / "episodes.jsonl").read_text().splitlines()) == 3


def test_two_audits_cannot_share_a_journal(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    with Journal(path), pytest.raises(UsageError, match="another audit"):
        Journal(path)
    path.write_text("mine\n")
    with pytest.raises(UsageError, match="not the journal"):
        Journal(path)
    assert path.read_text() == "mine\n"
    with pytest.raises(OutputError):
        Journal(tmp_path / "no" / "journal.jsonl")


def test_objects_behind_a_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judged as files are; one vanishes, one is refused, one is replaced meanwhile: rows."""
    monkeypatch.setattr(objects, "_PAUSE", 0.0)
    memory = MemoryFileSystem()
    data = small(tmp_path / "local.mcap").read_bytes()
    names = ("good", "gone", "refused", "broken", "large", "flaky", "replaced")
    faults = iter((True, True))
    for name in names:
        memory.pipe(f"/archive/{name}.mcap", data + b"\0" * (name == "large"))
    memory.pipe("/archive/notes.txt", b"")
    genuine = type(memory).cat_file
    errors = {"gone": FileNotFoundError(2, "gone"), "refused": PermissionError(13, "refused")}

    def given(self: Any, path: str, *rest: Any, **more: Any) -> Any:
        if (name := Path(path).stem) in errors:
            raise errors[name]
        if name == "broken":
            raise RuntimeError("the storage has a fault")
        if name == "flaky" and next(faults, False):
            raise RuntimeError("for a moment")
        if name == "replaced":
            memory.pipe_file(path, data)
        return genuine(self, path, *rest, **more)

    monkeypatch.setattr(type(memory), "cat_file", given)
    try:
        found = list(find("memory://archive"))
        units = [s for s in found if isinstance(s, Unit)]
        records = {Path(s.name).stem: examined(s, max_size=len(data)) for s in units}
        again = [examined(s, records["good"].sha256) for s in units if "good" in s.name]
    finally:
        memory.rm("/archive", recursive=True)
    assert {name: str(r.state) for name, r in records.items()} == {
        "good": "judged",
        "gone": "gone",
        "refused": "no permission",
        "broken": "unavailable",
        "large": "judged",
        "flaky": "judged",
        "replaced": "unavailable",
    }
    local = examined(Unit("x", str(tmp_path / "local.mcap"), len(data), ""))
    assert records["good"].findings == local.findings
    assert records["good"].sha256 == local.sha256
    assert records["broken"].error == "RuntimeError: the storage has a fault"
    assert not again[0].findings
    assert all(isinstance(s, Unit) and s.tag for s in found)
    (missing,) = find("memory://nowhere")
    assert isinstance(missing, EpisodeRecord)
    assert missing.state is State.GONE
    with pytest.raises(UsageError, match="nosuch"):
        list(find("nosuch://a"))


def test_exception_in_the_judging_becomes_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = small(tmp_path / "a.mcap")

    def wrong(*given: Any, **more: Any) -> Any:
        raise KeyError("a mistake")

    monkeypatch.setattr("dexkit.conformance.audit.examine.judge", wrong)
    found = examined(Unit("a", str(path), 1, "1"))
    assert (found.state, found.exit_code) == (State.FAILED, 2)
    assert "KeyError: 'a mistake'" in found.error
    assert not found.state.final


def test_processes_may_die_hang_and_grow() -> None:
    pool: Pool[str, str] = Pool(work, jobs=2, memory=2**30)
    found = dict(pool.run(["die", "a", "leave", "b", "grow", "c"]))
    assert found == {
        "die": "its process died (SIGKILL)",
        "leave": "its process died (exit code 3)",
        "grow": "no memory",
        **{name: name.upper() for name in "abc"},
    }
    assert isinstance(found["die"], WorkerLost)
    pool = Pool(work, jobs=1, seconds=0.0)
    assert dict(pool.run(["hang"])) == {"hang": "it took longer than 0 s"}
    assert not dict(Pool(work, jobs=1).run(["hang"], stop=True))


def test_files_that_cannot_be_examined_are_tried_again(tmp_path: Path) -> None:
    small(tmp_path / "a.mcap")
    audit = Audit([str(tmp_path / "a.mcap")], tmp_path / "out", parquet=False)

    def lose(tasks: Any, stop: object) -> Any:
        yield from ((task, WorkerLost("its process died (SIGKILL)")) for task in tasks)

    outcome = audit.run(lose)
    assert (outcome.done, outcome.unusable, outcome.exit_code()) == (1, 1, 2)
    assert "its process died" in (tmp_path / "out/episodes.jsonl").read_text()
    outcome = audit.run(in_this_process)
    assert outcome.reused == 0
    assert "INCONCLUSIVE" in (tmp_path / "out/episodes.jsonl").read_text()


def test_summary_page_lists_worst_files_and_trends(tmp_path: Path) -> None:
    summary = Summary()
    for day in range(1, 5):
        for name, verdict in (("good", "pass"), ("<b>bad", "fail")):
            row = ["hand", "DEX1-RATE-03", "MUST", "drop-in", "left", verdict, "", "a gap"]
            finding = to_record(
                [*row, "", "", None, None, "", "", None, None], RequirementFinding, "it"
            )
            summary.add(
                EpisodeRecord(
                    f"{day}/{name}.mcap",
                    state=State.JUDGED,
                    overall="fail" if day > 2 and verdict == "fail" else "pass",
                    exit_code=0,
                    facts={
                        "recorded_at": f"2026-01-0{day}T10:00:00+00:00",
                        "labels": {"operator": name},
                        "duration_s": 3600.0,
                    },
                    findings=[finding] if day > 2 or verdict == "pass" else [],
                )
            )
    page = render(summary, locations=["archive"], left=3)
    assert "hands in 2 recordings are no drop-ins" in page
    assert "3 episodes not examined" in page
    assert "<b>bad" not in page
    assert page.index("3/&lt;b&gt;bad.mcap") < page.index("Over time")
    assert "since 2026-01-01" in page
    assert "By operator" in page
    assert "8.0 h" in page


def test_command_writes_tables_page_and_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    small(tmp_path / "archive/a.mcap")
    copied(tmp_path, "archive/b.mcap", "dex1_hand_dropout")

    def run(*arguments: str) -> tuple[Any, str]:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(SystemExit) as ended:
            main(["audit", *arguments])
        return ended.value.code, "".join(capsys.readouterr())

    code, text = run("archive", "--jobs", "1", "--set", "format=jsonl")
    assert code == 1
    assert "2 of 2 episodes" in text
    lines = (tmp_path / "audit-out/episodes.jsonl").read_text().splitlines()
    assert [json.loads(line)["episode"] for line in lines] == ["archive/a.mcap", "archive/b.mcap"]
    code, text = run("archive", "--set", "format=jsonl", "--fail-on", "never")
    assert (code, "2 unchanged" in text) == (0, True)
    (tmp_path / "none").mkdir()
    code, text = run("none")
    assert (code, "no episode" in text) == (2, True)
    code, text = run("nowhere")
    assert code == 2


def test_without_fsspec_a_url_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(DexkitError, match="needs fsspec"):
        list(find("s3://bucket"))


@pytest.mark.soak
def test_a_generated_archive_is_scored(tmp_path: Path) -> None:
    """Every fault is found in a short session of each sample, and nothing else is blamed."""
    from tools.generate_archive import FAULTS, generate
    from tools.generate_archive.score import score

    archive = tmp_path / "archive"
    count = len(FAULTS) + 1
    answers = generate(archive, count, len(FAULTS), seconds=1, samples=["dex1_pick_place"])
    assert sorted(a.fault for a in answers) == ["", *sorted(f.name for f in FAULTS)]
    audited(archive, tmp_path / "out")
    found = score(archive, tmp_path / "out")
    assert (found.text(), found.perfect) == (found.text(), True)
    assert (found.good, found.found) == (1, len(FAULTS))
