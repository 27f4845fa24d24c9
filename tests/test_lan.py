"""Packets of a network that was not chosen never reach a program; clients on the chosen one do.

A robot has two networks, net0 with a friend and net1 with a stranger, each a network namespace.
The robot is set up as badly as can be: it routes packets for 127.0.0.1 from net1, believes any
sender's address, and something on it has joined the group of discovery on net1.
"""

from __future__ import annotations

import ast
import ctypes
import errno
import fnmatch
import importlib.util
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from dexkit import interface_filter
from dexkit.cli import main
from dexkit.dds import DdsNode
from tests.dds_helpers import free_domain
from tests.namespaces import Host, Link, connect, network, unavailable
from tests.slow_hand import SLOW

ROOT = Path(__file__).parent.parent
NET0 = Link("robot", "net0", "10.9.0.1", "friend", "port0", "10.9.0.2")
NET1 = Link("robot", "net1", "10.9.1.1", "stranger", "port1", "10.9.1.2")
_LOOPBACK_INDEX = 1  # always, on Linux
_PIDFD_GETFD = 438  # the number of the system call, on every processor

_ROBOT = """
for name in all net1; do
    echo 1 > /proc/sys/net/ipv4/conf/$name/route_localnet
    echo 0 > /proc/sys/net/ipv4/conf/$name/rp_filter
    echo 1 > /proc/sys/net/ipv4/conf/$name/accept_local
done
ip address add 239.255.0.1/32 dev net1 autojoin
"""
_STRANGER = """
echo 1 > /proc/sys/net/ipv4/conf/port1/route_localnet
ip address delete 127.0.0.1/8 dev lo
ip route add 127.0.0.0/8 via 10.9.1.1 dev port1
ip route add 10.9.0.0/24 via 10.9.1.1
ip route add 239.0.0.0/8 dev port1
"""
_TOPICS = ("rt/dex1/left/cmd", "rt/unitree_actuator/cmd")
_WAYS = (
    "10.9.1.1",
    "10.9.0.1",  # the address of the other interface
    "127.0.0.1",
    "239.255.0.1",  # a group that somebody on the robot has joined there
    "10.9.1.255",
    "10.9.1.1@127.0.0.1",  # as if sent by the robot itself
    "10.9.0.1@10.9.0.2",  # as if sent by the friend
)


@pytest.fixture(scope="module")
def hosts() -> Iterator[dict[str, Host]]:
    if why := unavailable():
        pytest.skip(why)
    with network(NET0, NET1) as found:
        found["robot"].sh(_ROBOT)
        found["stranger"].sh(_STRANGER)
        yield found


class Program:
    """A ``dexkit`` command, or another of Python, on a host; what it prints is kept."""

    def __init__(
        self, host: Host, *arguments: object, module: tuple[str, ...] = ("-m", "dexkit")
    ) -> None:
        self.arguments = arguments
        self.process = host.popen(sys.executable, *module, *arguments, stdin=subprocess.DEVNULL)
        self.lines: list[str] = []
        self._news = threading.Condition()
        self._threads = [
            threading.Thread(target=self._read, args=(stream,), daemon=True)
            for stream in (self.process.stdout, self.process.stderr)
        ]
        for thread in self._threads:
            thread.start()

    def _read(self, stream: Any) -> None:
        for line in stream:
            with self._news:
                self.lines.append(line.strip())
                self._news.notify_all()

    def wait_line(self, pattern: str, after: int = 0, timeout: float = 120.0) -> str:
        """The first line that matches, of those after the first ``after``."""

        def found() -> list[str]:
            return [line for line in self.lines[after:] if re.search(pattern, line)]

        with self._news:
            assert self._news.wait_for(found, timeout), (pattern, self.arguments, self.lines)
            return found()[0]

    def counters(self) -> dict[str, Any]:
        """Its counters now."""
        seen = len(self.lines)
        self.process.send_signal(signal.SIGUSR1)
        line = self.wait_line(r"counters \{", seen)
        counted: dict[str, Any] = json.loads(line[line.index("{") :])
        return counted

    def end(self) -> int:
        """Ask it to end: its exit code."""
        self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        finally:
            for thread in self._threads:
                thread.join(10)


