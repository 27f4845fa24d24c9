from __future__ import annotations

import signal
import sys
import traceback
from typing import NoReturn

import pytest
from _pytest.outcomes import Exit

from dexkit.conformance.kit.plugin import OPTIONS_KEY, RESULT_KEY, WHY_KEY
from dexkit.conformance.kit.results import RunResult
from dexkit.conformance.kit.suite_run import run_suite
from dexkit.errors import DexkitError
from dexkit.stop_signals import stop_on_signals


class Ended(Exit):
    """Ends the pytest run with a message and an exit code."""


# pytest prints the exception's own name before the message: "conformance", not its module's path
Ended.__module__, Ended.__qualname__ = "builtins", "conformance"


@pytest.fixture(scope="session")
def conformance_run(request: pytest.FixtureRequest) -> RunResult:
    """The one run that every requirement is judged by."""
    options = request.config.stash[OPTIONS_KEY]
    assert options is not None
    capture = request.config.pluginmanager.getplugin("capturemanager")

    def report(text: str) -> None:
        with capture.global_and_fixture_disabled():
            print(f"\n  ... {text}", end="", file=sys.stderr, flush=True)

    def end(why: str, returncode: int, more: str = "") -> NoReturn:
        request.config.stash[WHY_KEY] = why
        raise Ended(f"{why}{more}", returncode)

    # An early end must not leave a hand driven: services are ended in order.
    with stop_on_signals() as stop:
        try:
            result = run_suite(options, report, stop.event)
        except KeyboardInterrupt:
            end(
                "the run was interrupted",
                130,
                "; nothing was judged, which is not a pass",
            )
        except DexkitError as error:
            if not stop:
                hint = f"\n{error.hint}" if error.hint else ""
                end(f"the kit cannot judge: {error.message}", 2, hint)
        except Exception:  # once, instead of once for each requirement
            text = "the kit itself has failed, which says nothing about the hand"
            end(text, 2, f"; please report this:\n{traceback.format_exc()}")
    if stop:
        why = f"the run was stopped ({signal.Signals(stop.signum).name})"
        end(why, 128 + stop.signum, "; nothing was judged, which is not a pass")
    request.config.stash[RESULT_KEY] = result
    return result
