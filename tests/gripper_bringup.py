"""A bring-up of a gripper on virtual time, and a person who watches the fingers."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from dexkit.bringup import Bench, BringupSession, Drive, Effort, Findings, Question
from dexkit.clock import ManualClock

PERIOD = 0.02


class Watched:
    """A bench, the session on it, and what is seen.

    :param opening: of each motor's fingers, 0 closed to 1 open, by the motor's address.
    :param belongs: the name of the gripper that each motor moves.
    """

    def __init__(
        self,
        bench: Bench,
        clock: ManualClock,
        opening: Callable[[], Mapping[str, float]],
        belongs: Mapping[str, str],
        effort: Effort | None = None,
    ) -> None:
        self.bench, self.clock = bench, clock
        self._opening, self._belongs = opening, belongs
        bench.open()
        self.effort = effort or Effort.from_plan(bench.plan)
        self.begin(Findings())

    def begin(self, findings: Findings) -> None:
        """A session that goes on from ``findings``."""
        self.session = BringupSession(self.bench.plan, self.bench.motors, findings, self.effort)
        self.drive: Drive | None = None
        self.seen = [self._opening()]
        self.moved: set[str] = set()

    def cycle(self, held: bool = True) -> None:
        """One cycle of the loop."""
        self.clock.advance(PERIOD)
        snapshot = self.bench.exchange(self.drive)
        self.drive = self.session.step(self.clock.now(), snapshot, held)
        self.seen.append(self._opening())

    def until_question(self) -> Question | None:
        """Hold the key until something is asked; None when all is found."""
        while self.session.question is None and not self.session.done:
            self.cycle()
        return self.session.question

    def look(self, question: Question) -> str:
        """What a person who has watched the fingers answers."""
        seen = self.seen
        most = {m: max((s[m] - seen[0][m] for s in seen), key=abs) for m in seen[0]}
        motor = max(most, key=lambda m: abs(most[m]))
        others = [abs(value) for m, value in most.items() if m != motor]
        assert all(other < 0.02 for other in others), "one motor at a time"
        what = question.key.split()[-1]
        if what == self.bench.plan.part:
            return self._belongs[motor]
        self.seen = [seen[-1]]
        if what == "way":
            return "opened" if most[motor] > 0 else "closed"
        if what == "zero":
            asked = question.key.split()[-2]
            at = seen[-1].get(asked)
            if at is None:
                at = next(seen[-1][m] for m, name in self._belongs.items() if name == asked)
            return "yes" if abs(at) < 0.02 else "no"
        return "yes"

    def run(self) -> None:
        """Until all is found, with the person's answers."""
        while (question := self.until_question()) is not None:
            self.session.answer(self.look(question))