@contextmanager
def programs(host: Host, *commands: tuple[object, ...]) -> Iterator[list[Program]]:
    """Commands that run at once and are ready, stopped at the end."""
    with ExitStack() as stack:
        started = []
        for command in commands:
            program = Program(host, *command)
            started.append(program)
            stack.callback(lambda p=program: p.process.poll() is None and p.end())
        for program in started:
            program.wait_line("^ready: ")
        yield started


def attack(
    host: Host,
    *ways: str,
    domains: Iterable[int],
    ports: Iterable[int] = (),
    seconds: float = 1.0,
) -> None:
    """Attack these domains, and these ports, in all these ways, to the end."""
    words = [word for domain in domains for word in ("--domain", str(domain))]
    words += [word for port in ports for word in ("--port", str(port))]
    words += [word for topic in _TOPICS for word in ("--topic", topic)]
    words += [word for way in ways for word in ("--to", way)]
    out = host.run(sys.executable, "-m", "tests.lan_attack", *words, "--seconds", seconds)
    assert int(out.split()[-1]) > 20, out


def command(host: Host, domain: int, interface: str, q: float) -> None:
    """A genuine client on this host: fails unless the hand obeys it."""
    client = ("-m", "tests.lan_client", "--domain", domain, "--interface", interface, "--q", q)
    host.run(sys.executable, *client)


def received(program: Program) -> int:
    counters = program.counters()
    assert counters["received"] >= counters["hands"]["left"]["accepted"]
    return int(counters["received"])


GRIPPER = ("serve", *SLOW, "--side", "left")


def test_packets_of_another_network_are_ignored_and_clients_obeyed(hosts: dict[str, Host]) -> None:
    robot, friend, stranger = hosts["robot"], hosts["friend"], hosts["stranger"]
    on_lo = (*GRIPPER, "--domain", 104)
    on_net0 = (*GRIPPER, "--domain", 105, "--interface", "net0")
    with programs(robot, on_lo, on_net0) as (local, named):
        attack(stranger, *_WAYS, domains=(104, 105))
        assert (received(local), received(named)) == (0, 0)
        # the same packets do move a hand where they are let in: DDS has no authentication
        attack(friend, "10.9.0.1", domains=(104, 105), seconds=0.5)
        assert received(named) > 0
        assert received(local) == 0
        command(robot, 104, "lo", 2.0)
        command(friend, 105, "port0", 3.0)
        _hears_this_machine_only("service", local)
        assert (local.end(), named.end()) == (0, 0)


@pytest.mark.slow
def test_sending_socket_takes_nothing_from_another_network(hosts: dict[str, Host]) -> None:
    """CycloneDDS reads that socket, too, and takes commands by it as by the others."""
    robot, friend, stranger = hosts["robot"], hosts["friend"], hosts["stranger"]
    # the second address is the one that CycloneDDS might use
    robot.sh("ip address add 10.9.0.7/24 dev net0 label net0:1")
    commands = ((*GRIPPER, "--domain", 108), (*GRIPPER, "--domain", 109, "--interface", "net0"))
    try:
        with programs(robot, *commands) as (local, named):
            for program in (local, named):
                ((address, port),) = _sending(program)
                attack(stranger, address, domains=(), ports=(port,), seconds=0.5)
                assert received(program) == 0
            attack(friend, address, domains=(), ports=(port,), seconds=0.5)
            assert received(named) > 0
            index = int(robot.sh("ip -o link show net0").split(":")[0])
            assert _filtered(named, index) == {True}
    finally:
        robot.sh("ip address delete 10.9.0.7/24 dev net0")


_ECHO = """
import socket
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
    sock.bind(("127.0.0.1", 9000))
    sock.settimeout(20)
    print("ready", flush=True)
    print(sock.recvfrom(100)[1][0])
"""


def test_unfiltered_socket_receives_from_the_other_network(hosts: dict[str, Host]) -> None:
    """Without a filter a socket on 127.0.0.1 receives from the network: the tests can fail."""
    with hosts["robot"].popen(sys.executable, "-c", _ECHO) as echo:
        assert echo.stdout is not None
        assert echo.stdout.readline() == "ready\n"
        hosts["stranger"].run(
            sys.executable,
            "-c",
            "import socket; s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); "
            "s.sendto(b'x', ('127.0.0.1', 9000))",
        )
        assert echo.stdout.readline().startswith("10.9.1.2")


