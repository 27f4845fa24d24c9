"""What clients suffer from wrong hands: the kinds, their limits, the sessions and the table."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import pytest

from dexkit.conformance.faults import mutants
from dexkit.conformance.kit.requirements import Level
from dexkit.conformance.layers import layer
from dexkit.conformance.virtual import Service
from dexkit.hand import Side
from dexkit.models import DEX1_1, model
from tools.consequences.kinds import KINDS, Consequence, consequences
from tools.consequences.sessions import example, grasp
from tools.consequences.stage import Figure
from tools.consequences.table import FILE, Table, told
from tools.consequences.work import known, tasks

NAN_HAND = "dds dex1-1 NanIsZero (DEX1-SAFE-01)"


def figure(kind: str, joint: int = 0) -> Figure:
    return Figure(kind, "xr_teleoperate", "a task", "left", joint)


@pytest.mark.parametrize(
    ("kind", "good", "harmless", "harmful"),
    [
        ("starts", 0.1, 4.9, math.inf),
        ("ends", 0.5, 0.54, 0.44),
        ("lags", 0.5, 1.0, 1.2),
        ("misses", 0.9, 0.5, 0.4),
        ("presses", 0.8, 1.9, 2.1),
        ("presses", 0.8, 0.4, 0.3),
        ("drops", 0.8, 0.4, 0.3),
        ("lets go", 1.0, 0.5, 0.2),
        ("moves", 0.01, 0.05, 0.07),
        ("reads", 0.0, 0.04, math.inf),
        ("touch", 2.0, 2.4, 1.4),
        ("left moving", 0.0, 0.04, 0.06),
        ("left pressing", 0.1, 0.3, 0.5),
    ],
)
def test_each_kind_has_its_limit(kind: str, good: float, harmless: float, harmful: float) -> None:
    assert not consequences({figure(kind): harmless}, {figure(kind): good})
    (found,) = consequences({figure(kind): harmful}, {figure(kind): good}).values()
    assert (found.kind, found.good) == (kind, good)
    assert found.size > 1.0
    assert told(found, "dex1-1")


def test_the_worst_joint_counts() -> None:
    good = {figure("ends", joint): 0.5 for joint in range(3)}
    found = consequences({figure("ends", j): 0.5 + 0.1 * j for j in range(3)}, good)
    assert found["ends"].joint == 2


def test_nothing_is_said_of_what_the_reference_does_not_do() -> None:
    late = figure("lags")
    assert not consequences({late: math.inf}, {late: math.inf})
    assert not consequences({late: math.nan}, {late: 0.5})
    assert not consequences({}, {late: 0.5})


def test_every_limit_has_a_reason() -> None:
    assert all(kind.reason.endswith(".") for kind in KINDS.values())


# ---------------------------------------------------------------------------------- sessions


@functools.cache
def reference(name: str) -> dict[Figure, float]:
    return grasp(layer("dds").reference(name), model(name).dialects[0], (Side.LEFT,)).figures


@pytest.mark.parametrize("name", ["dex1-1", "dex3-1", "inspire-ftp"])
def test_a_client_grasps_with_the_reference(name: str) -> None:
    figures = reference(name)
    # a position servo holds an object when its client has gone, and a Dex3-1 without its protection
    least, most = (0.0, 0.3) if name == "dex1-1" else (0.9, 1.1)
    held = figures[Figure("drops", "xr_teleoperate", "lift", "left", 0)]
    left = figures[Figure("lets go", "xr_teleoperate", "stopped in a grip", "left", 0)]
    assert held > 0.3
    assert least <= left <= most


def test_a_client_of_position_servos_sends_no_nan_in_integers_and_has_no_gains() -> None:
    tasks = {f.task for f in reference("inspire-ftp")}
    assert not {task for task in tasks if "NaN" in task or "gains" in task}


def test_other_models_have_no_example() -> None:
    spoken = model("inspire-dfx").dialects[0]
    assert not example(layer("dds").reference("inspire-dfx"), spoken, tuple(Side)).figures


def test_forces_are_told_in_units_of_the_model() -> None:
    found = Consequence(*figure("presses"), 0.0, 1.0, 9.0)
    assert "0 N m instead of 1 N m" in told(found, "dex1-1")
    assert "0 A instead of 1 A" in told(found, "brainco-revo2")


def of(made: type[Service]) -> dict[str, Consequence]:
    spoken = DEX1_1.dialects[0]
    return consequences(grasp(made, spoken, (Side.LEFT,)).figures, reference("dex1-1"))


def made(name: str) -> type[Service]:
    (found,) = (m.made for m in mutants("dds") if m.model == "dex1-1" and m.name == name)
    return found


def test_the_reference_has_no_consequence() -> None:
    assert not of(layer("dds").reference("dex1-1"))


def test_obvious_faults_have() -> None:
    assert "starts" in of(made("OldTopic"))
    assert {"ends", "drops"} <= set(of(made("Inverted")))
    assert "left pressing" in of(made("FedByRejected"))
    assert "reads" in of(made("Percent"))


def test_a_fault_that_no_client_sees_has_none() -> None:
    assert not of(made("NoForce"))


# ------------------------------------------------------------------------------------- table


def test_the_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = consequences({figure("ends"): 0.9}, {figure("ends"): 0.5})
    table = Table({NAN_HAND: found, "dds dex1-1 HotByte (DEX1-FIELD-08)": {}}, "a1b2c3")
    table.save(tmp_path / "table.json")
    assert Table.load(tmp_path / "table.json") == table


def test_levels_follow_from_it() -> None:
    found = consequences({figure("ends"): 0.9}, {figure("ends"): 0.5})
    by_id = {row.requirement.id: row for row in Table({NAN_HAND: found}).rows("dex1-1")}
    assert by_id["DEX1-SAFE-01"].proposed is Level.MUST
    assert by_id["DEX1-SAFE-01"].own is not None
    by_id = {row.requirement.id: row for row in Table({NAN_HAND: {}}).rows("dex1-1")}
    assert by_id["DEX1-SAFE-01"].missing, "others of its hands are not measured"
    assert by_id["DEX1-SAFE-01"].proposed is Level.MUST
    every = Table({m.pin: {} for m in mutants("dds")})
    assert {row.proposed for row in every.rows("dex1-1")} <= {Level.SHOULD, Level.INFO}


def test_the_committed_table_is_of_hands_that_there_are() -> None:
    unknown = set(Table.load(FILE).hands) - {m.pin for m in mutants("dds")}
    assert not unknown, "make consequences writes the table anew"


def test_what_is_not_kept_is_measured(tmp_path: Path) -> None:
    given = tasks(tmp_path, ("dds dex1-1 HotByte",))
    assert [task.mutant is None for task in given] == [True, False]
    assert all(known(task) is None for task in given)
