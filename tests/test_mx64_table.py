"""Test the control table: no overlaps, the manual's gaps, consistent units."""

from __future__ import annotations

import math

import pytest

from dexkit.errors import EncodeError, TruncatedError
from dexkit.wire import mx64
from dexkit.wire.mx64 import Area


def test_items_do_not_overlap_and_gaps_match_manual() -> None:
    covered: set[int] = set()
    for item in mx64.TABLE.values():
        span = set(range(item.address, item.end))
        assert not covered & span, item.name
        covered |= span
    gaps = sorted(set(range(mx64.TABLE_END)) - covered)
    # docs/sources/mx64-ezgripper.md#b2; 20..23 and 24..27 are items, so the manual's 14-19 and
    # 28-30 remain
    expected = [
        *range(14, 20),
        *range(28, 31),
        *range(56, 63),
        *range(66, 68),
        *range(71, 76),
        *range(86, 88),
        *range(92, 98),
        99,
        *range(147, 168),
        *range(252, 578),
    ]
    assert gaps == expected


def test_items_are_in_eeprom_or_ram() -> None:
    assert mx64.SHUTDOWN.area is Area.EEPROM
    assert mx64.TORQUE_ENABLE.area is Area.RAM


def test_initial_values_are_within_range() -> None:
    for item in mx64.TABLE.values():
        if item.initial is None or item.minimum is None or item.maximum is None:
            continue
        assert item.minimum <= item.initial <= item.maximum, item.name


def test_items_encode_and_decode_signed_values() -> None:
    assert mx64.GOAL_POSITION.encode(-12000).hex() == "20d1ffff"
    assert mx64.GOAL_POSITION.decode(bytes.fromhex("20d1ffff")) == -12000
    block = bytes.fromhex("3b0000000000c20b0000")
    assert mx64.PRESENT_POSITION.decode(block, base=126) == 3010
    assert mx64.PRESENT_CURRENT.decode(block, base=126) == 59
    with pytest.raises(TruncatedError):
        mx64.PRESENT_POSITION.decode(block[:8], base=126)
    with pytest.raises(TruncatedError):
        mx64.GOAL_POSITION.decode(block, base=126)
    with pytest.raises(EncodeError):
        mx64.ID.encode(256)


def test_units_match_the_data_sheet() -> None:
    duty = mx64.PWM_MAX * mx64.PWM_UNIT
    assert duty == pytest.approx(1.0, abs=1e-3)
    assert mx64.CURRENT_LIMIT.maximum is not None
    assert mx64.CURRENT_LIMIT.maximum * mx64.CURRENT_UNIT == pytest.approx(6.52, abs=0.01)
    # 63 rpm without load at 12 V are 4301 ticks/s (docs/sources/mx64-ezgripper.md#b1)
    rad_s = 63 / mx64.VELOCITY_UNIT_RPM * mx64.VELOCITY_UNIT
    assert rad_s / mx64.TICK == pytest.approx(4301, abs=1)
    assert math.isclose(mx64.EZGRIPPER_STROKE * mx64.TICK, math.radians(219.7), rel_tol=1e-3)


def test_indirect_items_have_their_addresses() -> None:
    assert mx64.indirect_address(1).address == 168
    assert mx64.indirect_address(28).address == 222
    assert mx64.indirect_data(28).address == 251
    assert mx64.indirect_address(29).address == 578
    assert mx64.indirect_address(56).address == 632
    assert mx64.indirect_data(29).address == 634
    assert mx64.indirect_data(56).address == 661
    assert mx64.indirect_address(29).initial == 634
    for number in (0, 57):
        with pytest.raises(EncodeError):
            mx64.indirect_data(number)
