"""One bug, one story: what a run shows first, and what follows from it.

One bug often fails many requirements. After all of them are judged, the failures are put together:

* A fault that the states show by themselves (:mod:`~.state_faults`: all-zero states, a frozen
  joint) is taken out of the recording, and what failed is judged again. What is met then follows
  from it.
* A habit of all motion (:mod:`~.habits`: each step begins late, a joint never moves) comes
  before what requirements show of single situations.
* Of the other failures, the one whose check looks most closely comes first (:data:`ORDER`). What is
  seen at the same time and joint, or is only a sum of everything, is listed under it.
* What only warns comes after what fails.

No verdict changes: a failure stays one, whatever it follows from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from dexkit.conformance.checks import check_of
from dexkit.conformance.kit.habits import Habit, habits, silences
from dexkit.conformance.kit.recording import Recording, SideView
from dexkit.conformance.kit.requirements import Level
from dexkit.conformance.kit.results import Evidence, Result, Story, Verdict
from dexkit.conformance.kit.state_faults import Fault, faults

__all__ = ["FAMILIES", "ORDER", "stories_of"]

ORDER = (
    *("discovery", "start_up", "fields.complete", "checksums", "order.order"),
    *("freshness.fresh", "rate.rate"),
    *("sides.independent", "sides.by_its_own", "motion.order"),
    *("motion.begins", "motion.every_command", "motion.arrives"),
    *("sides.beside_grip", "gains"),
    *("grip.keeps_grip", "stillness.vibrates", "motion.settles", "motion.ends"),
    *("mode_byte.locked", "timeout_protection", "bad_commands.unchanged"),
    *("speed", "motion.speed", "sides", "watchdog.state_in_silence"),
    *("stillness.still", "two_clients", "order.old_stamps"),
    *("life_cycle.restarted_client", "life_cycle.restarted_service", "watchdog.resumes"),
    *("mode_byte", "bad_commands", "watchdog", "life_cycle", "rate"),
    *("grip.stops_at_object", "position.not_the_command"),
    *("freshness", "velocity.keeps_up", "position", "velocity", "stillness"),
    *("force.unit", "force.gripper_unit"),
    *("grip.keeps_gripping", "grip.lasts", "force", "grip", "touch", "pressure", "attitude"),
    *("motion", "load", "motion.path", "tracking", "operator", "fields", "robot_state"),
)
"""Checks, by behaviour or singly, from that which looks most closely at one thing. Others last."""
_SUMS = ("motion.path", "stillness.still", "tracking", "operator", "bad_commands.unchanged", "load")
"""Checks that many faults fail, whichever is first."""
_ALL_VALUES = ("freshness.fresh", "rate.rate")
"""Checks of faults that spoil every later value of a position; so does a q whose unit or sign is
another one."""
_VALUES = ("position", "velocity", "freshness")
"""Behaviours of measured values, which no command has a part in."""
_CONTACT = ("force", "grip", "touch", "pressure")
FAMILIES = {
    **dict.fromkeys(_CONTACT, "contact"),
    **dict.fromkeys(("watchdog", "timeout_protection"), "silence"),
    "bad_commands.driven_away": "gains",
}
"""Behaviours and checks of one thing, beside those of one behaviour."""
_ANY_STEP = ("motion", "stillness.still", "bad_commands.unchanged", "speed")
"""Checks of motion as it always is, by any step ..."""
_SPECIAL_STEP = (
    *("bad_commands", "life_cycle", "watchdog", "two_clients", "order", "sides"),
    *("mode_byte.own_mode", "gains.soft_commands", "gains.soft_steps"),
)
"""... and of steps in special circumstances, which cannot go better than any other."""
_PROVOCATIONS = (
    *("nan", "empty", "short", "long", "negative", "out-of-range", "foreign", "rejected", "burst"),
    *("silence", "restart", "service-restart", "two-writers", "load"),
)
"""Phases of which a story says that something is seen only right after them."""
_OF_MOTION = (
    *("motion", "mode_byte", "speed", "sides", "gains", "load", "stillness", "tracking"),
    *("operator", "bad_commands", "life_cycle", "watchdog", "two_clients", "order.old_stamps"),
    *("grip", "force", "position.in_stroke", "position.not_the_command"),
)
"""Checks that a habit of motion may fail ..."""
_START = ("discovery", "start_up", "fields", "checksums")
_BEFORE_MOTION = (
    *(*_START, "order.order", "freshness.fresh", "rate.rate"),
    *("motion.order", "motion.begins", "sides.independent", "sides.by_its_own"),
)
"""... and those that look more closely than a habit, where it does not explain them."""
_SILENT_S = 5.0
"""Seconds after the last step with a habit in which a failure is of it: none may be tried."""
_NEAR_S = 0.3
"""Seconds by which places in the recording may be apart that show the same."""
_OFTEN = ("state", "motion", "phase:step", "phase:joint", "phase:fingerprint")
"""Needs of requirements that are judged all over a run, or again and again: others have a phase
after which they are judged in any case."""
_SOON_S = 0.5
"""Seconds after a phase in which something is seen right after it."""
_PLACES = 5
"""Places that a story names."""

Again = Callable[[Recording, Collection[str]], Sequence[Result]]
"""Judges a recording by the requirements of these ids."""


def stories_of(recording: Recording, results: Iterable[Result], again: Again) -> list[Story]:
    """The stories of a run, the likeliest first; none where nothing failed.

    :param results: of all requirements about the hands.
    """
    results = list(results)
    failed = sorted((r for r in results if r.verdict in (Verdict.FAIL, Verdict.WARN)), key=_rank)
    silent = _of_habits(recording, failed, silences)
    explained = {name for story in silent for name in story.explains}
    failed = [r for r in failed if r.id not in explained]
    shown = _of_states(recording, failed, again) if failed else []
    if failed and _spoils_all(failed[0]):
        # what spoils all values is what a part of them shows, too
        shown = [story for story in shown if failed[0].id in story.explains]
    explained = {name for story in shown for name in story.explains}
    left = [r for r in failed if r.id not in explained]
    moved = _of_habits(recording, left, habits)
    explained = {name for story in moved for name in story.explains}
    found = _of_findings(recording, [r for r in left if r.id not in explained])
    early = {r.id for r in left if _among(_check(r), _BEFORE_MOTION)}
    first = [story for story in found[:1] if story.shown_by in early]
    found = [*first, *moved, *found[len(first) :]]
    fails = {r.id for r in results if r.verdict is Verdict.FAIL}
    weight = {r.id: 2 if r.requirement.level is Level.MUST else 1 for r in failed}
    most = max((_weight(story, weight) for story in found), default=0)
    before = [story for story in shown if _weight(story, weight) >= most]
    stories = [*silent, *before, *found, *(story for story in shown if story not in before)]
    return sorted(stories, key=lambda story: fails.isdisjoint(story.explains))


def _weight(story: Story, weights: Mapping[str, int]) -> int:
    return sum(weights[name] for name in story.explains)


# --------------------------------------------------------------------------- faults of states


def _of_states(recording: Recording, failed: Sequence[Result], again: Again) -> list[Story]:
    """Stories of faults that the states show by themselves."""
    kinds: dict[str, list[tuple[SideView, Fault, set[str]]]] = {}
    for subject, view in recording.sides.items():
        mine = {r.id for r in failed if r.side == str(subject)}
        for fault, names in _without_faults(recording, view, mine, again):
            there = {r.id for r in failed if r.side == str(subject) and _lies_in(r, fault)}
            kinds.setdefault(fault.kind, []).append((view, fault, names | there))
    stories = []
    for found in kinds.values():
        met = {(name, str(view.side)) for view, _, some in found for name in some}
        left = {r.id for r in failed if (r.id, str(r.side)) not in met}
        explained = tuple(dict.fromkeys(r.id for r in failed if r.id not in left))
        if explained:
            view, fault, _ = max(found, key=lambda f: (len(f[2]), len(f[1].spans)))
            places = tuple(
                Evidence(view.states.topic, round(a, 4), recording.log_time(a), round(b, 4))
                for a, b in fault.spans[:_PLACES]
            )
            sides = tuple(str(view.side) for view, _, _ in found)
            stories.append(Story(fault.sentence, sides, "", explained, places))
    return stories


def _lies_in(result: Result, fault: Fault) -> bool:
    """Whether a finding about measured values is where the fault is."""
    places = [(e.time_s, _end(e)) for e in result.evidence]
    return _check(result)[0] in _VALUES and any(
        begin <= b and a <= end for a, b in fault.spans for begin, end in places
    )


def _without_faults(
    recording: Recording, view: SideView, failed: set[str], again: Again
) -> Iterator[tuple[Fault, set[str]]]:
    """The faults of one hand, and what is met without each: first that without which most is."""
    while failed:
        tried = []
        for fault in faults(recording, view):
            without = replace(view, states=fault.states, known={})
            sides = {**recording.sides, view.side: without}
            judged = again(replace(recording, sides=sides, judged=(view.side,)), failed)
            met = {r.id for r in judged if r.verdict is Verdict.PASS} & failed
            tried.append((fault, met))
        if not any(met for _, met in tried):
            return
        fault, met = max(tried, key=lambda t: len(t[1]))
        yield fault, met
        # other faults are looked for in what is left without it
        view, failed = replace(view, states=fault.states, known={}), failed - met


# ------------------------------------------------------------------------------------- habits


def _of_habits(
    recording: Recording,
    failed: Sequence[Result],
    find: Callable[[Recording, SideView], Iterable[Habit]],
) -> list[Story]:
    """Stories of what goes wrong all over a run, that of most places first."""
    kinds: dict[str, list[tuple[SideView, Habit]]] = {}
    for view in recording.sides.values():
        if any(r.side == str(view.side) for r in failed):
            for habit in find(recording, view):
                kinds.setdefault(habit.kind, []).append((view, habit))
    stories = []
    for found in sorted(kinds.values(), key=lambda f: -sum(len(h.spans) for _, h in f)):
        left = {r.id for r in failed if not any(_is_of(r, view, h) for view, h in found)}
        explained = tuple(dict.fromkeys(r.id for r in failed if r.id not in left))
        failed = [r for r in failed if r.id in left]
        if explained:
            view, habit = max(found, key=lambda f: len(f[1].spans))
            places = tuple(
                Evidence(view.states.topic, round(a, 4), recording.log_time(a), round(b, 4))
                for a, b in habit.spans[:_PLACES]
            )
            sides = tuple(dict.fromkeys(str(view.side) for view, _ in found))
            stories.append(Story(habit.sentence, sides, "", explained, places))
    return stories


def _is_of(result: Result, view: SideView, habit: Habit) -> bool:
    """Whether a failure is one of a motion with this habit."""
    if habit.kind == "silent":
        return result.side == str(view.side) and not _among(_check(result), _START)
    begin, end = habit.during
    joints = set(result.joints)
    check = _check(result)
    if habit.kind == "fades" and check[0] in ("speed", "gains", "sides"):
        return False
    if habit.kind == "stream" and not _among(check, _SUMS):  # single steps show more
        return False
    if check[1] == "position.in_stroke" and habit.kind != "past":
        return False
    if check[1] == "sides.independent" and (habit.kind not in ("slow", "late") or begin > 0.0):
        return False
    return (
        result.side == str(view.side)
        and _among(check, _OF_MOTION)
        and (not joints or bool(joints & set(habit.joints)))
        # another joint that moves is more than one that does not
        and (check[1] != "motion.order" or joints <= set(habit.joints))
        and any(begin - _NEAR_S <= _end(e) and e.time_s <= end + _SILENT_S for e in result.evidence)
    )


# ------------------------------------------------------------------------------ other findings


def _of_findings(recording: Recording, failed: Sequence[Result]) -> list[Story]:
    """Stories of what the checks found, in the order of :data:`ORDER`."""
    groups: dict[str, list[Result]] = {}
    for result in sorted(failed, key=_rank):
        groups.setdefault(result.id, []).append(result)
    stories = []
    while groups:
        root = groups.pop(next(iter(groups)))
        under = [name for name, group in groups.items() if _follows(group, root)]
        for name in under:
            del groups[name]
        shown = root[0]
        stories.append(
            Story(
                _sentence(shown) + _after(recording, root),
                tuple(r.side for r in root),
                shown.id,
                (shown.id, *under),
                shown.evidence,
            )
        )
    return stories


def _sentence(result: Result) -> str:
    seen = result.observed or result.requirement.title
    return f"{seen}. {result.cause.rstrip('.')}" if result.cause else seen


def _after(recording: Recording, root: Sequence[Result]) -> str:
    """After which provocation all of it is seen, where it is not seen otherwise."""
    places = [e.time_s for r in root for e in r.evidence]
    waits = {}
    for name in _PROVOCATIONS:
        ends = [recording.seconds(p.end_ns) for p in recording.phases(name)]
        # how long after the last such phase each place is, at most
        since = [min((at - end for end in ends if end <= at), default=math.inf) for at in places]
        waits[name] = max(since, default=math.inf)
    name = min(waits, key=lambda name: waits[name])
    if waits[name] > _SOON_S or root[0].requirement.needs not in _OFTEN:
        return ""
    return f", right after the phase '{name}'"


def _check(result: Result) -> tuple[str, str]:
    """The behaviour that the check of a result belongs to, and the check's full name: of what only
    warns by a part of a MUST the behaviour alone.
    """
    check = check_of(result.requirement)
    behaviour = check.__module__.rpartition(".")[2]
    lesser = result.tolerated and result.requirement.level is Level.MUST
    return behaviour, behaviour if lesser else f"{behaviour}.{check.__name__}"


def _rank(result: Result) -> tuple[int, bool]:
    behaviour, name = _check(result)
    names = ("rate.rate",) if _spoils_all(result) else (name, behaviour)
    at = next((ORDER.index(n) for n in names if n in ORDER), len(ORDER))
    return at, result.verdict is not Verdict.FAIL


def _spoils_all(result: Result) -> bool:
    """Whether it is of a fault that spoils every later value of a position."""
    check = _check(result)
    return _among(check, _ALL_VALUES) or (check[1] == "position.in_stroke" and bool(result.cause))


def _follows(group: Sequence[Result], root: Sequence[Result]) -> bool:
    """Whether what a requirement shows is what another one shows more closely."""
    it, of = _check(group[0]), _check(root[0])
    general = (
        _family(it) == _family(of)
        or _among(it, _SUMS)
        or (_among(of, _ANY_STEP) and _among(it, _SPECIAL_STEP))
        or (_spoils_all(root[0]) and it[0] not in _CONTACT)
    )
    return any(a.side == b.side and (general or _at_once(a, b)) for a in group for b in root)


def _among(check: tuple[str, str], names: Sequence[str]) -> bool:
    return check[0] in names or check[1] in names


def _family(check: tuple[str, str]) -> str:
    behaviour, name = check
    return FAMILIES.get(name) or FAMILIES.get(behaviour) or behaviour


def _at_once(one: Result, other: Result) -> bool:
    return any(
        a.time_s - _NEAR_S <= _end(b) and b.time_s - _NEAR_S <= _end(a)
        for a in one.evidence
        for b in other.evidence
    )


def _end(place: Evidence) -> float:
    return place.time_s if place.end_s is None else place.end_s
