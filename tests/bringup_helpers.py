"""An emulated Dex3-1 on virtual time, without USB, and a person who watches it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dexkit.bringup import BringupSession, Drive, Effort, Findings, Question, Snapshot
from dexkit.clock import ManualClock
from dexkit.drivers.dex3_usb.bringup import Dex3Bench
from dexkit.drivers.dex3_usb.settings import Dex3Settings
from dexkit.emulators.dex3_mcu import Dex3Mcu, Firmware
from dexkit.emulators.dex3_mcu.wiring import Wiring
from dexkit.errors import HandTimeout
from dexkit.hand import Side
from dexkit.models import DEX3_1

QUICK = Effort(speed=1.5)
PERIOD = 0.04


class Bring:
    """A bench on an emulated hand, and the session on it."""

    def __init__(
        self,
        tmp: Path,
        *,
        side: Side = Side.LEFT,
        wiring: Wiring | None = None,
        firmware: Firmware | None = None,
        effort: Effort = QUICK,
    ) -> None:
        self.clock = ManualClock()
        self.mcu = Dex3Mcu(side, clock=self.clock, wiring=wiring, firmware=firmware)
        self.driven: list[tuple[float, int]] = []
        self.mcu.on_drive = lambda t, joint, command: (
            self.driven.append((t, joint)) if command is not None else None
        )
        self.bench = Dex3Bench(side, Dex3Settings(config=tmp / "dex3.json"), self._wire)
        self.bench.open()
        self.effort = effort
        self.begin(Findings())

    def begin(self, findings: Findings) -> None:
        self.session = BringupSession(self.bench.plan, self.bench.motors, findings, self.effort)
        self.drive: Drive | None = None
        self.seen: list[np.ndarray] = [self.mcu.mechanics.q]  # type: ignore[type-arg]

    def _wire(self, frame: bytes) -> bytes:
        answer = self.mcu.exchange(frame)
        if answer is None:
            raise HandTimeout("no answer")
        return answer

    def cycle(self, held: bool = True) -> Snapshot:
        """One cycle of the loop."""
        self.clock.advance(PERIOD)
        snapshot = self.bench.exchange(self.drive)
        self.drive = self.session.step(self.clock.now(), snapshot, held)
        self.seen.append(self.mcu.mechanics.q)
        return snapshot

    def cycles(self, count: int) -> None:
        """Several with the key held."""
        for _ in range(count):
            self.cycle()

    def until_question(self) -> Question | None:
        """Hold the key until something is asked; None when all is found."""
        while self.session.question is None and not self.session.done:
            self.cycle()
            if not self.session.moves:
                self.touch()
        return self.session.question

    def touch(self) -> None:
        """Press what the session asks for."""
        for i, sensor in enumerate(DEX3_1.sensors):
            pressed = self.session.doing == f"press and hold the {sensor.place} now"
            self.mcu.mechanics.press(i, 10.0 if pressed else 0.0)

    def look(self, question: Question) -> str:
        """What a person who has watched the hand answers."""
        seen, self.seen = np.array(self.seen), [self.mcu.mechanics.q]
        away = seen - seen[0]
        joint = int(np.argmax(np.abs(away).max(axis=0)))
        spec = DEX3_1.joints[self.mcu.side][joint]
        *_, what = question.key.split()
        if what == "joint":
            self.seen = list(seen)
            return str(spec.name)
        if what == "way":
            moved = away[np.argmax(np.abs(away[:, joint])), joint]
            if not spec.closing:
                return "to-middle" if moved > 0 else "to-index"
            return "closed" if moved * spec.closing > 0 else "opened"
        if what == "zero":
            name = question.key.split()[0]
            index = [s.name for s in DEX3_1.joints[self.mcu.side]].index(name)
            return "yes" if abs(self.mcu.mechanics.q[index]) < 0.06 else "no"
        return "yes"

    def run(self) -> None:
        """Until all is found, with the person's answers."""
        while (question := self.until_question()) is not None:
            self.session.answer(self.look(question))
