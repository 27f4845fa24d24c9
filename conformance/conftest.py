from __future__ import annotations

import sys
import traceback

import pytest

from dexkit.conformance.plugin import OPTIONS_KEY, RESULT_KEY
from dexkit.conformance.results import RunResult
from dexkit.conformance.session import run_suite
from dexkit.errors import DexkitError


@pytest.fixture(scope="session")
def conformance_run(request: pytest.FixtureRequest) -> RunResult:
    """The one run that every requirement is judged by."""
    options = request.config.stash[OPTIONS_KEY]
    assert options is not None
    capture = request.config.pluginmanager.getplugin("capturemanager")

    def say(text: str) -> None:
        with capture.global_and_fixture_disabled():
            print(f"\n  ... {text}", end="", file=sys.stderr, flush=True)

    try:
        result = run_suite(options, say)
    except DexkitError as error:
        hint = f"\n{error.hint}" if error.hint else ""
        pytest.exit(f"the kit cannot judge: {error.message}{hint}", returncode=2)
    except Exception:  # once, instead of once for each requirement
        text = "the kit itself has failed, which says nothing about the hand"
        pytest.exit(f"{text}; please report this:\n{traceback.format_exc()}", returncode=2)
    request.config.stash[RESULT_KEY] = result
    return result
