"""The suite: one test for each requirement and side. See docs/conformance.md."""

from __future__ import annotations

import warnings

import pytest

from dexkit.conformance.kit.known_backends import SIMULATED
from dexkit.conformance.kit.plugin import OPTIONS_KEY, REPORTED_KEY
from dexkit.conformance.kit.requirements import Level, catalogue
from dexkit.conformance.kit.results import Verdict
from dexkit.hand import Side

pytestmark = pytest.mark.conformance

HOW = (
    "name the hand to judge: --backend ezgripper or dex3-usb (emulated unless --device is given), "
    f"--backend {', '.join(SIMULATED)}, --backend package.module:Class, or "
    "--backend external"
)


class ConformanceWarning(UserWarning):
    """A SHOULD that is not met."""


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Requirements become test ids: ``test_requirement[DEX1-RATE-01-left]``."""
    options = metafunc.config.stash.get(OPTIONS_KEY, None)
    requirements = options.requirements if options else catalogue()
    sides = options.sides if options else tuple(Side)
    cases = [pytest.param(r.id, str(s), id=f"{r.id}-{s}") for r in requirements for s in sides]
    metafunc.parametrize(("requirement", "side"), cases)


def test_requirement(requirement: str, side: str, request: pytest.FixtureRequest) -> None:
    """Report the run's result of one requirement."""
    if request.config.stash.get(OPTIONS_KEY, None) is None:
        pytest.skip(HOW)
    run = request.getfixturevalue("conformance_run")
    result = next(r for r in run.results if (r.requirement.id, r.side) == (requirement, side))
    request.config.stash[REPORTED_KEY].append(result)
    level, verdict = result.requirement.level, result.verdict
    if verdict in (Verdict.NOT_APPLICABLE, Verdict.NOT_CLAIMED):
        pytest.skip(result.reason)
    if verdict in (Verdict.BLOCKED, Verdict.ERROR) and level is not Level.MUST:
        pytest.skip(f"{verdict}: {result.reason}")  # only an open MUST is no pass
    if result.verdict is Verdict.WARN:
        warnings.warn(result.explain(), ConformanceWarning, stacklevel=1)
    elif result.verdict is not Verdict.PASS:
        pytest.fail(result.explain(), pytrace=False)
