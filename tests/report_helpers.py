"""Results made by hand, for the reports."""

from __future__ import annotations

from dataclasses import replace

from dexkit.conformance.kit.requirements import catalogue
from dexkit.conformance.kit.results import Evidence, Result, RunResult, Stage, Verdict

HOSTILE = "<script>alert('x')</script> | `@everyone` [a](http://evil.example) & \"q\" \x00\x1b[31m"


def result_of_every_kind(text: str = "plain words") -> RunResult:
    """A run in which each verdict occurs; ``text`` stands wherever text comes from outside."""
    every = [r for r in catalogue("dex1-1") if "unitree_go" in r.dialects]
    place = Evidence(f"rt/{text}", 1.25, 1_700_000_001_250_000_000, 1.5)
    results = []
    for need, verdict in zip(every, Verdict, strict=False):
        failed = verdict in (Verdict.FAIL, Verdict.WARN)
        for side in ("left", "right"):
            results.append(
                Result(
                    requirement=need,
                    side=side,
                    verdict=verdict,
                    figure=f"1 {text}" if verdict.judged else "",
                    observed=f"saw {text}" if verdict.judged else "",
                    reason="" if verdict.judged else f"because {text}",
                    evidence=(place,) if failed else (),
                    values={"max_gap_s": 0.25, "rate_hz": 199.5} if verdict.judged else {},
                    cause=f"cause {text} {side}" if failed else "",
                    blocked_by=every[1].id if verdict is Verdict.BLOCKED else "",
                )
            )
    return RunResult(
        subject={"model": "dex1-1", "dialect": "unitree_go", "backend": text, "sides": "both"},
        results=results,
        stage={"left": Stage.MOVING, "right": Stage.TOPIC_SEEN},
        duration_s=12.5,
        notes=[text],
        environment={"dexkit": "0", text: text},
        recorded_at="2026-01-02T03:04:05+00:00",
        harness={"jitter_p50_ms": 0.1, "jitter_p99_ms": 1.5, "starved": 0.01},
        claims={"force": True, "velocity": False},
    )


def run_named(name: str, when: str, **verdicts: Verdict) -> RunResult:
    """A run of the hand ``name`` with these verdicts of ``DEX1-`` requirements."""
    needs = {r.id: r for r in catalogue("dex1-1")}
    results = [
        Result(needs[f"DEX1-{k.replace('_', '-')}"], "left", v, figure=f"{name} {k}")
        for k, v in verdicts.items()
    ]
    base = result_of_every_kind()
    about = {"hand": name, "backend": "x", "sides": "left"}
    subject = {"model": "dex1-1", "dialect": "unitree_go", **about}
    return replace(base, subject=subject, results=results, recorded_at=when)
