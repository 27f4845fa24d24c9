"""Run the script of a bring-up on the caller's clock; sans-IO.

The caller sends the commands that :meth:`BringupSession.step` returns, answers
:attr:`BringupSession.question` when there is one, and calls it again. At most one motor is driven,
and only in a step with the dead-man key held.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from dexkit.bringup.bench import Drive, Plan, Snapshot
from dexkit.bringup.findings import Findings
from dexkit.bringup.motion import Effort, End, Go, Mover, check_motors
from dexkit.bringup.script import AGAIN, Action, Locate, PressRequest, Question, script
from dexkit.errors import HandFault, UsageError

__all__ = ["SKIP", "BringupSession"]

SKIP = "skip"
_PRESSED = 3000.0
"""Pa more than before: some 30 g on a square centimetre."""
_PRESS_TIME = 0.3
_PRESS_PATIENCE = 20.0
"""Seconds to wait for a touch; then it is asked for again."""


class BringupSession:
    """One bring-up.

    :param motors: addresses of the motors that answer.
    :param findings: of an earlier session; filled further.

    :ivar question: what to ask now, or None.
    :ivar doing: what the present motion or touch is, for the person; empty while there is none.
    :ivar moves: whether the present action needs the dead-man key.
    :ivar done: everything is found.
    """

    def __init__(
        self, plan: Plan, motors: Sequence[str], findings: Findings, effort: Effort | None = None
    ) -> None:
        self.findings = findings
        self.question: Question | None = None
        self.doing = ""
        self.moves = False
        self.done = False
        self._effort = effort or Effort.from_plan(plan)
        self._fault: HandFault | None = None
        self._widest = plan.widest
        self._script = script(plan, motors, findings)
        self._mover: Mover | None = None
        self._touch: _TouchWatch | None = None
        self._locate: str | None = None
        self._advance(None)

    def _advance(self, result: object) -> None:
        self.question, self.doing, self.moves = None, "", False
        self._mover = self._touch = self._locate = None
        try:
            action: Action = self._script.send(result)
        except StopIteration:
            self.done = True
            return
        if isinstance(action, Go):
            self._mover = Mover(action, self._effort, self._widest)
            self.doing, self.moves = action.why, True
        elif isinstance(action, Locate):
            self._locate = action.motor
        elif isinstance(action, PressRequest):
            self._touch = _TouchWatch(action)
            self.question = Question(
                action.key,
                f"When dexkit asks for it, press the {action.place}. Ready?",
                ("yes", SKIP),
            )
        else:
            self.question = action

    def answer(self, text: str) -> None:
        """Answer the question.

        :raises UsageError: it is not one of its choices.
        :raises HandFault: it follows from the answer that the bring-up must not go on.
        """
        question = self.question
        if question is None or text not in question.choices:
            known = ", ".join(question.choices) if question else "there is no question"
            raise UsageError(f"{text!r} is not a valid answer", hint=known)
        if text != AGAIN:
            self.findings.answers[question.key] = text
        try:
            self._take(text)
        except HandFault as fault:
            self._fault = fault
            raise

    def _take(self, text: str) -> None:
        if self._touch is None:
            self._advance(text)
        elif text == SKIP:
            self._advance(None)
        else:
            self.question = None
            self.doing = f"press and hold the {self._touch.action.place} now"

    def step(self, now: float, snapshot: Snapshot, held: bool) -> Drive | None:
        """Return the next command to one motor, or None to lock every motor.

        :param now: monotonic seconds, of the snapshot.
        :param held: the dead-man key.
        :raises HandFault: the bring-up must not go on; every motor has to be locked. Raised again
            by every later call.
        """
        if self._fault is not None:
            raise self._fault
        try:
            return self._step(now, snapshot, held)
        except HandFault as fault:
            self._fault = fault
            raise

    def _step(self, now: float, snapshot: Snapshot, held: bool) -> Drive | None:
        if self.question is not None or self.done:
            return None
        if self._locate is not None:
            check_motors(snapshot)
            if self._locate in snapshot.motors:
                self._advance(snapshot.motors[self._locate].q)
            return None
        if self._touch is not None:
            self._watch(now, snapshot)
            return None
        assert self._mover is not None
        command = self._mover.step(now, snapshot, held)
        if isinstance(command, End):
            self._advance((command, self._mover.q))
            return None
        return command

    def _watch(self, now: float, snapshot: Snapshot) -> None:
        assert self._touch is not None
        found = self._touch.step(now, snapshot)
        if found:
            self._advance(found)
        elif self._touch.over(now):
            action = self._touch.action
            self._touch, self.doing = _TouchWatch(action), ""
            self.question = Question(
                action.key, f"Nothing felt the {action.place}. Once more?", ("yes", SKIP)
            )


class _TouchWatch:
    """Finds the one sensor whose pressure changes and stays so."""

    def __init__(self, action: PressRequest) -> None:
        self.action = action
        self._rest: dict[str, tuple[float, ...]] = {}
        self._begin = math.nan
        self._since: tuple[str, float] | None = None

    def over(self, now: float) -> bool:
        """Whether it has waited long enough."""
        return now - self._begin > _PRESS_PATIENCE

    def step(self, now: float, snapshot: Snapshot) -> str | None:
        """The address of the sensor that is pressed, once that is sure."""
        if math.isnan(self._begin):
            self._begin = now
        changed = []
        for address, pressure in snapshot.pressure.items():
            rest = self._rest.setdefault(address, pressure)
            # either sign: docs/sources/real-hands.md#touch-sign
            change = max((abs(a - b) for a, b in zip(pressure, rest, strict=True)), default=0.0)
            if address not in self.action.known and change > _PRESSED:
                changed.append((change, address))
        changed.sort(reverse=True)
        clear = len(changed) == 1 or (len(changed) > 1 and changed[0][0] > 2 * changed[1][0])
        if not clear:
            self._since = None
            return None
        address = changed[0][1]
        if self._since is None or self._since[0] != address:
            self._since = (address, now)
        return address if now - self._since[1] >= _PRESS_TIME else None
