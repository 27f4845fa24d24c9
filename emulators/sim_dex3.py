"""``sim-dex3``: a simulated Dex3-1, mechanics only, without a device protocol.

:mod:`dexkit.emulators.dex3_mechanics` says what is modelled, tuned and left out.
"""

from __future__ import annotations

from dataclasses import replace

from dexkit.backends import Backend, BackendOptions
from dexkit.clock import Clock
from dexkit.emulators.dex3_mechanics import Dex3Mechanics
from dexkit.emulators.finger_mechanics import SETTINGS, STEP
from dexkit.emulators.simulated_hand import COMMON_SETTINGS, SimulatedHand, configured, number
from dexkit.errors import UsageError
from dexkit.hand import ModeRule, Side
from dexkit.models import DEX3_1

__all__ = ["SimDex3", "sim_dex3"]


class SimDex3(SimulatedHand):
    """A simulated Dex3-1.

    :param side: which hand.
    :param object_at: how far the fingers close until they touch an object, percent; None for no
        object.
    :param start: how far they are closed at ``open``, percent; None for a relaxed pose, which
        is not all zero, because clients wait for a position that is not.
    :param supply_v: voltage of the supply, V.
    :param mode_rule: which mode bytes drive a motor: that of the manual, or of another firmware
        (docs/dex3.md#firmware).
    :param clock: real time unless given; with a manual clock the hand is deterministic.
    :raises UsageError: a parameter is out of range.
    """

    def __init__(
        self,
        side: Side = Side.LEFT,
        *,
        object_at: float | None = None,
        start: float | None = None,
        supply_v: float = 24.0,
        mode_rule: ModeRule = ModeRule.MANUAL,
        clock: Clock | None = None,
    ) -> None:
        self.mechanics = Dex3Mechanics(side, object_at=object_at, start=start, supply_v=supply_v)
        spec = DEX3_1.spec(side, io_rate=DEX3_1.state_rate, simulated=True)
        spec = replace(spec, mode_rule=mode_rule)
        super().__init__(spec, self.mechanics, STEP, clock)


def _make(options: BackendOptions) -> SimDex3:
    supply = number(options, "supply")
    hand = SimDex3(
        options.side,
        object_at=number(options, "object"),
        start=number(options, "start"),
        supply_v=24.0 if supply is None else supply,
        mode_rule=_mode_rule(options.settings.get("mode_byte", ModeRule.MANUAL.value)),
    )
    return configured(hand, options)


def _mode_rule(text: str) -> ModeRule:
    try:
        return ModeRule(text)
    except ValueError:
        known = ", ".join(rule.value for rule in ModeRule)
        raise UsageError(f"no mode_byte {text!r}", hint=f"known: {known}") from None


sim_dex3 = Backend(
    summary="Simulated Dex3-1 hand: motors, touch and heat, no device",
    model=DEX3_1.name,
    make=_make,
    settings={
        **SETTINGS,
        **COMMON_SETTINGS,
        "mode_byte": "which mode bytes drive a motor: manual (status 1), nonzero (any but 0, as "
        "some clients of real hands need) or ignored (the gains decide) (default: manual)",
        "supply": "volts of the supply, 24 to 58 (default: 24)",
    },
)
