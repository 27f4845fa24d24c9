"""Machines on a network, each a network namespace of this one; nothing of this machine changes.

    with network(Link("robot", "net0", "10.9.0.1", "friend", "port0", "10.9.0.2")) as hosts:
        hosts["robot"].run("ping", "-c1", "10.9.0.2")

It works for root, and for others where user namespaces are permitted. :func:`unavailable` gives the
reason not; a test module does ``pytest.skip(why, allow_module_level=True)`` then.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

__all__ = ["Host", "Link", "network", "unavailable"]

ROOT = Path(__file__).parent.parent
_HOLD = "ip link set lo up && echo up && exec cat"  # ends with its input


@dataclass(frozen=True)
class Link:
    """A cable between two hosts: host, interface and address of either end; networks are /24."""

    a: str
    a_interface: str
    a_address: str
    b: str
    b_interface: str
    b_address: str


class Host:
    """One network namespace."""

    def __init__(self, name: str, enter: list[str], pid: int) -> None:
        self.name = name
        self.pid = pid
        self.enter = enter
        """Put before a command, it runs on this host."""

    def popen(self, *command: object, **options: Any) -> subprocess.Popen[str]:
        """Start a command on this host."""
        options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
        return subprocess.Popen([*self.enter, *map(str, command)], text=True, cwd=ROOT, **options)

    def run(self, *command: object, timeout: float = 120.0, check: bool = True) -> str:
        """Run a command on this host to its end, and return what it printed.

        :param check: it must end with 0.
        """
        done = subprocess.run(
            [*self.enter, *map(str, command)],
            capture_output=True,
            text=True,
            cwd=ROOT,
            timeout=timeout,
            check=False,
        )
        assert not check or done.returncode == 0, (
            f"{self.name}: {command}: {done.stderr}{done.stdout}"
        )
        return done.stdout

    def sh(self, script: str) -> str:
        """Run a shell script on this host."""
        return self.run("sh", "-ec", script)


@cache
def _unshare() -> tuple[str, ...]:
    """How to make namespaces here; empty if it cannot be done."""
    probe = ("--net", "sh", "-c", "ip link set lo up && ip link add name va type veth peer name vb")
    if all(map(shutil.which, ("unshare", "nsenter", "ip"))):
        for command in (("unshare", "--user", "--map-root-user"), ("unshare",)):
            done = subprocess.run([*command, *probe], capture_output=True, check=False)
            if done.returncode == 0:
                return command
    return ()


def unavailable() -> str:
    """Why networks cannot be made here, or an empty string."""
    if _unshare():
        return ""
    return (
        "network namespaces with veth pairs cannot be made here: this needs the programs unshare, "
        "nsenter and ip, and root or unprivileged user namespaces (see the sysctls "
        "kernel.unprivileged_userns_clone and kernel.apparmor_restrict_unprivileged_userns)"
    )


def _hold(stack: ExitStack, command: list[str]) -> int:
    process = subprocess.Popen(
        [*command, "--net", "sh", "-c", _HOLD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None

    def end() -> None:
        process.communicate()

    stack.callback(end)
    assert process.stdout.readline() == "up\n"
    return process.pid


@contextmanager
def network(*links: Link) -> Iterator[dict[str, Host]]:
    """Hosts by name, joined by these links, for as long as the context lasts."""
    unshare = list(_unshare())
    with ExitStack() as stack:
        hosts: dict[str, Host] = {}
        enter_user: list[str] = []
        for name in dict.fromkeys(name for link in links for name in (link.a, link.b)):
            pid = _hold(stack, [*enter_user, *unshare] if not hosts else [*enter_user, "unshare"])
            user = ["--user", "--preserve-credentials"] if "--user" in unshare else []
            if not hosts and user:
                # all in one user namespace, so that interfaces can be moved between them
                enter_user = ["nsenter", "--target", str(pid), *user]
            enter = ["nsenter", "--target", str(pid), *user, "--net"]
            hosts[name] = Host(name, enter, pid)
        for link in links:
            connect(hosts, link)
        yield hosts


def connect(hosts: dict[str, Host], link: Link) -> None:
    """Plug a cable in, or in again."""
    a, b = hosts[link.a], hosts[link.b]
    a.sh(
        f"ip link add name {link.a_interface} type veth "
        f"peer name {link.b_interface} netns {b.pid}\n"
        f"ip address add {link.a_address}/24 dev {link.a_interface}\n"
        f"ip link set {link.a_interface} up"
    )
    b.sh(
        f"ip address add {link.b_address}/24 dev {link.b_interface}\n"
        f"ip link set {link.b_interface} up"
    )
