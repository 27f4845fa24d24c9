"""Forward kinematics, the skeletons of the models, and URDFs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dexkit.errors import UsageError
from dexkit.hand import Floats, Side
from dexkit.kinematics import BASE, Box, Segment, Skeleton, quaternions, rotation
from dexkit.models import DEX1_1, DEX3_1, DEX5_1, MODELS
from dexkit.robots import ROBOTS
from dexkit.urdf import read_urdf
from dexkit.view.skeletons import schematic, skeleton_of

FEW = settings(max_examples=25, deadline=None)
angles = st.floats(-3.1, 3.1)


def tip(skeleton: Skeleton, q: list[float] | tuple[float, ...], name: str) -> Floats:
    """The origin of a link."""
    at = [s.name for s in skeleton.segments].index(name)
    return np.asarray(skeleton.poses(q)[at, :3, 3])


@FEW
@given(rpy=st.tuples(angles, angles, angles))
def test_quaternions_are_the_rotations(rpy: tuple[float, float, float]) -> None:
    turn = rotation(rpy)
    w, x, y, z = quaternions(turn[None])[0]
    assert math.hypot(w, x, y, z) == pytest.approx(1.0)
    for vector in np.eye(3):
        u = np.array([x, y, z])
        turned = vector + 2 * np.cross(u, np.cross(u, vector) + w * vector)
        np.testing.assert_allclose(turned, turn @ vector, atol=1e-9)


def test_skeletons_have_the_joints_of_their_models() -> None:
    for model in MODELS.values():
        for side in Side:
            found = skeleton_of(model, side)
            count = len(model.joints[side])
            assert found.joints == count
            assert schematic(model, side).joints == count
            assert schematic(model, side).schematic
            elements = sum(len(s.slots) for s in model.sensors)
            assert len(found.elements) in (0, elements)
            poses = found.poses(model.rest_q[side])
            assert np.isfinite(found.box_poses(poses)).all()
            assert np.isfinite(found.pin_poses(poses)).all()
            assert found.element_places(poses).shape == (len(found.elements), 3)
    for robot in ROBOTS.values():
        found = skeleton_of(robot)
        assert found.joints == len(robot.used)
        names = {s.joint: s.name for s in found.segments if s.joint is not None}
        assert [names[i] for i in range(found.joints)] == [robot.joint(i).name for i in robot.used]


def test_jaws_of_the_dex1_open_nine_centimetres() -> None:
    for side in Side:
        skeleton = skeleton_of(DEX1_1, side)
        gaps = []
        for q in (0.0, 2.7, 5.4):
            poses = skeleton.poses([q])
            frames = skeleton.box_poses(poses)
            pads = [i for i, b in enumerate(skeleton.boxes) if b.size[0] == pytest.approx(0.004)]
            assert len(pads) == 2
            gaps.append(abs(frames[pads[0], 0, 3] - frames[pads[1], 0, 3]) - 0.004)
        # 0.0445 m a jaw (docs/sources/unitree-dex.md#b3); the pads touch within a millimetre
        assert gaps[0] == pytest.approx(0.0, abs=0.003)
        assert gaps[2] - gaps[0] == pytest.approx(2 * 0.0445)
        assert gaps[1] == pytest.approx((gaps[0] + gaps[2]) / 2)


@FEW
@given(parts=st.lists(st.floats(0, 1), min_size=7, max_size=7))
def test_the_dex3_is_mirrored(parts: list[float]) -> None:
    """A right hand at mirrored positions is the mirror image of the left one."""
    left, right = (skeleton_of(DEX3_1, side) for side in Side)
    q = [j.q_min + p * j.stroke for j, p in zip(DEX3_1.joints[Side.LEFT], parts, strict=True)]
    # thumb_0 swings about y, the axis that is mirrored: its sign stays
    other = [q[0], *(-v for v in q[1:])]
    mirror = np.array([1.0, -1.0, 1.0])
    # in a mirror a rotation about y turns the same way, those about z the other way
    np.testing.assert_allclose(
        left.poses(q)[:, :3, 3] * mirror, right.poses(other)[:, :3, 3], atol=1e-12
    )


def test_fingers_of_the_dex3_close_toward_the_palm() -> None:
    for side in Side:
        skeleton = skeleton_of(DEX3_1, side)
        toward = rotation(skeleton.mount)
        closed = [
            (j.q_max if j.closing > 0 else j.q_min) * 0.5 * abs(j.closing)
            for j in DEX3_1.joints[side]
        ]
        for name in ("middle_1", "index_1"):
            begin, end = (toward @ tip(skeleton, q, name) for q in ([0.0] * 7, closed))
            assert begin[2] > 0.1  # upright
            assert end[1] < begin[1] - 0.01  # toward the viewer, where the palm looks


def test_fingers_of_the_dex5_are_as_long_as_in_the_urdf() -> None:
    for side in Side:
        skeleton = skeleton_of(DEX5_1, side)
        straight = tip(skeleton, [0.0] * 20, "Pitch_24")
        base = tip(skeleton, [0.0] * 20, "Roll_21")
        np.testing.assert_allclose(straight - base, [0.0, 0.0042 + 0.04 + 0.020985, 0.0], atol=1e-3)
        bent = [0.0] * 20
        bent[1] = math.pi / 2  # Pitch_22
        end = rotation(skeleton.mount) @ (tip(skeleton, bent, "Pitch_24") - base)
        np.testing.assert_allclose(end, [0.0, -0.061, 0.0042], atol=1.5e-3)


def test_robots_stand_upright() -> None:
    for name, height in (("g1", 0.6), ("h1", 0.8)):
        robot = ROBOTS[name]
        q = [robot.rest_q[i] for i in robot.used]
        poses = skeleton_of(robot).poses(q)
        assert poses[:, 2, 3].min() < -height
        assert poses[:, 2, 3].max() > 0.25


def test_contradicting_options_are_refused() -> None:
    with pytest.raises(UsageError, match="before its parent"):
        Skeleton((Segment("a", 0, (0.0, 0.0, 0.0)),), ())
    with pytest.raises(UsageError, match="length 1"):
        Skeleton((Segment("a", BASE, (0.0, 0.0, 0.0), axis=(1.0, 1.0, 0.0)),), ())
    with pytest.raises(UsageError, match="not there"):
        Skeleton((), (Box(0, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),))
    with pytest.raises(UsageError, match="needed"):
        skeleton_of(DEX3_1, Side.LEFT).poses([0.0])


# -- URDF ------------------------------------------------------------------------------------------


def as_urdf(skeleton: Skeleton, names: list[str]) -> str:
    def vector(values: tuple[float, ...]) -> str:
        return " ".join(repr(float(v)) for v in values)

    links = "".join(f'<link name="{s.name}"/>' for s in skeleton.segments)
    joints = ""
    for segment in skeleton.segments:
        parent = "base" if segment.parent == BASE else skeleton.segments[segment.parent].name
        assert segment.joint is not None
        joints += (
            f'<joint name="{names[segment.joint]}" type="revolute"><parent link="{parent}"/>'
            f'<child link="{segment.name}"/><origin xyz="{vector(segment.origin)}"'
            f' rpy="{vector(segment.rpy)}"/><axis xyz="{vector(segment.axis)}"/></joint>'
        )
    return f'<robot name="x"><link name="base"/>{links}{joints}</robot>'


@pytest.mark.parametrize("model", [DEX3_1, DEX5_1], ids=lambda m: m.name)
def test_a_urdf_moves_as_the_skeleton_it_was_made_of(tmp_path: Path, model: object) -> None:
    assert model in (DEX3_1, DEX5_1)
    hand = DEX3_1 if model is DEX3_1 else DEX5_1
    path = tmp_path / "hand.urdf"
    for side in Side:
        skeleton = skeleton_of(hand, side)
        joints = hand.joints[side]
        path.write_text(as_urdf(skeleton, [j.urdf for j in joints]))
        read = read_urdf(path, joints)
        q = hand.rest_q[side]
        by_name = {s.name: p for s, p in zip(read.segments, read.poses(q)[:-1], strict=True)}
        wanted = skeleton.poses(q)
        for segment, pose in zip(skeleton.segments, wanted[:-1], strict=True):
            np.testing.assert_allclose(by_name[segment.name], pose, atol=1e-9)
        assert read.boxes


def test_a_urdf_with_shapes_and_a_joint_that_mimics(tmp_path: Path) -> None:
    path = tmp_path / "gripper.urdf"
    path.write_text("""<robot name="g"><link name="base"><visual><geometry><box size=".1 .1 .05"/>
        </geometry></visual></link><link name="a"><visual><origin rpy="0 1.5708 0"/><geometry>
        <cylinder radius=".01" length=".1"/></geometry></visual></link><link name="b"/>
        <joint name="gripper" type="prismatic"><parent link="base"/><child link="a"/>
        <origin xyz="0 0 .1"/><axis xyz="2 0 0"/></joint>
        <joint name="other" type="prismatic"><parent link="base"/><child link="b"/>
        <origin xyz="0 0 .1"/><axis xyz="1 0 0"/>
        <mimic joint="gripper" multiplier="-1" offset=".01"/></joint></robot>""")
    read = read_urdf(path, DEX1_1.joints[Side.LEFT])
    poses = read.poses([0.04])
    assert poses[0, 0, 3] == pytest.approx(0.04)
    assert poses[1, 0, 3] == pytest.approx(-0.03)
    assert (0.02, 0.02, 0.1) in [b.size for b in read.boxes]


def test_a_bad_urdf_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.urdf"
    ring = "".join(
        f'<joint name="j{a}" type="fixed"><parent link="{a}"/><child link="{b}"/></joint>'
        for a, b in ("ab", "ba")
    )
    levels = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 8}">' for i in range(1, 17))
    laughs = f'<!DOCTYPE robot [<!ENTITY e0 "haha">{levels}]><robot name="&e16;"/>'
    for text, why in (
        ("no xml", "is no XML"),
        ("<html/>", "is no URDF"),
        ('<!DOCTYPE x [<!ENTITY e "e">]><robot/>', "entities"),
        *((f'<?xml version="1.0" encoding="{code}"?>{laughs}'.encode(code), "entities")
          for code in ("utf-8", "utf-16", "latin-1")),
        *((f'<?xml version="1.0" encoding="{code}"?><robot/>', "is no XML")
          for code in ("utf-16-le", "x-nosuch", "utf-32", "cp037", "zlib", "idna", "big5")),
        ("<robot>" + "<a>" * 100_000 + "</a>" * 100_000 + "</robot>", "none of the hand's"),
        ('<robot name="x"/>', "none of the hand's joints"),
        (f"<robot>{ring}</robot>", "loop"),
        ('<robot><joint name="gripper" type="revolute"><parent link="a"/><child link="b"/>'
         '<origin xyz="0 0"/></joint></robot>', "three numbers"),
        ('<robot><joint name="gripper" type="revolute"><parent link="a"/><child link="b"/>'
         '<origin xyz="0 0 nan"/></joint></robot>', "not a position"),
    ):  # fmt: skip
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(UsageError, match=why):
            read_urdf(path, DEX1_1.joints[Side.LEFT])
