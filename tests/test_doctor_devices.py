"""The doctor on real and emulated devices, sysfs, and the environment."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from dexkit.cli import doctor_devices
from dexkit.clock import RealClock
from dexkit.doctor import Observations, diagnose
from dexkit.doctor import usb as doctor_usb
from dexkit.doctor.environment import uri_problem
from dexkit.doctor.network import dds_sockets
from dexkit.doctor.observations import SerialPort, UsbDevice
from dexkit.doctor.proc_files import command_line, holders
from dexkit.doctor.rtps import unicast_port
from dexkit.emulators.dex3_mcu.hands import emulated_dex3
from dexkit.emulators.mx64 import Bus, Port, Servo
from dexkit.emulators.mx64.protocol1 import Protocol1Servo
from dexkit.errors import UsageError
from dexkit.hand import Side
from dexkit.wire.dex3_usb import PRODUCT_ID, VENDOR_ID
from tests.process_helpers import started


def _ids(*ports: SerialPort) -> set[str]:
    return {f.id for f in diagnose(Observations(serial=ports)) if f.id.startswith("SERIAL")}


@contextlib.contextmanager
def _line(
    *baudrates: int, servo_id: int = 1, old: tuple[Protocol1Servo, ...] = ()
) -> Iterator[str]:
    """The path of a line with an emulated servo set to a baud rate."""
    now = RealClock().now()
    servos = [Servo(servo_id, baudrate=rate, now=now) for rate in baudrates]
    with Port(Bus(servos, start=now, protocol_1=old)) as port:
        port.start()
        yield port.path


def test_servo_at_another_baud_rate_is_reported() -> None:
    with _line(57_600) as path:
        port = doctor_devices.inspect_port(path)
    assert [s.baudrate for s in port.servos] == [57_600]
    assert _ids(port) == {"SERIAL-BAUD"}


def test_servo_of_protocol_1_is_reported() -> None:
    with _line(old=(Protocol1Servo(1, baudrate=57_600),)) as path:
        port = doctor_devices.inspect_port(path)
    assert _ids(port) == {"SERIAL-PROTOCOL-1"}


def test_port_in_use_is_not_opened() -> None:
    hold = (
        "import serial, sys; p = serial.Serial(sys.argv[1], exclusive=True); "
        "print('open', flush=True); sys.stdin.read()"
    )
    with _line(1_000_000) as path:
        with started([sys.executable, "-c", hold, path], stdin=subprocess.PIPE) as other:
            assert other.stdin is not None
            assert other.stdout is not None
            assert other.stdout.readline() == "open\n"
            port = doctor_devices.inspect_port(path)
            assert not port.asked
            assert f"(pid {other.pid})" in port.holders[0]
            assert _ids(port) == {"SERIAL-BUSY"}
            other.stdin.close()
        assert not holders(path)


def test_missing_port_and_file_that_is_no_port_are_reported(tmp_path: Path) -> None:
    assert _ids(doctor_devices.inspect_port(str(tmp_path / "ttyUSB0"))) == {"SERIAL-MISSING"}
    (tmp_path / "file").touch()
    assert _ids(doctor_devices.inspect_port(str(tmp_path / "file"))) == {"SERIAL-NOT-A-PORT"}


def test_latency_timer_of_a_port_is_read(tmp_path: Path) -> None:
    with _line(1_000_000) as path:
        folder = tmp_path / "bus/usb-serial/devices" / Path(path).resolve().name
        folder.mkdir(parents=True)
        (folder / "latency_timer").write_text("16\n")
        port = doctor_devices.inspect_port(path, sysfs=tmp_path)
    assert port.latency_timer == 16
    assert _ids(port) == {"SERIAL-LATENCY"}


# --- USB


def _usb(*devices: UsbDevice) -> set[str]:
    found = diagnose(Observations(usb=devices, usb_wanted=True))
    return {f.id for f in found if f.id.startswith("USB")}


def test_hand_is_found_in_sysfs(tmp_path: Path) -> None:
    folder = tmp_path / "sys/bus/usb/devices/1-4"
    (tmp_path / "sys/bus/usb/drivers/cdc_acm").mkdir(parents=True)
    folder.mkdir(parents=True)
    (folder.parent / "1-4:1.0").mkdir()
    (folder.parent / "1-4:1.0/driver").symlink_to(tmp_path / "sys/bus/usb/drivers/cdc_acm")
    for name, text in {
        "idVendor": f"{VENDOR_ID:04x}",
        "idProduct": f"{PRODUCT_ID[Side.RIGHT]:04x}",
        "busnum": "1",
        "devnum": "12",
        "serial": "S7",
    }.items():
        (folder / name).write_text(text + "\n")
    node = tmp_path / "dev/bus/usb/001/012"
    node.parent.mkdir(parents=True)
    node.touch()
    (hand,) = doctor_usb.devices(tmp_path / "sys", tmp_path / "dev")
    assert (hand.where, hand.side, hand.serial) == ("1-4", "right", "S7")
    assert hand.node == str(node)
    assert hand.drivers == ("cdc_acm",)
    assert _usb(hand) == {"USB-DRIVER"}
    assert doctor_usb.devices(tmp_path / "nowhere") == ()
    assert _usb() == {"USB-MISSING"}


def test_hands_of_a_usbip_server_are_found() -> None:
    with emulated_dex3([Side.LEFT], serials=["S1"]) as hands:
        (hand,) = doctor_devices.on_server(hands.url)
        assert (hand.side, hand.serial) == ("left", "S1")
        assert _usb(hand) == set()
        (wrong,) = doctor_devices.on_server(f"{hands.url}/S2")
        assert "no Dex3-1 with serial number S2" in wrong.error
        assert _usb(wrong) == {"USB-UNREACHABLE"}
        gone = hands.url
    (lost,) = doctor_devices.on_server(gone)
    assert "no USB/IP server answers" in lost.error
    with pytest.raises(UsageError):
        doctor_devices.on_server("usbip://h/a/b")


# --- surroundings


def test_readable_cyclonedds_uri_has_no_finding(tmp_path: Path) -> None:
    good = "<CycloneDDS><Domain/></CycloneDDS>"
    file = tmp_path / "dds.xml"
    file.write_text('<?xml version="1.0"?>\n' + good)
    for uri in ("", good, f"file://{file}", str(file), f"file://{file},{file}"):
        assert uri_problem(uri) == "", uri
    assert "No such file" in uri_problem(f"file://{tmp_path}/none.xml")
    assert "Is a directory" in uri_problem(str(tmp_path))
    assert "not XML" in uri_problem("<CycloneDDS>")
    file.write_bytes(b"\xff\xfe\x00")
    assert "not UTF-8 text" in uri_problem(str(file))
    # a name with a NUL, a host that is none, bytes of the environment that are no text
    for odd in ("file://%00", "file://[::1", "/x\udc80", "<a\udc80/>"):
        assert "cannot" in uri_problem(odd) or "not XML" in uri_problem(odd), odd


def test_a_process_that_listens_to_a_domain_is_named() -> None:
    """Without DDS: a socket on the port of a participant is enough."""
    for domain in range(40, 90):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            try:
                sock.bind(("127.0.0.1", unicast_port(domain, 0)))
            except OSError:
                continue
            (found,) = dds_sockets([domain])
            assert (found.domain, found.pid) == (domain, os.getpid())
            assert found.command == command_line(os.getpid())
            return
    pytest.fail("no port is free")
