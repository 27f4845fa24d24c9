"""Hands on a real network: interfaces by address, peers without multicast, links that go and come.

Client and hand are two hosts (network namespaces) with a third one between them that forwards,
delays and loses frames (:mod:`tests.impaired_link`).
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.dds.domain import config
from dexkit.errors import DdsSetupError
from dexkit.interface_names import (
    PEERS,
    find_interface,
    interface_towards,
    named_peers,
    resolve_peers,
    wait_for_interface,
)
from dexkit.traces import open_trace
from tests.each import each
from tests.namespaces import Host, Link, network, unavailable
from tests.test_lan import Program

_MEASUREMENTS = 10
"""Of a link, of which each can fall into a moment when other programs use the processors."""
HAND, CLIENT = "10.9.5.1", "10.9.5.2"
_LINKS = (
    Link("hand", "net0", HAND, "middle", "port0", "10.9.6.1"),
    Link("client", "net1", CLIENT, "middle", "port1", "10.9.6.2"),
)


@contextmanager
def _networked(*impairments: object) -> Iterator[dict[str, Host]]:
    """Client and hand in one network, on a link with these impairments."""
    if why := unavailable():
        pytest.skip(why)
    with network(*_LINKS) as hosts:
        for name, interface in (("hand", "net0"), ("client", "net1")):
            hosts[name].run(sys.executable, "-m", "tests.impaired_link", "--checksums", interface)
        link = hosts["middle"].popen(
            *(sys.executable, "-m", "tests.impaired_link", "port0", "port1", *impairments), stdin=-1
        )
        try:
            assert link.stdout is not None
            assert link.stdout.readline() == "ready\n", link.communicate()
            yield hosts
        finally:
            link.communicate()


# -- names


def test_interface_is_found_by_name_address_and_prefix() -> None:
    for text in ("lo", "127.0.0.1", "127.0.0.0/8", "127.0.0.", "127.", "127.0.0"):
        assert find_interface(text) == "lo"
    assert interface_towards("127.0.0.1") == "lo"
    assert resolve_peers(["127.0.0.1", "localhost"]) == ("127.0.0.1",)


def test_participants_are_announced_twice_a_second_on_a_network() -> None:
    """After a link was down for longer than the lease, the first announcement ends that."""
    assert "<SPDPInterval>500ms</SPDPInterval>" in config("net0")
    assert "SPDPInterval" not in config("lo")


def test_waiting_for_an_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    said: list[str] = []

    def sleep(seconds: float) -> None:
        clock[0] += seconds
        if clock[0] > 3:
            monkeypatch.setattr("dexkit.interface_names._names", lambda: ["lo", "lo2"])
            monkeypatch.setattr("dexkit.interface_names.is_loopback", lambda name: True)
            monkeypatch.setattr("dexkit.interface_names.interface_flags", lambda name: 1)

    def wait(seconds: float) -> str:
        return wait_for_interface(
            "lo2", seconds, waiting=said.append, sleep=sleep, now=lambda: clock[0]
        )

    with pytest.raises(DdsSetupError, match="lo2"):
        wait(2.0)
    assert wait(5.0) == "lo2"
    assert said == ["there is no network interface 'lo2'"] * 2
    assert wait(0.0) == "lo2"


def test_interface_is_that_by_which_the_first_peer_is_reached(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv(PEERS, "127.0.0.1, localhost")
    assert named_peers() == ("127.0.0.1",)
    words = ("record", str(tmp_path / "x.mcap"))
    seen: list[str] = []
    monkeypatch.setattr("dexkit.dds.DdsNode", lambda **options: 1 / 0)
    monkeypatch.setattr(
        "dexkit.interface_names.interface_towards", lambda peer: seen.append(peer) or "lo"
    )
    done = CliRunner().invoke(cli, words, standalone_mode=False)
    assert isinstance(done.exception, ZeroDivisionError)
    assert seen == ["127.0.0.1"]
    monkeypatch.setenv(PEERS, "no such host")
    done = CliRunner().invoke(cli, words, standalone_mode=False)
    assert isinstance(done.exception, DdsSetupError)


@each(
    "words",
    [
        ("serve", "sim-dex1"),
        ("record", "x.mcap"),
        ("replay", "traces/samples/dex1_pick_place.mcap"),
        ("doctor", "--scan", "5"),
    ],
)
def test_commands_refuse_an_interface_that_is_not_there(words: tuple[str, ...]) -> None:
    more = ["--interface", "203.0.113.0/24"]
    if words[0] == "serve":
        more += ["--wait-for-interface", "0.1"]
    done = CliRunner().invoke(cli, [*words, *more], standalone_mode=False)
    assert isinstance(done.exception, DdsSetupError)
    assert "203.0.113.0/24" in str(done.exception)
    assert ("waiting for up to 0.1 s" in done.stderr) == (words[0] == "serve")


# -- networks

_COMMAND = """
import sys, time
from dexkit.dds import DdsNode
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_
domain, interface, q = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
began = time.monotonic()
with DdsNode(domain, interface) as node:
    writer = node.writer("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
    while True:
        target = min(q + 0.2 * (time.monotonic() - began), 5.0)  # a slow way
        writer.write(MotorCmds_([MotorCmd_(mode=1, q=target, kp=5.0, kd=0.05)]))
        time.sleep(0.005)
"""


@pytest.mark.soak
def test_peers_without_multicast_and_an_interface_that_comes_later() -> None:
    """The service is started before its network is up, and names it by prefix."""
    with _networked("--no-multicast") as hosts:
        hosts["hand"].sh("ip address delete 10.9.5.1/24 dev net0")
        service = Program(
            *(hosts["hand"], "serve", "sim-dex1", "--side", "left", "--domain", 7),
            *("--interface", "10.9.5.0/24", "--wait-for-interface", 100),
        )
        try:
            service.wait_line("waiting for up to 100 s: no network interface has an address")
            hosts["hand"].sh("ip address add 10.9.5.1/24 dev net0")
            assert "domain 7, net0" in service.wait_line("^ready")
            # DEXKIT_PEERS on one side is enough, and chooses the interface
            said = hosts["client"].run(
                *("env", f"DEXKIT_PEERS={HAND}", sys.executable, "-m", "dexkit"),
                *("doctor", "--domain", 7, "--scan", "none", "--seconds", 1),
                check=False,
            )
            assert "rt/dex1/left/state" in said
            assert "on lo, net1" in said
            env = ("env", f"DEXKIT_PEERS={HAND}", sys.executable, "-m", "tests.lan_client")
            moved = hosts["client"].run(
                *env, "--domain", 7, "--interface", CLIENT, "--q", 2.0, "--seconds", 100
            )
            assert moved.startswith("there: ")
        finally:
            assert service.end() == 0


@pytest.mark.soak
@pytest.mark.parametrize(
    ("impairments", "expected"),
    [
        ((), set()),
        (("--delay", 0.05, "--loss", 0.05), {"LINK-LOSS", "LINK-LATENCY"}),
        (("--no-multicast",), {"LINK-MULTICAST"}),
    ],
    ids=["good", "slow and lossy", "no multicast"],
)
def test_a_link_is_measured(impairments: tuple[object, ...], expected: set[str]) -> None:
    with _networked(*impairments) as hosts:
        service = Program(
            *(hosts["hand"], "serve", "sim-dex1", "--side", "left"),
            *("--domain", 7, "--interface", HAND),
        )
        try:
            service.wait_line("^ready")
            for _ in range(_MEASUREMENTS):
                said = hosts["client"].run(
                    *(sys.executable, "-m", "dexkit", "doctor", "--domain", 7, "--scan", "none"),
                    *("--ping", HAND, "--seconds", 5, "--json"),
                    check=False,
                )
                report = json.loads(said)
                link = report["observations"]["link"]
                print("\n", impairments, link)
                found = {f["id"] for f in report["findings"] if f["id"].startswith("LINK-")}
                assert expected <= found
                # the buffer is this machine's; others on it delay, and a late reader loses
                found -= {"LINK-BUFFER"}
                assert found <= expected | {"LINK-LATENCY", "LINK-JITTER", "LINK-AGE", "LINK-LOSS"}
                if found == expected:
                    break
        finally:
            assert service.end() == 0
    assert found == expected, "it is not a busy moment each time"
    assert (link["multicast"] is False) == ("--no-multicast" in impairments)
    assert link["participants"] == 1
    assert link["samples"] > 0
    if "--delay" in impairments:
        assert 0.1 < link["rtt_min"] <= link["rtt_median"] <= link["rtt_95"]
        assert link["state_age_95"] > 0.05


@pytest.mark.soak
def test_50_ms_and_2_percent_loss(tmp_path: Path) -> None:
    """A hand follows and its states are recorded, with what is missing."""
    with _networked("--delay", 0.05, "--loss", 0.02) as hosts:
        service = Program(
            *(hosts["hand"], "serve", "sim-dex1", "--side", "left"),
            *("--domain", 7, "--interface", HAND),
        )
        try:
            service.wait_line("^ready")
            out = tmp_path / "a.mcap"
            recorder = Program(
                *(hosts["client"], "record", out, "--domain", 7),
                *("--interface", "net1", "--duration", 12),
            )
            moved = hosts["client"].run(
                *(sys.executable, "-m", "tests.lan_client", "--domain", 7),
                *("--interface", "net1", "--q", 2.0, "--seconds", 100),
            )
            assert moved.startswith("there: ")
            summary = recorder.wait_line("messages \\(.*missing")
            recorder.process.wait(60)
        finally:
            assert service.end() == 0
    about = open_trace(out).metadata["dexkit_recorder"]
    missing = int(about["missing about"])
    offered = int(about["messages"])
    assert f"about {missing} missing" in summary
    assert missing / offered > 0.005, about
    if not _busy():  # a service that does not get the processor misses states, too
        assert missing / offered < 0.05, about


_WATCH = """
import sys, time
from dexkit.dds import DdsNode
with DdsNode(int(sys.argv[1]), sys.argv[2]) as node:
    states = node.reader("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_", depth=1000)
    print("ready", flush=True)
    while True:
        states.wait(0.02)
        time.sleep(0.02)
        for sample in states.take()[-1:]:
            print("q", time.monotonic(), sample.message.states[0].q, flush=True)
"""


def _busy() -> bool:
    """Whether others use the processors, so that times mean nothing."""
    return os.getloadavg()[0] > (os.cpu_count() or 1) + 1


def _newest(program: Program) -> tuple[float, float]:
    line = next(line for line in reversed(program.lines) if line.startswith("q "))
    _, at, q = line.split()
    return float(at), float(q)


def _until(predicate: Callable[[], bool], seconds: float = 200.0) -> None:
    end = time.monotonic() + seconds
    while not predicate():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.soak
@pytest.mark.parametrize("seconds", [2.0, 15.0], ids=["short", "longer than the lease"])
def test_link_that_goes_down_in_mid_motion(seconds: float) -> None:
    """State is back after the link, and nothing moves that nobody asked for.

    How soon is a matter of the announcements, also after the lease:
    :func:`test_participants_are_announced_twice_a_second_on_a_network`.
    """
    with _networked() as hosts:
        service = Program(
            *(hosts["hand"], "serve", "sim-dex1", "--side", "left"),
            *("--domain", 7, "--interface", HAND),
        )
        code = ("-c",)
        watch_hand = watch_client = client = None
        try:
            service.wait_line("^ready")
            # one beside the hand, which sees it all the time, and one across the link
            watch_hand = Program(hosts["hand"], _WATCH, 7, "net0", module=code)
            watch_client = Program(hosts["client"], _WATCH, 7, "net1", module=code)
            for watch in (watch_hand, watch_client):
                watch.wait_line("^q ", timeout=200.0)
            start = _newest(watch_hand)[1]
            client = Program(hosts["client"], _COMMAND, 7, "net1", start, module=code)
            _until(lambda: abs(_newest(watch_hand)[1] - start) > 0.3)
            hosts["middle"].sh("ip link set port0 down")
            client.process.kill()  # its last command is still in a queue, and must not move it
            client.process.wait()
            time.sleep(seconds / 2)
            stopped = _newest(watch_hand)[1]
            time.sleep(seconds / 2)
            assert abs(_newest(watch_hand)[1] - stopped) < 0.02
            assert start + 0.3 < stopped < 4.9, "it was stopped on its way"
            before = _newest(watch_client)[0]
            hosts["middle"].sh("ip link set port0 up")
            up = time.monotonic()
            _until(lambda: _newest(watch_client)[0] > max(before, up))
            back = _newest(watch_client)[0] - up
            print(f"\nlink down for {seconds:g} s: state back {back:.2f} s after the link")
            time.sleep(1.5)
            assert abs(_newest(watch_hand)[1] - stopped) < 0.02
        finally:
            for program in (client, watch_hand, watch_client):
                if program is not None and program.process.poll() is None:
                    program.process.kill()
                    program.process.wait()
            assert service.end() == 0