_NODES = """
import sys
from dexkit.dds import DdsNode
CMDS = "unitree_go::msg::dds_::MotorCmds_"
strangers = 0
for _ in range(6):
    with DdsNode(106) as node:
        reader, writer = node.reader("rt/dex1/left/cmd", CMDS), node.writer("rt/x", CMDS)
        with DdsNode(106) as other:  # discovery has come round when they have met
            assert other.reader("rt/x", CMDS).wait_matched(20)
        strangers += sum(not p.own and not p.pid for p in node.discovery.participants())
        strangers += len(reader.take())
print(strangers)
"""


def test_no_packet_passes_while_a_node_starts(hosts: dict[str, Host]) -> None:
    """CycloneDDS's sockets are open before they have their filter."""
    flood = ("--domain", "106", "--to", "10.9.1.1", "--seconds", "60", "--pause", "0")
    with hosts["stranger"].popen(sys.executable, "-m", "tests.lan_attack", *flood) as flooding:
        try:
            assert flooding.stdout is not None
            assert flooding.stdout.readline() == "attacking\n"
            assert hosts["robot"].run(sys.executable, "-c", _NODES) == "0\n"
        finally:
            flooding.terminate()


def test_interface_that_returns_is_used_again(hosts: dict[str, Host]) -> None:
    robot, friend = hosts["robot"], hosts["friend"]
    with programs(robot, (*GRIPPER, "--domain", 107, "--interface", "net0")) as (service,):
        command(friend, 107, "port0", 3.0)
        robot.sh("ip link delete net0")
        service.wait_line("net0 is gone")
        connect(hosts, NET0)  # with another index
        service.wait_line("net0 is back")
        command(friend, 107, "port0", 1.0)
        index = int(robot.sh("ip -o link show net0").split(":")[0])
        assert _filtered(service, index) == {True}
        robot.sh("ip address flush dev net0; ip address add 10.9.0.9/24 dev net0")
        service.wait_line("address of net0 was 10.9.0.1 and is 10.9.0.9")
        robot.sh("ip link delete net0")
        assert service.end() == 0
    connect(hosts, NET0)


def _sockets(pid: int) -> dict[str, int]:
    """Inodes and file descriptors of a process's sockets."""
    found = {}
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = os.readlink(entry)
        except OSError:
            continue
        if target.startswith("socket:["):
            found[target[8:-1]] = int(entry.name)
    return found


def _family(pid: int) -> list[int]:
    """A process and those that it has started."""
    found = [pid]
    with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += _family(int(child))
    return found


def _filter_of(sock: socket.socket) -> bytes:
    code = ctypes.create_string_buffer(4096 * 8)
    count = ctypes.c_uint32(4096)
    libc = ctypes.CDLL(None, use_errno=True)
    # SO_GET_FILTER; the length is in instructions
    result = libc.getsockopt(sock.fileno(), socket.SOL_SOCKET, 26, code, ctypes.byref(count))
    return code.raw[: count.value * 8] if result == 0 else b""


def _filter_in(pid: int, descriptor: int) -> bytes:
    """The filter of a socket of another process."""
    pidfd = os.pidfd_open(pid)
    try:
        copy = ctypes.CDLL(None, use_errno=True).syscall(_PIDFD_GETFD, pidfd, descriptor, 0)
    finally:
        os.close(pidfd)
    if copy < 0:
        pytest.skip(f"sockets of a child cannot be looked at: {os.strerror(ctypes.get_errno())}")
    with closing(socket.socket(fileno=copy)) as sock:
        return _filter_of(sock)


