"""Unitree's own SDK, in another process, and a dexkit node talk both ways on loopback.

On a machine whose ``lo`` lacks the MULTICAST flag this also proves discovery without multicast.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import pytest

from dexkit.dds import DdsNode, Qos, type_hash
from dexkit.messages import message_type
from dexkit.messages import unitree_go as go
from dexkit.messages import unitree_hg as hg
from tests.dds_helpers import dds_domain, dds_node, take_until
from tests.unitree_sdk import SdkClient

__all__ = ["dds_domain", "dds_node"]

if find_spec("unitree_sdk2py") is None:  # importing the bare package fails: tests.unitree_sdk
    pytest.skip("needs the unitree-sdk2 package", allow_module_level=True)

GO = "unitree_go::msg::dds_::"
HG = "unitree_hg::msg::dds_::"

COMMANDS: list[tuple[str, Any]] = [
    (GO + "MotorCmds_", go.MotorCmds_([go.MotorCmd_(1, 1.5, 0.25, -0.5, 5.0, 0.05, (1, 2, 3))])),
    (
        HG + "HandCmd_",
        hg.HandCmd_(
            [hg.MotorCmd_(16 + i, 0.1 * i, kp=1.5, kd=0.2) for i in range(7)], (4, 3, 2, 1)
        ),
    ),
]
STATES: list[tuple[str, Any]] = [
    (GO + "MotorStates_", go.MotorStates_([go.MotorState_(1, 2.7, -1.0, temperature=31, lost=7)])),
    (
        HG + "HandState_",
        hg.HandState_(
            [
                hg.MotorState_(q=0.1 * i, temperature=(31, -5), reserve=(i, 0, 0, 9))
                for i in range(7)
            ],
            [hg.PressSensorState_(pressure=(float(i),) * 12, lost=i) for i in range(9)],
            hg.IMUState_((1.0, 0.0, 0.0, 0.0), temperature=-7),
            power_v=24.0,
            error=(1, 2),
        ),
    ),
]


@pytest.fixture(scope="module")
def sdk(dds_domain: int) -> Iterator[SdkClient]:
    with SdkClient(dds_domain) as client:
        yield client


@pytest.mark.parametrize(("name", "message"), COMMANDS, ids=lambda v: str(v)[-10:])
def test_commands_of_the_unitree_sdk_are_received(
    dds_node: DdsNode, sdk: SdkClient, name: str, message: Any
) -> None:
    topic = f"rt/{name[8:10]}/cmd"
    reader = dds_node.reader(topic, name)
    sdk.publish(topic, name, message)
    sample = take_until(reader, bool)[-1]
    assert sample.data == message_type(name).encode(message)
    assert sample.data[:4] == b"\x00\x01\x00\x00"


@pytest.mark.parametrize(("name", "message"), STATES, ids=lambda v: str(v)[-10:])
def test_states_are_received_by_the_unitree_sdk(
    dds_node: DdsNode, sdk: SdkClient, name: str, message: Any
) -> None:
    topic = f"rt/{name[8:10]}/state"
    writer = dds_node.writer(topic, name)
    sdk.subscribe(topic, name)
    assert writer.wait_matched(60)
    writer.write(message)
    (sample,) = sdk.wait(topic)
    assert sample.data == message_type(name).encode(message)


def test_types_and_qos_equal_those_of_the_unitree_sdk(dds_node: DdsNode, sdk: SdkClient) -> None:
    name = GO + "MotorCmds_"
    topic = "rt/types"
    reader = dds_node.reader(topic, name)
    sdk.stream(topic, name, go.MotorCmds_([]), hz=100)
    assert reader.wait_matched(60)
    assert len(take_until(reader, lambda s: len(s) >= 10)) >= 10
    (writer,) = [e for e in dds_node.endpoints() if e.topic == topic and e.kind == "writer"]
    (mine,) = [e for e in dds_node.endpoints() if e.topic == topic and e.own]
    assert writer.type_name == name
    # the SDK's own description of the type against the one made from dexkit's .idl
    assert writer.type_hash == mine.type_hash == type_hash(name)
    assert writer.qos == Qos.writer_default()
    assert f"(pid {sdk.pid})" in writer.process
    assert sdk.stop(topic) >= 10


def test_unitree_sdk_reads_best_effort(dds_node: DdsNode, sdk: SdkClient) -> None:
    topic = "rt/qos"
    sdk.subscribe(topic, GO + "MotorStates_")
    assert dds_node.discovery.wait(lambda found: any(e.topic == topic for e in found), 60)
    (reader,) = [e for e in dds_node.endpoints() if e.topic == topic]
    assert reader.qos == Qos.reader_default()
    best_effort = dds_node.writer(topic, GO + "MotorStates_", qos=Qos("best_effort"))
    assert best_effort.wait_matched(60)
