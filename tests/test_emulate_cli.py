"""``dexkit emulate``: the ports, their end, their files, faults while they run."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import signal
import socket
import subprocess
import termios
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import usbip

from dexkit.child_processes import command_line
from dexkit.emulators.dex3_mcu import Dex3Process
from dexkit.emulators.faults import MX64_FAULTS
from dexkit.emulators.mx64 import (
    EmulatedProcess,
    EmulatedThread,
    Firmware,
    emulated_ezgripper,
)
from dexkit.errors import EmulatorError, UsageError
from dexkit.wire import dynamixel as dxl
from dexkit.wire.dynamixel import Instruction, Packet
from tests.each import each
from tests.hostile import run_command
from tests.patience import PATIENCE

PING = dxl.encode(1, Instruction.PING)


class Client:
    """A serial client that sets its baud rate, without pyserial."""

    def __init__(self, path: str, speed: int = termios.B1000000) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        settings = termios.tcgetattr(self.fd)
        settings[4] = settings[5] = speed
        termios.tcsetattr(self.fd, termios.TCSANOW, settings)

    def ask(self, data: bytes, timeout: float = PATIENCE) -> Packet | None:
        os.write(self.fd, data)
        parser = dxl.PacketParser()
        deadline = time.monotonic() + timeout
        while True:
            ready, _, _ = select.select([self.fd], [], [], max(0.0, deadline - time.monotonic()))
            if not ready:
                return None
            data = os.read(self.fd, 1000)
            packets = parser.feed(data)
            if packets or not data:
                return packets[0] if packets else None

    def close(self) -> None:
        os.close(self.fd)


@contextlib.contextmanager
def client(path: str, speed: int = termios.B1000000) -> Iterator[Client]:
    opened = Client(path, speed)
    try:
        yield opened
    finally:
        opened.close()


def wait_for(what: object, seconds: float = PATIENCE) -> None:
    deadline = time.monotonic() + seconds
    assert callable(what)
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.005)


def ping(path: str, servo_id: int = 1, timeout: float = PATIENCE) -> bool:
    with client(path) as opened:
        return opened.ask(dxl.encode(servo_id, Instruction.PING), timeout) is not None


def is_cut_off(opened: Client) -> bool:
    """What a pulled cable looks like: an error on writing, or the end of what can be read."""
    try:
        return opened.ask(PING, 1.0) is None and os.read(opened.fd, 1) == b""
    except OSError as error:
        return error.errno == errno.EIO


def emulate(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command_line("emulate", "mx64", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


# --- the command


def test_emulator_answers_stops_and_leaves_no_files(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    process = emulate("--link", str(link), "--set", "id=7", "--set", "baudrate=57600")
    assert process.stdout is not None
    line = process.stdout.readline().decode()
    assert line.startswith(f"ready: {link} id=7 baudrate=57600 pty=/dev/pts/")
    assert os.readlink(link) == line.split("pty=")[1].strip()
    with client(str(link), termios.B57600) as opened:
        answer = opened.ask(dxl.encode(7, Instruction.PING))
    assert answer is not None
    assert answer.id == 7
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert "stopped: 10 bytes in, 14 bytes out" in out.decode()
    assert err == b""
    assert list(tmp_path.iterdir()) == []


def test_port_thread_takes_part_in_shutdown_while_a_client_is_connected(tmp_path: Path) -> None:
    with emulated_ezgripper(process=True, link=tmp_path / "g") as gripper:
        assert isinstance(gripper, EmulatedProcess)
        with client(gripper.path) as opened:
            assert opened.ask(PING) is not None
            gripper.close()
            assert is_cut_off(opened)
    assert list(tmp_path.iterdir()) == []


def test_stale_link_is_replaced_and_a_file_is_not(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    link.symlink_to("/dev/pts/9999")
    with emulated_ezgripper(link=link) as gripper:
        assert ping(gripper.path)
    assert not link.is_symlink()
    link.write_text("precious")
    with pytest.raises(EmulatorError), emulated_ezgripper(link=link):
        pass
    assert link.read_text() == "precious"
    with pytest.raises(EmulatorError), emulated_ezgripper(link=tmp_path / "no" / "such"):
        pass


def test_link_to_an_existing_file_is_not_replaced(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    with emulated_ezgripper(link=link) as gripper:
        with pytest.raises(EmulatorError) as caught, emulated_ezgripper(link=link):
            pass
        assert "another emulator" in caught.value.hint
        assert ping(gripper.path)
    link.symlink_to(tmp_path)
    with pytest.raises(EmulatorError), emulated_ezgripper(link=link):
        pass
    assert link.is_symlink()


def test_process_ends_with_its_parent(tmp_path: Path) -> None:
    """Its input ends when the program that started it is killed."""
    with emulated_ezgripper(process=True, link=tmp_path / "g") as gripper:
        assert isinstance(gripper, EmulatedProcess)
        assert gripper.process.stdin is not None
        gripper.process.stdin.close()
        assert gripper.process.wait(60) == 0
        gripper.process.stdin = None
    assert list(tmp_path.iterdir()) == []


def test_link_of_another_program_is_not_removed(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    with emulated_ezgripper(link=link):
        link.unlink()
        link.symlink_to("/dev/null")
    assert os.readlink(link) == "/dev/null"


@each(
    ("arguments", "code", "expected"),
    [
        ([], 2, "--link"),
        (["--set", "id=253"], 2, "253"),
        (["--set", "id=1,1"], 2, "different ids"),
        (["--set", "baudrate=1234"], 2, "1234"),
        (["--set", "object=100"], 2, "100"),
        (["--fault", "fire"], 2, "overload"),
        (["--set", "latency-timer=-1"], 2, "-1"),
    ],
)
def test_wrong_options_of_mx64_are_refused(
    tmp_path: Path, arguments: list[str], code: int, expected: str
) -> None:
    if arguments:
        arguments = ["--link", str(tmp_path / "g"), *arguments]
    found, _, err = run_command(["emulate", "mx64", *arguments])
    assert found == code
    assert expected in err
    assert list(tmp_path.iterdir()) == []


def test_helper_reports_why_it_did_not_start() -> None:
    with pytest.raises(EmulatorError) as caught, emulated_ezgripper(process=True, faults=["fire"]):
        pass
    assert "fire" in caught.value.hint
    assert all(kind.name in caught.value.hint for kind in MX64_FAULTS.kinds)


def test_helper_gives_up_waiting_for_a_silent_emulator() -> None:
    with pytest.raises(EmulatorError, match="did not start"):
        EmulatedProcess([], timeout=0.01)
    with pytest.raises(EmulatorError, match="did not start"):
        Dex3Process(["--link=usbip://127.0.0.1:0"], timeout=0.01)


# --- EEPROM from run to run


def test_eeprom_file_keeps_id_and_settings(tmp_path: Path) -> None:
    file = tmp_path / "eeprom.json"
    with (
        emulated_ezgripper(process=True, extra=[f"--set=eeprom={file}"]) as gripper,
        client(gripper.path) as opened,
    ):
        assert not file.exists()
        assert opened.ask(dxl.encode(1, Instruction.WRITE, b"\x26\0\x40\6")) is not None
        assert opened.ask(dxl.encode(1, Instruction.WRITE, b"\x07\0\x09")) is not None
    assert json.loads(file.read_text())["device"] == "mx64"
    with (
        emulated_ezgripper(process=True, extra=[f"--set=eeprom={file}"]) as gripper,
        client(gripper.path) as opened,
    ):
        assert "id=9" in gripper.ready_line
        answer = opened.ask(dxl.encode(9, Instruction.READ, b"\x26\0\2\0"))
        assert answer is not None
        assert answer.data == b"\x40\6"
    assert {p.name for p in tmp_path.iterdir()} == {"eeprom.json", ".eeprom.json.lock"}


def test_eeprom_file_without_a_directory_is_an_error_at_once(tmp_path: Path) -> None:
    words = ["emulate", "mx64", "--link", str(tmp_path / "g")]
    code, _, err = run_command([*words, f"--set=eeprom={tmp_path / 'no' / 'e.json'}"])
    assert code == 2
    assert "directory" in err
    assert not os.path.lexists(tmp_path / "g")


@each("text", ["", "{}", '{"device": "mx64", "eeprom": ["00"]}', "[1]"])
def test_broken_eeprom_file_is_an_error(tmp_path: Path, text: str) -> None:
    file = tmp_path / "eeprom.json"
    file.write_text(text)
    words = ["emulate", "mx64", "--link", str(tmp_path / "g"), f"--set=eeprom={file}"]
    code, _, err = run_command(words)
    assert code == 2
    assert "EEPROM" in err
    assert file.read_text() == text


# --- the port


def test_port_survives_clients_that_come_and_go() -> None:
    with emulated_ezgripper() as gripper:
        for _ in range(5):
            assert ping(gripper.path)
        assert isinstance(gripper, EmulatedThread)
        counters = gripper.bus.counters
        seen = counters.bytes_in
        with client(gripper.path) as opened:
            os.write(opened.fd, PING[:5])
            wait_for(lambda: counters.bytes_in == seen + 5)
        time.sleep(2 * Firmware().byte_gap)  # silence on the line, which ends the packet
        assert ping(gripper.path)


@pytest.mark.parametrize(
    ("speed", "answers"),
    [(termios.B1000000, True), (termios.B57600, False)],
)
def test_client_must_have_the_servos_baud_rate(speed: int, answers: bool) -> None:
    with emulated_ezgripper() as gripper, client(gripper.path, speed) as opened:
        assert (opened.ask(PING, 5.0 if answers else 0.2) is not None) == answers
        assert isinstance(gripper, EmulatedThread)
        assert gripper.bus.counters.garbled == (0 if answers else len(PING))


def test_unplug_and_replug_under_one_path(tmp_path: Path) -> None:
    link = tmp_path / "gripper"
    with emulated_ezgripper(link=link) as gripper:
        with client(gripper.path) as opened:
            assert opened.ask(PING) is not None
            gripper.inject("unplug:for=200ms")
            wait_for(lambda: not link.is_symlink())
            assert is_cut_off(opened)
            wait_for(lambda: link.is_symlink())
        assert ping(gripper.path)
    assert list(tmp_path.iterdir()) == []


def test_faults_can_be_injected() -> None:
    with emulated_ezgripper(process=True) as gripper, client(gripper.path) as opened:
        answer = opened.ask(PING)
        assert answer is not None
        assert not answer.alert
        gripper.inject("overload")

        def alerts() -> bool:
            status = opened.ask(PING)
            return status is not None and status.alert

        wait_for(alerts)
        with pytest.raises(UsageError):
            gripper.inject("fire")
    if isinstance(gripper, EmulatedProcess):
        assert (gripper.process.returncode, gripper.errors) == (0, "")
        assert gripper.output.startswith("stopped: ")


def test_protocol_1_firmware(tmp_path: Path) -> None:
    with (
        emulated_ezgripper(process=True, extra=["--set=protocol-1=yes"]) as gripper,
        client(gripper.path) as opened,
    ):
        assert opened.ask(PING, 0.2) is None
        os.write(opened.fd, bytes.fromhex("ffff010201fb"))
        data = b""
        while len(data) < 6:
            data += os.read(opened.fd, 6)
        assert data == bytes.fromhex("ffff010200fc")


def test_client_that_never_reads_does_not_block_the_servo() -> None:
    with emulated_ezgripper(line_time=False) as gripper:
        assert isinstance(gripper, EmulatedThread)
        read_all = dxl.encode(1, Instruction.READ, b"\xa8\0\x54\0")
        with client(gripper.path) as opened:
            for k in range(1, 301):
                os.write(opened.fd, read_all)
                wait_for(lambda k=k: gripper.bus.counters.instructions >= k)
            wait_for(lambda: gripper.port.overruns > 0)
            termios.tcflush(opened.fd, termios.TCIFLUSH)
            assert opened.ask(PING) is not None


# --- the hand on USB/IP


def emulate_dex3(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command_line("emulate", "dex3-usb", "--link", "usbip://127.0.0.1:0", *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def test_hand_prints_its_address_commands_and_counters() -> None:
    process = emulate_dex3("--side", "both", "--set", "serial=A1,B2")
    assert process.stdout is not None
    lines = [process.stdout.readline().decode().rstrip() for _ in range(7)]
    port = lines[0].split()[1].rsplit(":", 1)[1]
    assert lines == [
        f"ready: usbip://127.0.0.1:{port} left 34b7:1010 serial=A1 busid=1-1",
        f"ready: usbip://127.0.0.1:{port} right 34b7:1011 serial=B2 busid=1-2",
        "as a USB device of a Linux host (as root): modprobe vhci-hcd",
        f"  usbip --tcp-port {port} attach -r 127.0.0.1 -b 1-1",
        f"  usbip --tcp-port {port} attach -r 127.0.0.1 -b 1-2",
        "  lsusb -d 34b7:",
        f"without kernel support: dexkit serve dex3-usb --set guesses=accept "
        f"--set usb=usbip://127.0.0.1:{port}",
    ]
    with usbip.host.open(busid="1-2", transport=usbip.USBIP("127.0.0.1", int(port))) as handle:
        handle.bulk_out(0x02, bytes(1234))
        assert len(handle.bulk_in(0x81, 1270)) == 1270
        process.send_signal(signal.SIGTERM)  # with a client attached
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out.decode().splitlines() == [
        "stopped: left: nothing was sent",
        "stopped: right: 1 frames, 1 answers, 1 bad crc",
    ]
    assert err == b""


def test_hand_takes_faults_from_its_input_and_stops_at_its_end() -> None:
    process = emulate_dex3("--fault=-", "--fault", "drop@1h:for=1s")
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert b"'1h' is not a time" in err
    assert b"silent" in err  # the hint names what a hand can have

    process = emulate_dex3("--fault=-")
    assert process.stdin is not None
    assert process.stdout is not None
    port = int(process.stdout.readline().decode().split()[1].rsplit(":", 1)[1])
    transport = usbip.USBIP("127.0.0.1", port)
    assert len(usbip.host.list_devices(transport)) == 1
    process.stdin.write(b"fire\nunplug\n")
    process.stdin.flush()
    wait_for(lambda: usbip.host.list_devices(transport) == [])
    _, err = process.communicate(timeout=60)  # closes its input
    assert process.returncode == 0
    assert b"there is no kind 'fire'" in err
    assert b"Traceback" not in err


@each(
    ("arguments", "expected"),
    [
        (["--set", "serial=a,b"], "2 serial numbers for 1 hand"),
        (["--set", "out-endpoint=0x81"], "an OUT endpoint is 0x01 to 0x0f, not 0x81"),
        (["--set", "in-endpoint=one"], "'one' is not an endpoint address such as 0x81"),
        (["--link", "usbip://203.0.113.1:0"], "cannot serve USB/IP on 203.0.113.1"),
        (["--set", "start=80", "--set", "object=40"], "inside the object"),
        (["--side", "middle"], "middle"),
    ],
)
def test_invalid_hand_options_are_refused(arguments: list[str], expected: str) -> None:
    code, _, err = run_command(["emulate", "dex3-usb", *arguments])
    assert code == 2
    assert expected in err


def test_hand_on_every_address_prints_the_host_name() -> None:
    from dexkit.cli.emulate.dex3_usb import _how_to

    name = socket.gethostname()
    text = "\n".join(_how_to(SimpleNamespace(url="usbip://0.0.0.0:3240", busids=["1-1"])))
    assert "0.0.0.0" not in text
    assert f"usbip attach -r {name} -b 1-1" in text
    assert f"usbip://{name}:3240" in text


@each("option", ["object=40", "start=10", "closed-at=100"])
def test_a_bare_servo_has_no_gripper_to_set(option: str, tmp_path: Path) -> None:
    words = ["mx64", "--set=bare=yes", f"--set={option}", "--link", str(tmp_path / "servo")]
    code, _, err = run_command(["emulate", *words])
    assert code == 2
    assert f"{option.partition('=')[0]} describes a gripper" in err