def _listening(pid: int) -> Iterator[tuple[str, str, int, int]]:
    """What a process takes packets on: protocol, local address, port and file descriptor."""
    own = _sockets(pid)
    for protocol in ("udp", "udp6", "tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{protocol}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[9] in own and (protocol[:3] == "udp" or fields[3] == "0A"):
                address, port = fields[1].split(":")
                words = bytes.fromhex(address)  # of four bytes, in this machine's order
                packed = b"".join(words[i : i + 4][::-1] for i in range(0, len(words), 4))
                kind = socket.AF_INET6 if protocol.endswith("6") else socket.AF_INET
                yield protocol, socket.inet_ntop(kind, packed), int(port, 16), own[fields[9]]


def _filters(program: Program, indices: Sequence[int]) -> list[tuple[str, str, bool]]:
    """Protocol, local address, and whether packets come in by these interfaces alone."""
    wanted = interface_filter.program(indices)
    found = []
    for pid in _family(program.process.pid):
        with suppress(FileNotFoundError, ProcessLookupError):  # a child that has ended meanwhile
            for protocol, address, _, descriptor in _listening(pid):
                found.append((protocol, address, _filter_in(pid, descriptor) == wanted))
    return found


def _filtered(program: Program, index: int) -> set[bool]:
    """Whether whatever takes packets lets in loopback and that interface alone."""
    return {filtered for _, _, filtered in _filters(program, [_LOOPBACK_INDEX, index])}


def _sending(program: Program) -> list[tuple[str, int]]:
    """Address and port of what a program sends from."""
    found = _listening(program.process.pid)
    return [(a, port) for protocol, a, port, _ in found if protocol == "udp" and a != "0.0.0.0"]


def _hears_this_machine_only(name: str, program: Program) -> None:
    # some receive before they send anything, the doctor only while it looks
    deadline = time.monotonic() + 60
    while not (seen := _filters(program, [_LOOPBACK_INDEX])):
        assert time.monotonic() < deadline, (name, program.lines)
        time.sleep(0.02)
    for protocol, address, filtered in seen:
        assert filtered, (name, seen)
        # local: the doctor's, what CycloneDDS sends from, the USB/IP server's
        assert address == "127.0.0.1" or (protocol, address) == ("udp", "0.0.0.0"), (name, seen)


@pytest.mark.slow
def test_every_program_on_loopback_filters_its_sockets(
    hosts: dict[str, Host], tmp_path: Path
) -> None:
    """Of those that listen; the service is above."""
    recording = tmp_path / "a.mcap"
    ends = ("unitree_actuator", "unitree_go")
    commands: dict[str, tuple[object, ...]] = {
        "bridge": ("bridge", *ends, "--domain", 111, "--to-domain", 112),
        "robot": ("emulate", "h1", "--domain", 113),
        "recorder": ("record", recording, "--domain", 114),
        "USB device": ("emulate", "dex3-usb", "--link", "usbip://127.0.0.1:0"),
        "doctor": ("doctor", "--watch", "--domain", 115),
    }
    with ExitStack() as stack:
        started = {name: Program(hosts["robot"], *words) for name, words in commands.items()}
        for program in started.values():
            stack.callback(lambda p=program: p.process.poll() is None and p.end())
        for name, program in started.items():
            if name != "doctor":
                program.wait_line("^ready: ")
        attack(hosts["stranger"], *_WAYS, domains=range(111, 116), seconds=0.3)
        for name, program in started.items():
            _hears_this_machine_only(name, program)
        bridge = started["bridge"]
        assert bridge.end() == 0
        counters = bridge.wait_line("counters {")
        assert '"received": 0' in counters
        assert not re.search('"received": [1-9]', counters), counters
        assert "their samples mix" not in " ".join(bridge.lines)
        # nothing to record, and no participant discovered
        assert started["recorder"].end() == 1
        assert "no other participant was seen" in " ".join(started["recorder"].lines)
        assert not recording.exists()


@pytest.mark.soak
def test_clients_and_robots_on_loopback_filter_their_sockets(hosts: dict[str, Host]) -> None:
    sample = ROOT / "traces" / "samples" / "dex1_pick_place.mcap"
    kit = ("-m", "pytest", "conformance", "--backend", "sim-dex1", "-q", "-p", "no:cacheprovider")
    dexkit = ("-m", "dexkit")
    with ExitStack() as stack:
        for name, words in {
            "replay": (*dexkit, "replay", sample, "--domain", 116, "--wait", 60),
            "teleoperation": (*dexkit, "teleop", "full-stroke", "--domain", 117),
            "whole robot": (*dexkit, "emulate", "all", "--domain", 118),
            "conformance": (*kit, "--domain", 119),
        }.items():
            program = Program(hosts["robot"], *words, module=())
            stack.callback(lambda p=program: p.process.poll() is None and p.end())
            if name == "whole robot":
                program.wait_line("^ready: ")
            _hears_this_machine_only(name, program)


# what listens, by its row of docs/security.md; on the ports that it has by default
_LISTENING: dict[str, tuple[object, ...]] = {
    "serve": (*GRIPPER, "--domain", 120),
    "doctor": ("doctor", "--watch", "--domain", 121),
    "emulate dex3-usb": ("emulate", "dex3-usb"),
    "emulate lerobot-g1": ("emulate", "lerobot-g1", "--domain", 122),
    "emulate rh56 --link tcp://...": ("emulate", "rh56", "--link", "tcp://127.0.0.1:1502"),
    "view": ("view", "--no-open", "--domain", 123),
    "view --foxglove": ("view", "--foxglove", "--domain", 124),
    "view --rerun": (*("view", "--rerun", "rerun+http://127.0.0.1:9/proxy", "--domain", 125),),
}
_ON_DDS = ("doctor", "emulate lerobot-g1", "view", "view --foxglove", "view --rerun")
_NEEDS = {
    "emulate lerobot-g1": "zmq",
    "view": "viser",
    "view --foxglove": "foxglove",
    "view --rerun": "rerun",
}
_TABLE = ROOT / "docs" / "security.md"


def _rows() -> list[list[str]]:
    """The cells of the table of listeners."""
    section = _TABLE.read_text().split("## What is open by default")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]


def _documented() -> dict[str, list[str]]:
    """Sockets that the table names, such as ``tcp 127.0.0.1:3240``, by command."""
    found = {}
    for row in _rows():
        sockets = re.findall(r"`((?:tcp|udp) [^`]+)`", row[1])
        found |= dict.fromkeys(re.findall(r"`([^`]+)`", row[0]), sockets)
    return found


def _seen(program: Program) -> set[tuple[str, str, int]]:
    """Protocol, address and port of what a program and its children take packets on."""
    found = set()
    for pid in _family(program.process.pid):
        with suppress(FileNotFoundError, ProcessLookupError):  # a child that has ended meanwhile
            found |= {
                (protocol[:3], address, port) for protocol, address, port, _ in _listening(pid)
            }
    return found


_REACH = """
import errno, select, socket, sys, time
waiting = {}
for place in sys.argv[2:]:
    host, port = place.split(":")
    sock = socket.socket()
    sock.setblocking(False)
    if sock.connect_ex((host, int(port))) in (0, errno.EINPROGRESS):
        waiting[sock] = place
end = time.monotonic() + float(sys.argv[1])
while waiting and (left := end - time.monotonic()) > 0:
    for sock in select.select([], list(waiting), [], left)[1]:
        if not sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            print(waiting[sock])
        del waiting[sock]
"""
_OPEN = """
import socket
with socket.create_server(("127.0.0.1", 9001)):
    print("ready: open", flush=True)
    input()
"""


def _reached(host: Host, places: Iterable[str], seconds: float) -> set[str]:
    """Those of these TCP ports, ``ADDRESS:PORT``, that a host can connect to."""
    return set(host.run(sys.executable, "-c", _REACH, seconds, *places).split())


@pytest.mark.slow
def test_what_listens_is_documented_and_reached_by_this_machine_only(
    hosts: dict[str, Host],
) -> None:
    """On each port of TCP, a server without a filter beside them: the network reaches that one."""
    documented = _documented()
    robot, stranger = hosts["robot"], hosts["stranger"]
    with ExitStack() as stack:
        started = {}
        for name, words in _LISTENING.items():
            if name in _NEEDS and importlib.util.find_spec(_NEEDS[name]) is None:
                continue
            program = started[name] = Program(robot, *words)
            stack.callback(lambda p=program: p.process.poll() is None and p.end())
        unfiltered = robot.popen(sys.executable, "-c", _OPEN, stdin=subprocess.PIPE)
        stack.callback(unfiltered.communicate)
        assert unfiltered.stdout is not None
        assert unfiltered.stdout.readline() == "ready: open\n"
        tcp = {("127.0.0.1", 9001)}
        for name, program in started.items():
            if name == "doctor":
                _hears_this_machine_only(name, program)
            else:
                program.wait_line("^ready: ")
            found = _seen(program)
            own = [p.replace("PORT", "1502") for p in documented[name]]
            known = own + (documented["serve"] if name in _ON_DDS else [])
            for listener in found:
                shown = _shown(listener)
                assert any(fnmatch.fnmatch(shown, p) for p in known), (name, shown)
            for pattern in own:
                assert fnmatch.filter(map(_shown, found), pattern), (name, pattern, found)
            tcp |= {(address, port) for protocol, address, port in found if protocol == "tcp"}
        addresses = ("127.0.0.1", "10.9.1.1", "10.9.0.1")
        ways = {f"{a}:{port}" for own, port in tcp for a in (*addresses, own)}
        assert _reached(stranger, ways, 1.0) == {"127.0.0.1:9001"}
        # not the server behind another, which has an address of its own: as for a browser
        public = {f"{address}:{port}" for address, port in tcp if address == "127.0.0.1"}
        assert _reached(robot, ways, 1.0) == public


