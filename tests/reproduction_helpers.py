"""Recordings of runs in files, and what ``dexkit check`` of another process says of them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from dexkit.conformance.kit.claims import Claims
from dexkit.conformance.kit.requirements import CAPABILITIES, catalogue
from dexkit.conformance.kit.run_record import RECORD, run_record
from dexkit.conformance.usb.record import RECORD as USB_RECORD
from dexkit.conformance.usb.record import SCHEMA, SCHEMA_NAME, UsbRecord, topic
from dexkit.conformance.usb.recording import UsbSide
from dexkit.conformance.virtual import MemoryTrace
from dexkit.hand import Side
from dexkit.traces.recorder import Recorder
from tests.conformance_helpers import copy_of, short_run, with_beats

CLAIMS = Claims(dict.fromkeys(CAPABILITIES, True), {"name": "Fist", "model": "dex1-1"})


def write_run(path: Path) -> Path:
    """Write a run of the left hand, on a machine whose timer was always 1.234 ms late."""
    trace = copy_of(short_run())
    with_beats(trace, usual_us=1_234)
    about = run_record(
        subject={"backend": "virtual"},
        dialect="unitree_go",
        sides=[Side.LEFT],
        phases=["step", "silence"],
        rounds=1,
        requirements=catalogue("dex1-1", "dds"),
        claims=CLAIMS,
    )
    trace.metadata[RECORD] = about
    with Recorder(path) as recorder:
        write_trace(trace, recorder)
    return path


def write_trace(trace: MemoryTrace, recorder: Recorder) -> None:
    """Put a recording in memory into a file."""
    endpoints = {
        f"{e.topic} {e.kind}": f"{e.reliability}, Durability.{e.durability}, type={e.type_name}"
        for e in trace.endpoints
    }
    for name, values in {**trace.metadata, "dds_endpoints": endpoints}.items():
        recorder.add_metadata(name, values)
    for (name, kind), rows in trace.rows.items():
        for log_ns, sent_ns, data in rows:
            assert recorder.put(name, kind, data, log_ns, sent_ns)


def write_usb(hand: UsbSide, recorder: Recorder) -> None:
    """Put the USB transfers of a hand into a file."""
    for transfer in hand.transfers:
        name = topic(hand.side, inward=transfer.inward)
        recorder.add_foreign_channel(name, SCHEMA_NAME, SCHEMA)
        recorder.put(name, SCHEMA_NAME, transfer.payload(), transfer.done_ns, transfer.submitted_ns)
    recorder.add_metadata(USB_RECORD, UsbRecord({hand.side: hand.record}).to_metadata())


def checked(
    path: Path, out: Path, python: str | Path = sys.executable, *, hash_seed: str = "0"
) -> dict[str, Any]:
    """The result file of ``dexkit check``, in a process of its own."""
    subprocess.run(
        [python, "-m", "dexkit", "check", path, "--result", out],
        env=os.environ | {"PYTHONHASHSEED": hash_seed},
        capture_output=True,
        check=False,
        cwd=out.parent,
        timeout=300,
    )
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def without_surroundings(data: dict[str, Any]) -> dict[str, Any]:
    """A result without the versions of the program that judged, and what names the file."""
    left = {k: v for k, v in data.items() if k != "environment"}
    left["subject"] = {
        k: v for k, v in data["subject"].items() if k not in ("recording", "recording_sha256")
    }
    return left
