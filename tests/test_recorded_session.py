"""Which part of a recorded session is replayed at a hand."""

from __future__ import annotations

import numpy as np
import pytest

from dexkit.conformance.hands import BUILT_IN
from dexkit.conformance.stimuli import CommandSession
from dexkit.traces import sample_path

SAMPLE = sample_path("dex3_pinch")


@pytest.mark.parametrize("name", [each.model.name for each in BUILT_IN if each.session])
def test_the_session_of_a_model_moves_soon(name: str) -> None:
    """A session that begins at rest would use up the time of its replay."""
    session = CommandSession.default(name)
    moves = []
    for commands in session.commands.values():
        away = np.flatnonzero((np.abs(commands.q - commands.q[0]) > 0.02).any(axis=1))
        moves += [commands.t[away[0]]] if len(away) else []
    assert min(moves) <= 0.5


def test_a_session_of_ones_own_begins_with_its_first_command() -> None:
    whole, moving = CommandSession.load(SAMPLE), CommandSession.load(SAMPLE, motion=True)
    left_out = whole.duration - moving.duration
    assert left_out > 1.0
    for side, commands in moving.commands.items():
        every = whole.commands[side]
        rows = every.t >= left_out - 1e-6
        np.testing.assert_array_equal(commands.q, every.q[rows])
        np.testing.assert_allclose(commands.t, every.t[rows] - left_out, atol=1e-6)


def test_part_of_a_session_has_its_length() -> None:
    assert CommandSession.load(SAMPLE, seconds=3.0, motion=True).duration == pytest.approx(3.0)
