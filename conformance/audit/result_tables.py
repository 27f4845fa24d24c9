"""Write the rows of an audit: Parquet where pyarrow is installed, else lines of JSON.

Two tables, written in one step each: ``episodes`` with a row for each episode and each dataset as a
whole, ``findings`` with a row for each finding about training, and each requirement and side.
Rows are written as they are read, some episodes at a time.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
from msgspec import structs

from dexkit.conformance.audit.records import EpisodeRecord, RequirementFinding
from dexkit.conformance.dataset.findings import Finding, Judgement
from dexkit.documents import write_file
from dexkit.errors import UsageError
from dexkit.escaping import output_error
from dexkit.staging import whole_file

__all__ = ["EPISODE", "FINDINGS", "have_parquet", "write_tables"]

EPISODE: dict[str, type] = {
    "episode": str,
    "source": str,
    "number": str,
    "form": str,
    "is_set": bool,
    "verdict": str,
    "reasons": str,
    "figures": str,
    "judged": str,
    "size": int,
    "tag": str,
    "sha256": str,
    "dexkit": str,
    "catalogue": str,
    "state": str,
    "error": str,
    "overall": str,
    "client": str,
    "exit_code": int,
    "model": str,
    "dialect": str,
    "layer": str,
    "recorded_at": str,
    "duration_s": float,
    "messages": int,
    "truncated": bool,
    "damaged": bool,
    "longest_gap_s": float,
    "state_hz": float,
    "failed": int,
    "warned": int,
    "passed": int,
    "robot": str,
    "operator": str,
    "labels": str,
    "topics": str,
    "sides": str,
    "notes": str,
}
"""Columns of ``episodes``; ``reasons``, ``figures``, ``judged`` and the last four are JSON."""
_OF_EPISODE = (
    "episode",
    "source",
    "sha256",
    "dexkit",
    "catalogue",
    "model",
    "dialect",
    "recorded_at",
)
FINDINGS: dict[str, type] = {
    **{name: EPISODE[name] for name in _OF_EPISODE},
    **{
        f.name: float if f.type == float | None else str
        for f in msgspec.structs.fields(RequirementFinding)
    },
}
"""Columns of ``findings``."""
_BATCH = 200  # episodes whose rows are held at once


def have_parquet() -> bool:
    """Whether pyarrow is installed."""
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError:
        return False
    return True


def episode_row(record: EpisodeRecord) -> dict[str, Any]:
    """The row of an episode in ``episodes``."""
    judgement = record.judgement or Judgement()
    facts = record.facts
    verdicts = [str(v) for v in record.verdicts().values()]
    states = [side["states"] for side in facts.get("sides", {}).values()]
    gaps = [s["max_s"] for s in states if "max_s" in s]
    rates = [s["mean_hz"] for s in states if s.get("mean_hz") is not None]
    labels = facts.get("labels", {})
    return {
        **{name: getattr(record, name) for name in ("size", "tag", "sha256", "dexkit", "error")},
        **{name: getattr(record, name) for name in ("catalogue", "overall", "client", "exit_code")},
        **{name: facts.get(name, "") for name in ("model", "dialect", "layer", "recorded_at")},
        **{name: facts.get(name) for name in ("duration_s", "messages", "truncated")},
        **{name: labels.get(name, "") for name in ("robot", "operator")},
        **{name: getattr(record, name) for name in ("source", "form", "is_set")},
        "episode": record.name,
        "number": record.episode,
        "verdict": record.use,
        "reasons": json.dumps([structs.asdict(f) for f in judgement.reasons]),
        "figures": json.dumps(judgement.figures),
        "judged": json.dumps(judgement.judged),
        "state": str(record.state),
        "damaged": bool(facts.get("damage")),
        "longest_gap_s": max(gaps, default=None),
        "state_hz": min(rates, default=None),
        "failed": verdicts.count("fail"),
        "warned": verdicts.count("warn"),
        "passed": verdicts.count("pass"),
        "labels": json.dumps(labels),
        "topics": json.dumps(facts.get("topics", [])),
        "sides": json.dumps(facts.get("sides", {})),
        "notes": json.dumps([*facts.get("warnings", []), *facts.get("notes", [])]),
    }


def finding_rows(record: EpisodeRecord) -> list[dict[str, Any]]:
    """The rows of an episode in ``findings``."""
    row = episode_row(record)
    about = {name: row[name] for name in _OF_EPISODE}
    training = [] if record.judgement is None else record.judgement.findings
    rows = [*map(_training_row, training), *(finding.as_row() for finding in record.findings)]
    return [{**found, **about} for found in rows]


def _training_row(finding: Finding) -> dict[str, Any]:
    """A finding about training in the columns of a requirement: its check, part and use are the
    requirement, side and verdict.
    """
    return {
        **{name: None if kind is float else "" for name, kind in FINDINGS.items()},
        "about": "training",
        "requirement": finding.check,
        "side": finding.part,
        "verdict": str(finding.use),
        "observed": finding.text,
        "value": finding.value,
        "limit": finding.limit,
        "unit": finding.unit,
        "evidence_s": finding.begin_s,
        "evidence_end_s": finding.end_s,
    }


def write_tables(
    folder: Path, records: Callable[[], Iterator[EpisodeRecord]], *, parquet: bool | None = None
) -> list[Path]:
    """Write both tables.

    :param records: begins again each time it is called.
    :param parquet: None where pyarrow decides.
    :raises UsageError: Parquet without pyarrow.
    :raises OutputError: a table cannot be written.
    """
    if parquet and not have_parquet():
        raise UsageError("Parquet needs pyarrow", hint="pip install 'dexkit[audit]'")
    parquet = have_parquet() if parquet is None else parquet
    suffix, stale = (".parquet", ".jsonl") if parquet else (".jsonl", ".parquet")
    written = []
    for name, columns, rows in (
        ("episodes", EPISODE, lambda r: [episode_row(r)]),
        ("findings", FINDINGS, finding_rows),
    ):
        path = folder / f"{name}{suffix}"
        if parquet:
            _write_parquet(path, columns, rows, records())
        else:
            write_file(path, _lines(columns, rows, records()))
        with contextlib.suppress(OSError):  # that of an audit before, which is no longer true
            (folder / f"{name}{stale}").unlink()
        written.append(path)
    return written


_Rows = Callable[[EpisodeRecord], list[dict[str, Any]]]


def _lines(
    columns: dict[str, type], rows: _Rows, records: Iterator[EpisodeRecord]
) -> Iterator[bytes]:
    for record in records:
        lines = [json.dumps({name: row[name] for name in columns}) for row in rows(record)]
        yield "".join(f"{line}\n" for line in lines).encode()


def _write_parquet(
    path: Path, columns: dict[str, type], rows: _Rows, records: Iterator[EpisodeRecord]
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, kinds[kind]) for name, kind in columns.items()])
    try:
        with (
            whole_file(path) as place,
            pq.ParquetWriter(place, schema, compression="zstd") as writer,
        ):
            for batch in _batches(records):
                every = [row for record in batch for row in rows(record)]
                values = {name: [row[name] for row in every] for name in columns}
                writer.write_table(pa.table(values, schema=schema))
    except OSError as error:
        raise output_error(path, error) from error


def _batches(records: Iterator[EpisodeRecord]) -> Iterator[list[EpisodeRecord]]:
    batch: list[EpisodeRecord] = []
    for record in records:
        batch.append(record)
        if len(batch) == _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch
