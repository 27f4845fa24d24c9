"""Simulated hands of position servos with one fault, as backends of ``dexkit serve``.

``serve tests.wrong_servos:ftp_swapped --side both``: the sides share a process, so that a hand can
report the other one's state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from dexkit.backends import Backend, BackendOptions
from dexkit.emulators.sim_brainco import SimBrainCo
from dexkit.emulators.sim_inspire import SimInspireDfx, SimInspireFtp
from dexkit.hand import Hand, HandCommand, HandState, Side


def reversed_scale(base: Any) -> Any:
    """The hand goes to the other end of its travel."""

    class Reversed(base):  # type: ignore[misc]
        def exchange(self, command: HandCommand) -> HandState:
            state: HandState = super().exchange(replace(command, q=1.0 - command.q))
            return state

    return Reversed


def swapped_states(base: Any) -> Any:
    """Each hand reports the state of the other one."""
    newest: dict[Side, HandState] = {}

    class Swapped(base):  # type: ignore[misc]
        def exchange(self, command: HandCommand) -> HandState:
            own: HandState = super().exchange(command)
            newest[self.spec.side] = own
            other = Side.LEFT if self.spec.side is Side.RIGHT else Side.RIGHT
            return replace(newest.get(other, own), stamp=own.stamp)

    return Swapped


def _backend(base: Any, wrong: Callable[[Any], Any]) -> Backend:
    hand = wrong(base)

    def make(options: BackendOptions) -> Hand:
        made: Hand = hand(options.side)
        return made

    return Backend(summary=f"wrong {base.model.title}", model=base.model.name, make=make)


brainco_reversed = _backend(SimBrainCo, reversed_scale)
dfx_swapped = _backend(SimInspireDfx, swapped_states)
ftp_swapped = _backend(SimInspireFtp, swapped_states)
