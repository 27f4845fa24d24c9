"""Test the driver of an Inspire RH56DFTP on the network, with the emulated one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pymodbus.client import ModbusTcpClient

from dexkit.backends import BackendOptions, backend
from dexkit.drivers import inspire_ftp_modbus
from dexkit.drivers.inspire_ftp_modbus import InspireFtpModbus, InspireFtpModbusSettings
from dexkit.drivers.inspire_modbus import InspireModbus, InspireModbusSettings
from dexkit.emulators.rh56 import Rh56TcpHand
from dexkit.errors import UsageError
from dexkit.hand import HandCommand, HandState, JointMode, MotorError, Side
from dexkit.models import INSPIRE_FTP
from dexkit.wire.rh56 import Register
from tests.dds_helpers import wait_until
from tests.patience import PATIENCE

N = 6
PATIENT = 1.0  # s; a busy machine answers late
FULL_SPEED = INSPIRE_FTP.joints[Side.RIGHT][0].dq_max
PLACES = [area.place for area in INSPIRE_FTP.dialects[0].areas]

# docs/sources/unitree-dex.md#j3: the manual's table of tactile registers, in bytes
TABLE = {
    **{"pinky tip": (3000, 18), "pinky top": (3018, 192), "pinky palm": (3210, 160)},
    **{"ring tip": (3370, 18), "ring top": (3388, 192), "ring palm": (3580, 160)},
    **{"middle tip": (3740, 18), "middle top": (3758, 192), "middle palm": (3950, 160)},
    **{"index tip": (4110, 18), "index top": (4128, 192), "index palm": (4320, 160)},
    **{"thumb tip": (4480, 18), "thumb top": (4498, 192), "thumb middle": (4690, 18)},
    **{"thumb palm": (4708, 192), "palm": (4900, 224)},
}


def driver(place: str, **change: object) -> InspireFtpModbus:
    values: dict[str, object] = {"device": place, "timeout": PATIENT, **change}
    settings = InspireFtpModbusSettings(**values)  # type: ignore[arg-type]
    return InspireFtpModbus(Side.RIGHT, settings)


@pytest.fixture
def emulated() -> Iterator[Rh56TcpHand]:
    with Rh56TcpHand(Side.RIGHT, start_pct=0.0, object_pct=60.0, tactile=True) as hand:
        yield hand


def until(
    hand: InspireFtpModbus, command: HandCommand, done: Callable[[HandState], bool]
) -> HandState:
    """Exchange until a state is as it should be."""
    ends = time.monotonic() + PATIENCE
    while not done(state := hand.exchange(command)):
        assert time.monotonic() < ends, state
    return state


def felt(state: HandState) -> dict[str, float]:
    assert state.pressure is not None
    most = np.nanmax(state.pressure, axis=1)
    return {place: count for place, count in zip(PLACES, most.tolist(), strict=True) if count}


def test_pymodbus_reads_the_areas_where_the_manual_has_them(emulated: Rh56TcpHand) -> None:
    assert list(TABLE) == PLACES
    host, _, port = emulated.path.rpartition(":")
    client = ModbusTcpClient(host, port=int(port))
    assert client.connect()

    def most(place: str) -> int:
        address, size = TABLE[place]
        registers = client.read_holding_registers(address, count=size // 2).registers
        assert len(registers) == size // 2
        return max(registers)

    client.write_registers(Register.ANGLE_SET, [1000, 1000, 1000, 200, 1000, 1000])
    wait_until(lambda: most("index palm") == 1000)
    assert {place for place in TABLE if most(place)} == {"index top", "index palm"}
    client.close()


def test_only_the_pressing_finger_reports_pressure(emulated: Rh56TcpHand) -> None:
    with driver(emulated.path) as hand:
        assert hand.spec.n_sensors == len(PLACES)
        assert emulated.device.goals == [None] * N  # no motion
        free = hand.exchange(HandCommand.brake(N))
        assert felt(free) == {}
        assert free.pressure is not None
        assert np.isfinite(free.pressure).sum(axis=1).tolist() == [
            size // 2 for _, size in TABLE.values()
        ]
        assert np.allclose(free.q, 1.0)
        assert free.temperature.tolist() == [35.0] * N
        grip = HandCommand.position([0.9] * 3 + [0.1] + [0.9] * 2, dq=[FULL_SPEED] * N)
        # areas are read in turn, so that one is older than the other
        held = until(hand, grip, lambda s: felt(s) == {"index top": 1000, "index palm": 1000})
        assert held.tau_est[3] == pytest.approx(-1.0, abs=0.05)  # it closes
        assert np.abs(np.delete(held.tau_est, 3)).max() < 0.1
        assert until(hand, grip, lambda s: not s.dq.any()).q[3] == pytest.approx(0.4, abs=0.002)
        letting_go = HandCommand.position([0.9] * N, dq=[FULL_SPEED] * N)
        moving = until(hand, letting_go, lambda s: bool(s.dq[3] > 0))
        assert moving.dq.argmax() == 3
        until(hand, letting_go, lambda s: felt(s) == {})


def test_speed_is_commanded_and_0_holds_a_joint(emulated: Rh56TcpHand) -> None:
    words = emulated.device.words
    with driver(emulated.path, speed=800, force=300) as hand:
        assert words[Register.SPEED_SET] == [800] * N
        assert words[Register.FORCE_SET] == [300] * N
        half = [FULL_SPEED / 2] * 5 + [0.0]
        hand.exchange(HandCommand.position([0.5] * N, dq=half))
        assert words[Register.SPEED_SET] == [400] * 5 + [800]
        assert emulated.device.goals == [500] * 5 + [1000]
        asked = hand.statistics.exchanges
        hand.exchange(HandCommand.position([0.5] * N, dq=half))
        # nothing is written again: angles, forces, three areas
        assert hand.statistics.exchanges == asked + 5
        hand.exchange(HandCommand.position([0.5] * N, dq=[9.9] * N))
        assert words[Register.SPEED_SET] == [800] * N
        command = HandCommand.position([0.2] * N, dq=[FULL_SPEED] * N)
        command.mode[0] = JointMode.BRAKE
        hand.exchange(command)
        assert emulated.device.goals[1:] == [200] * 5
        assert emulated.device.goals[0] != 200


def test_setting_areas_0_reports_no_pressure(emulated: Rh56TcpHand) -> None:
    with driver(emulated.path, areas=0) as hand:
        assert hand.spec.n_sensors == 0
        assert hand.exchange(HandCommand.brake(N)).pressure is None


def test_a_locked_joint_is_reported_at_once(emulated: Rh56TcpHand) -> None:
    with driver(emulated.path) as hand:
        hand.exchange(HandCommand.brake(N))
        emulated.inject("locked")
        state = until(hand, HandCommand.brake(N), lambda s: bool(s.fault.any()))
        assert set(state.fault) == {MotorError.LOCKED}


def test_hand_without_tactile_areas_reports_no_pressure() -> None:
    with Rh56TcpHand(Side.RIGHT) as plain:
        with driver(plain.path) as hand:
            assert felt(hand.exchange(HandCommand.brake(N))) == {}
        with InspireModbus(Side.RIGHT, InspireModbusSettings(plain.path)) as hand:
            assert hand.exchange(HandCommand.brake(N)).pressure is None


def test_backend_inspire_ftp_modbus_reads_its_settings() -> None:
    assert backend("inspire-ftp-modbus") is inspire_ftp_modbus.backend
    assert inspire_ftp_modbus.backend.emulator is not None
    assert "tactile=yes" in inspire_ftp_modbus.backend.emulator.arguments
    options = BackendOptions(Side.LEFT, "10.0.0.2:7000", {"id": "255", "areas": "5"})
    made = inspire_ftp_modbus.backend.make(options)
    assert isinstance(made, InspireFtpModbus)
    assert made.configuration == InspireFtpModbusSettings("10.0.0.2:7000", id=255, areas=5)
    for bad in ({"areas": "18"}, {"areas": "-1"}, {"speed": "0"}, {"id": "256"}):
        with pytest.raises(UsageError):
            inspire_ftp_modbus.backend.make(BackendOptions(Side.LEFT, "10.0.0.2", bad))
