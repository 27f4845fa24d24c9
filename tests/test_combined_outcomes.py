"""Parts of a requirement put together."""

from __future__ import annotations

from dexkit.conformance.checks import Outcome
from dexkit.conformance.checks.combined import all_of, warning
from dexkit.conformance.kit.results import Evidence

GOOD = Outcome(True, figure="0.68 s", observed="full stroke 0.68 s", values={"stroke_s": 0.68})
LATE = Outcome(
    False, figure="0.5 s", observed="lags 500 ms", values={"lag_s": 0.5}, cause="A filter."
)
OFF = Outcome(False, figure="0.1 rad", observed="rests 0.1 rad off", joints=(1,), retry=True)
UNKNOWN = Outcome(None, reason="no step was long enough")


def test_met_where_each_part_is_and_shows_all_figures() -> None:
    both = all_of(GOOD, UNKNOWN, Outcome(True, figure="20 ms", values={"lag_s": 0.02}))
    assert both.met
    assert both.figure == "0.68 s; 20 ms"
    assert both.values == {"stroke_s": 0.68, "lag_s": 0.02}


def test_what_fails_comes_before_what_warns() -> None:
    found = all_of(GOOD, warning(LATE), OFF)
    assert (found.met, found.tolerable) == (False, False)
    assert (found.figure, found.observed) == ("0.1 rad", "rests 0.1 rad off")
    assert (found.joints, found.retry, found.cause) == ((1,), True, "")


def test_warns_where_only_tolerated_parts_are_not_met() -> None:
    found = all_of(GOOD, warning(LATE))
    assert (found.met, found.tolerable, found.cause) == (False, True, "A filter.")


def test_failures_are_told_together_and_the_first_leads() -> None:
    place = Evidence("rt/dex1/left/state", 1.0, 2.0)
    found = all_of(LATE.if_late(0.3), Outcome(False, observed="gone", evidence=(place,)))
    assert (found.figure, found.observed) == ("0.5 s", "lags 500 ms; gone")
    assert found.evidence == (place,)
    assert found.late is None


def test_a_part_that_fails_for_certain_is_not_excused_by_another_that_may_not() -> None:
    near = Outcome(False, observed="0.401 s").timed(0.401, 0.4)
    assert all_of(near, Outcome(False, observed="gone")).measures == ()
    assert all_of(near, near).measures == near.measures * 2


def test_no_part_that_can_be_judged_says_why() -> None:
    assert all_of(UNKNOWN, Outcome(None, reason="no motion")) is UNKNOWN
    assert warning(UNKNOWN) is UNKNOWN


def test_what_nothing_fills_is_absent_though_other_parts_are_met() -> None:
    assert all_of(GOOD, Outcome(None, reason="no packets", absent=True)).absent