def _shown(listener: tuple[str, str, int]) -> str:
    """As the table writes it."""
    protocol, address, port = listener
    return f"{protocol} {address}:{port}"


def test_table_of_listeners_names_tests_that_there_are() -> None:
    rows = _rows()
    assert len(rows) > len(_LISTENING)
    for row in rows:
        names = re.findall(r"`(test_\w+)\.py::(test_\w+)`", row[-1])
        assert names, row
        for file, name in names:
            assert f"def {name}(" in (ROOT / "tests" / f"{file}.py").read_text(), (row, name)


# --- without networks


def _refuse(sock: socket.socket, indices: object) -> None:
    raise OSError(errno.ENOPROTOOPT, "Protocol not available")


@pytest.mark.parametrize("arguments", [("record", "x.mcap"), ("doctor",)])
def test_without_a_filter_nothing_starts(
    arguments: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(interface_filter, "accept_only", _refuse)
    monkeypatch.delenv(interface_filter.ALL_INTERFACES, raising=False)
    with pytest.raises(SystemExit) as ended:
        main([*arguments, "--domain", str(free_domain())])
    assert ended.value.code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "networks other than lo cannot be kept out" in said
    assert interface_filter.ALL_INTERFACES in said


def test_running_without_a_filter_can_be_allowed_and_logs_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(interface_filter, "accept_only", _refuse)
    monkeypatch.setenv(interface_filter.ALL_INTERFACES, "1")
    domain = free_domain()
    with DdsNode(domain) as node, DdsNode(domain) as other:
        reader = node.reader("rt/x", "unitree_go::msg::dds_::MotorCmds_")
        assert other.writer("rt/x", "unitree_go::msg::dds_::MotorCmds_").wait_matched(20)
        assert reader.matched == 1
    assert f"domain {domain} is open to every network of this machine" in caplog.text


_OPENING = {"bind", "listen", "create_server", "start_server", "Domain", "DomainParticipant"}
_SERVERS = re.compile(r"(TCP|UDP|HTTP)Server$")
_CALLED = re.compile(rf"\b({'|'.join(_OPENING)}|\w*(TCP|UDP|HTTP)Server)\b")
# where something listens, each tested above
_KNOWN = {
    "dexkit/dds/domain.py": {"Domain"},
    "dexkit/dds/node.py": {"DomainParticipant"},
    "dexkit/domains.py": {"bind"},  # reserves a port of DDS and reads nothing from it
    "dexkit/doctor/dds.py": {"bind"},
    "dexkit/doctor/link.py": {"bind"},  # echoes and refused connections, from one address
    "dexkit/tcp_listener.py": {"bind", "listen"},
    # its own port is of the listener; the addresses tried are for the server behind it
    "dexkit/view/guarded_server.py": {"bind", "listen", "start_server"},
    "dexkit/view/foxglove_viewer.py": {"start_server"},  # behind that port, as viser's
    "emulators/dex3_mcu/server.py": {"listen"},
    "emulators/lerobot/ports.py": {"bind", "listen"},  # the library takes the listener's socket
    "emulators/tcp_port.py": {"listen"},
    "tools/campaign/fuzz/drivers.py": {"listen"},
    "tools/lab/control.py": {"listen"},
}


def _own(called: ast.expr) -> bool:
    """Whether it is ``self.listen``, as a phase of the kit is called, and no socket's."""
    return isinstance(called, ast.Attribute) and ast.unparse(called.value) == "self"


def test_every_listening_socket_in_the_code_is_listed() -> None:
    """Something new that listens belongs into this file, with a filter or an address."""
    found: dict[str, set[str]] = {}
    for folder in ("dexkit", "drivers", "emulators", "conformance", "traces", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = str(path.relative_to(ROOT))
            if path.parts[len(ROOT.parts) + 1] in ("drivers", "emulators", "conformance", "traces"):
                continue  # the links of the package
            text = path.read_text()
            if not _CALLED.search(text):  # parsing every file takes seconds
                continue
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.Call) and not _own(node.func):
                    called = getattr(node.func, "attr", getattr(node.func, "id", ""))
                    if called in _OPENING or _SERVERS.search(called):
                        found.setdefault(name, set()).add(called)
    assert found == _KNOWN
