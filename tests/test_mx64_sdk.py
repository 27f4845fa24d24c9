"""Test the emulated servos with ROBOTIS' unmodified SDK over a pseudo-terminal.

Where the SDK has a defect (docs/sources/mx64-ezgripper.md#a3, docs/sources/mx64-ezgripper.md#c3)
the emulator follows the manual, and the test notes it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import resources

import dynamixel_easy_sdk as easy
import dynamixel_sdk as sdk
import pytest

from dexkit.emulators.mx64 import EmulatedProcess, emulated_ezgripper
from dexkit.wire import mx64
from tests.patience import PATIENCE

OK = (sdk.COMM_SUCCESS, 0)


@pytest.fixture(autouse=True)
def _patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Answers within 34 ms are not what is tested here, and a busy machine may not make it.

    The constant is the one the SDK's users edit for slow adapters
    (docs/sources/mx64-ezgripper.md#c3).
    """
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 10_000)


@pytest.fixture
def silence(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no answer may come, waiting longer shows nothing more."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 300)


@pytest.fixture(scope="module")
def pair() -> Iterator[EmulatedProcess]:
    """Two grippers on one line, in another process."""
    with emulated_ezgripper(
        process=True, servo_ids=(1, 2), extra=["--set=fast-reads=yes"]
    ) as gripper:
        assert isinstance(gripper, EmulatedProcess)
        yield gripper


@pytest.fixture
def port(pair: EmulatedProcess) -> Iterator[sdk.PortHandler]:
    handler = sdk.PortHandler(pair.path)
    assert handler.openPort()
    assert handler.setBaudRate(1_000_000)  # closes and opens again
    yield handler
    for servo_id in (1, 2):
        PACKETS.write1ByteTxRx(handler, servo_id, mx64.TORQUE_ENABLE.address, 0)
    for servo_id in (1, 2):  # the next test finds both at rest
        eventually(
            lambda i=servo_id: (  # type: ignore[misc]
                PACKETS.read4ByteTxRx(handler, i, mx64.PRESENT_VELOCITY.address) == (0, *OK)
            )
        )
    handler.closePort()


PACKETS = sdk.PacketHandler(2.0)


def eventually(what: Callable[[], bool], seconds: float = PATIENCE) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline


def _come(port: sdk.PortHandler, count: int) -> None:
    """Wait until so many bytes are there, and leave them."""
    eventually(lambda: port.ser.in_waiting >= count)


def test_sdk_pings_the_servo(port: sdk.PortHandler) -> None:
    assert PACKETS.ping(port, 1) == (mx64.MODEL, *OK)


@pytest.mark.usefixtures("silence")
def test_ping_of_a_missing_servo_times_out(port: sdk.PortHandler) -> None:
    assert PACKETS.ping(port, 3)[1] == sdk.COMM_RX_TIMEOUT


def test_broadcast_ping(port: sdk.PortHandler) -> None:
    found, result = PACKETS.broadcastPing(port)
    assert result == sdk.COMM_SUCCESS
    assert found == {1: [mx64.MODEL, mx64.FIRMWARE], 2: [mx64.MODEL, mx64.FIRMWARE]}


def test_reads_and_writes_of_every_size(port: sdk.PortHandler) -> None:
    assert PACKETS.write1ByteTxRx(port, 1, mx64.LED.address, 1) == OK
    assert PACKETS.read1ByteTxRx(port, 1, mx64.LED.address) == (1, *OK)
    assert PACKETS.write2ByteTxRx(port, 1, mx64.POSITION_P_GAIN.address, 700) == OK
    assert PACKETS.read2ByteTxRx(port, 1, mx64.POSITION_P_GAIN.address) == (700, *OK)
    assert PACKETS.write4ByteTxRx(port, 1, mx64.GOAL_POSITION.address, 3010) == OK
    assert PACKETS.read4ByteTxRx(port, 1, mx64.GOAL_POSITION.address) == (3010, *OK)
    data, *rest = PACKETS.readTxRx(port, 1, 126, 21)
    assert (len(data), *rest) == (21, *OK)


def test_sdk_sends_and_receives_in_separate_calls(port: sdk.PortHandler) -> None:
    assert PACKETS.write1ByteTxOnly(port, 1, mx64.LED.address, 0) == sdk.COMM_SUCCESS
    port.is_using = False
    _come(port, 11)  # the status of the write, dropped by the next request
    assert PACKETS.read4ByteTx(port, 1, mx64.PRESENT_POSITION.address) == sdk.COMM_SUCCESS
    value, result, error = PACKETS.read4ByteRx(port, 1)
    assert (result, error) == OK
    assert 0 <= value < 8192


def test_registered_write_waits_for_action(port: sdk.PortHandler) -> None:
    assert PACKETS.regWriteTxRx(port, 1, mx64.LED.address, 1, [1]) == OK
    assert PACKETS.read1ByteTxRx(port, 1, mx64.REGISTERED_INSTRUCTION.address)[0] == 1
    assert PACKETS.action(port, 1) == sdk.COMM_SUCCESS
    port.is_using = False
    _come(port, 11)  # the SDK does not take the answer; the next request drops it
    assert PACKETS.read1ByteTxRx(port, 1, mx64.REGISTERED_INSTRUCTION.address)[0] == 0
    assert PACKETS.read1ByteTxRx(port, 1, mx64.LED.address)[0] == 1


@pytest.mark.usefixtures("silence")
def test_clear_reboot_and_factory_reset(port: sdk.PortHandler) -> None:
    assert PACKETS.clearMultiTurn(port, 2) == OK
    assert PACKETS.write1ByteTxRx(port, 2, mx64.RETURN_DELAY_TIME.address, 5) == OK
    assert PACKETS.reboot(port, 2) == OK
    eventually(lambda: PACKETS.ping(port, 2)[1:] == OK)
    assert PACKETS.read1ByteTxRx(port, 2, mx64.RETURN_DELAY_TIME.address) == (5, *OK)
    assert PACKETS.factoryReset(port, 2, 0x02) == OK
    eventually(lambda: PACKETS.ping(port, 2)[1:] == OK)
    assert PACKETS.read1ByteTxRx(port, 2, mx64.RETURN_DELAY_TIME.address) == (250, *OK)


def test_sdk_decodes_status_errors(port: sdk.PortHandler) -> None:
    result, error = PACKETS.write1ByteTxRx(port, 1, mx64.HARDWARE_ERROR_STATUS.address, 0)
    assert (result, error) == (sdk.COMM_SUCCESS, 7)
    assert "not available to target address" in PACKETS.getRxPacketError(error)
    PACKETS.write1ByteTxRx(port, 1, mx64.TORQUE_ENABLE.address, 1)
    assert PACKETS.write1ByteTxRx(port, 1, mx64.ID.address, 1) == (sdk.COMM_SUCCESS, 7)


def test_unstuffed_goals_of_the_sdk_are_accepted(port: sdk.PortHandler) -> None:
    """The SDK does not stuff what it sends (docs/sources/mx64-ezgripper.md#a3), but its length and
    CRC agree.
    """
    goal = mx64.GOAL_POSITION.address
    assert PACKETS.write1ByteTxRx(port, 1, mx64.OPERATING_MODE.address, 5) == OK
    # FF FF FD 00, a whole header inside the packet: understood, and out of range
    assert PACKETS.write4ByteTxRx(port, 1, goal, 0x00FDFFFF) == (sdk.COMM_SUCCESS, 4)
    # FF FF FD FF: in range; the answer is stuffed by the manual, and the SDK unstuffs it
    assert PACKETS.write4ByteTxRx(port, 1, goal, -131073 & 0xFFFFFFFF) == OK
    assert PACKETS.read4ByteTxRx(port, 1, goal) == (-131073 & 0xFFFFFFFF, *OK)
    assert PACKETS.write1ByteTxRx(port, 1, mx64.OPERATING_MODE.address, 3) == OK


def test_group_sync_read_and_write(port: sdk.PortHandler) -> None:
    writer = sdk.GroupSyncWrite(port, PACKETS, mx64.GOAL_POSITION.address, 4)
    assert writer.addParam(1, list((2000).to_bytes(4, "little")))
    assert writer.addParam(2, list((3000).to_bytes(4, "little")))
    assert writer.txPacket() == sdk.COMM_SUCCESS
    reader = sdk.GroupSyncRead(port, PACKETS, mx64.GOAL_POSITION.address, 4)
    assert reader.addParam(2)
    assert reader.addParam(1)
    assert reader.txRxPacket() == sdk.COMM_SUCCESS
    assert [reader.getData(i, 116, 4) for i in (1, 2)] == [2000, 3000]


def test_group_bulk_read_and_write(port: sdk.PortHandler) -> None:
    writer = sdk.GroupBulkWrite(port, PACKETS)
    assert writer.addParam(1, mx64.LED.address, 1, [1])
    assert writer.addParam(2, mx64.GOAL_POSITION.address, 4, list((2222).to_bytes(4, "little")))
    assert writer.txPacket() == sdk.COMM_SUCCESS
    reader = sdk.GroupBulkRead(port, PACKETS)
    assert reader.addParam(1, mx64.LED.address, 1)
    assert reader.addParam(2, mx64.GOAL_POSITION.address, 4)
    assert reader.txRxPacket() == sdk.COMM_SUCCESS
    assert reader.getData(1, mx64.LED.address, 1) == 1
    assert reader.getData(2, mx64.GOAL_POSITION.address, 4) == 2222


@pytest.mark.usefixtures("silence")
def test_group_read_of_a_missing_servo_fails(port: sdk.PortHandler) -> None:
    reader = sdk.GroupSyncRead(port, PACKETS, mx64.GOAL_POSITION.address, 4)
    for servo_id in (1, 9):
        assert reader.addParam(servo_id)
    assert reader.txRxPacket() == sdk.COMM_RX_TIMEOUT


def test_fast_sync_and_bulk_read_when_switched_on(port: sdk.PortHandler) -> None:
    reader = sdk.GroupSyncRead(port, PACKETS, mx64.PRESENT_POSITION.address, 4)
    bulk = sdk.GroupBulkRead(port, PACKETS)
    for servo_id in (1, 2):
        assert reader.addParam(servo_id)
        # not a block of 2 bytes: the SDK also searches an id among addresses and lengths
        assert bulk.addParam(servo_id, mx64.GOAL_POSITION.address, 4)
    assert reader.fastSyncRead() == sdk.COMM_SUCCESS
    slow = [PACKETS.read4ByteTxRx(port, i, mx64.PRESENT_POSITION.address)[0] for i in (1, 2)]
    assert [reader.getData(i, 132, 4) for i in (1, 2)] == slow
    assert bulk.fastBulkRead() == sdk.COMM_SUCCESS
    slow = [PACKETS.read4ByteTxRx(port, i, mx64.GOAL_POSITION.address)[0] for i in (1, 2)]
    assert [bulk.getData(i, 116, 4) for i in (1, 2)] == slow


def test_indirect_data_in_one_sync_write(port: sdk.PortHandler) -> None:
    """Goal Current and Goal Position, which are not neighbours, in six bytes."""
    for k, target in enumerate((102, 103, 116, 117, 118, 119)):
        assert PACKETS.write2ByteTxRx(port, 1, mx64.indirect_address(1 + k).address, target) == OK
    writer = sdk.GroupSyncWrite(port, PACKETS, mx64.indirect_data(1).address, 6)
    assert writer.addParam(1, list((321).to_bytes(2, "little") + (2345).to_bytes(4, "little")))
    assert writer.txPacket() == sdk.COMM_SUCCESS
    assert PACKETS.read2ByteTxRx(port, 1, mx64.GOAL_CURRENT.address) == (321, *OK)
    assert PACKETS.read4ByteTxRx(port, 1, mx64.GOAL_POSITION.address) == (2345, *OK)


def test_gripper_closes_and_opens(port: sdk.PortHandler) -> None:
    """The calibration of SAKE's driver: close far beyond the end, wait for standstill."""
    assert PACKETS.write1ByteTxRx(port, 1, mx64.OPERATING_MODE.address, 5) == OK
    assert PACKETS.write1ByteTxRx(port, 1, mx64.TORQUE_ENABLE.address, 1) == OK
    assert PACKETS.write2ByteTxRx(port, 1, mx64.GOAL_CURRENT.address, 480) == OK

    def position() -> int:
        value, *rest = PACKETS.read4ByteTxRx(port, 1, mx64.PRESENT_POSITION.address)
        assert tuple(rest) == OK
        return int(value) - (1 << 32 if value >> 31 else 0)

    goal = position() - 15000
    assert PACKETS.write4ByteTxRx(port, 1, mx64.GOAL_POSITION.address, goal & 0xFFFFFFFF) == OK
    still: list[int] = []

    def stands() -> bool:
        time.sleep(0.033)
        still.append(position())
        return len(still) > 5 and max(still[-5:]) - min(still[-5:]) <= 2 and still[-1] < 1600

    eventually(stands)
    zero = still[-1]
    assert zero == pytest.approx(1510 - 30, abs=25)
    PACKETS.write4ByteTxRx(port, 1, mx64.GOAL_POSITION.address, zero + 1250)
    eventually(lambda: abs(position() - zero - 1250) <= 25)


def test_table_matches_robotis_table() -> None:
    """Address and size of every item in the SDK's own model file."""
    text = resources.files("dynamixel_easy_sdk").joinpath("control_table/mx_64.model").read_text()
    rows = [line.split("\t") for line in text.split("[control table]")[1].splitlines()]
    theirs = {int(row[0]): (int(row[1]), row[2]) for row in rows if row[0].isdigit()}
    ours = {item.address: (item.size, item.name) for item in mx64.TABLE.values()}
    renamed = {12: "Secondary(Shadow) ID", 98: "BUS Watchdog"}
    assert len(theirs) > 50
    for address, (size, name) in theirs.items():
        assert ours[address][0] == size, name
        if not name.startswith("Indirect"):
            assert renamed.get(address, ours[address][1]) == name


def test_easy_sdk_example_runs(pair: EmulatedProcess) -> None:
    connector = easy.Connector(pair.path, 1_000_000)
    motors = connector.createAllMotors(0, 10)
    assert [m.id for m in motors] == [1, 2]
    motor = motors[0]
    motor.setOperatingMode(easy.OperatingMode.EXTENDED_POSITION)
    motor.enableTorque()
    assert motor.isTorqueOn() == 1
    here = motor.getPresentPosition()
    motor.setGoalPosition(here + 300)
    eventually(lambda: abs(motor.getPresentPosition() - here - 300) < 20)
    motor.disableTorque()
    connector.closePort()


def test_robotis_read_write_example_finishes_with_a_bare_servo() -> None:
    """What ``read_write.py`` of DynamixelSDK does, with the range that it has for an MX-64.

    It polls until the position is within 20 ticks of the goal, for ever if need be. With a gripper
    on the shaft it never gets there.
    """
    with closing(EmulatedProcess(["--set=bare=yes", "--set=baudrate=57600"])) as servo:
        handler = sdk.PortHandler(servo.path)
        assert handler.openPort()
        assert handler.setBaudRate(57_600)
        packets, torque, goal, present = sdk.PacketHandler(2.0), 64, 116, 132
        assert packets.write1ByteTxRx(handler, 1, torque, 1) == OK
        for end in (0, 4095):
            assert packets.write4ByteTxRx(handler, 1, goal, end) == OK

            def arrived(end: int = end) -> bool:
                position, *rest = packets.read4ByteTxRx(handler, 1, present)
                assert tuple(rest) == OK
                return abs(end - position) <= 20

            eventually(arrived)
        assert packets.write1ByteTxRx(handler, 1, torque, 0) == OK
        handler.closePort()
