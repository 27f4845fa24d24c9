"""Some inputs of the fuzzers of devices, drivers and recordings, with a fixed seed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.campaign.case import Batch, Case
from tools.campaign.fuzz import devices, drivers, recordings

CASES = [*devices.cases(), *drivers.cases(), *recordings.cases()]
_SLOW = {"fuzz:mcap"}  # 'make campaign-sample' runs it, too


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=[pytest.mark.soak] if c.name in _SLOW else [])
        for c in CASES
    ],
)
def test_fuzzer_has_no_finding(case: Case, tmp_path: Path) -> None:
    batch = Batch(case.name, "0", 0, tmp_path)
    case.run(batch)
    assert batch.findings == []
    assert batch.units > 0
