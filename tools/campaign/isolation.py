"""Namespaces of the campaign's own, so that it does not affect other programs on the machine.

Network: ports, DDS domains. Mounts: small file systems that fill up. Processes: whatever happens,
the kernel ends every process of the campaign with its first one. As root, or where users may make
namespaces; elsewhere the campaign runs without and reports it.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import signal
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass

__all__ = ["Isolation", "die_with_parent", "inside", "new_network", "subreaper"]

_NEWNS, _NEWUSER, _NEWPID, _NEWNET = 0x00020000, 0x10000000, 0x20000000, 0x40000000
_MS_REC_PRIVATE, _MS_BIND = 0x4000 | 0x40000, 0x1000
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1

_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Isolation:
    """The namespaces that the campaign has."""

    network: bool
    mounts: bool
    processes: bool
    why: str = ""

    def __str__(self) -> str:
        names = ("network", "mounts", "processes")
        own = [name for name in names if getattr(self, name)]
        if len(own) == 3:
            return "namespaces of its own: network, mounts, processes"
        have = f"namespaces of its own: {', '.join(own) or 'none'}"
        return f"{have} ({self.why}); DDS domains of its own from 20 up"


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """Have this process signalled when its parent dies. For use between fork and exec, too."""
    _libc.prctl(_PR_SET_PDEATHSIG, int(number), 0, 0, 0)


def subreaper() -> None:
    """Become the parent of orphans among this process's descendants."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def new_network() -> bool:
    """A network of this process's own with loopback up, and pseudo-terminals of its own; False
    where that is not permitted.
    """
    if _libc.unshare(_NEWNET | _NEWNS):
        return False
    _loopback_up()
    _libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None)
    if not _libc.mount(b"devpts", b"/dev/pts", b"devpts", 0, b"newinstance,ptmxmode=0666"):
        _libc.mount(b"/dev/pts/ptmx", b"/dev/ptmx", None, _MS_BIND, None)
    return True


def inside(run: Callable[[Isolation], int]) -> int:
    """Call ``run`` in new namespaces as far as they can be made; its exit code.

    SIGINT and SIGTERM of the calling process are passed on.
    """
    uid, gid = os.geteuid(), os.getegid()
    flags = _NEWNET | _NEWNS | _NEWPID | (_NEWUSER if uid else 0)
    if _try(flags):
        return run(Isolation(False, False, False, os.strerror(ctypes.get_errno())))
    if uid:
        _map_user(uid, gid)
    gate, opened = os.pipe()
    child = os.fork()
    if child == 0:
        die_with_parent()
        os.close(opened)
        os.read(gate, 1)  # the parent may have died before the line above
        os.close(gate)
        os.setpgid(0, 0)  # Ctrl-C comes from the parent, once
        code = 70
        try:
            _loopback_up()
            _libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None)
            # scratch folders that go with the namespace, however it ends
            _libc.mount(b"tmpfs", b"/dev/shm", b"tmpfs", 0, b"mode=1777")
            # dexkit and the campaign read /proc, which must show the new process numbers
            own = _libc.mount(b"proc", b"/proc", b"proc", 0, None) == 0
            code = run(Isolation(True, True, own, "" if own else "no /proc of its own"))
        except SystemExit as leave:
            code = leave.code if isinstance(leave.code, int) else 70
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            with contextlib.suppress(OSError):
                os.write(2, b"")
            os._exit(code)
    os.close(gate)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN or number == signal.SIGINT:
            signal.signal(number, lambda n, _: _signal(child, n))
    os.write(opened, b"x")
    os.close(opened)
    while True:
        with contextlib.suppress(InterruptedError):
            _, status = os.waitpid(child, 0)
            return os.waitstatus_to_exitcode(status)


def _try(flags: int) -> bool:
    """Whether making the namespaces fails; tried in a child first, for it cannot be undone."""
    probe = os.fork()
    if probe == 0:
        failed = _libc.unshare(flags) != 0
        os._exit(ctypes.get_errno() if failed else 0)
    _, status = os.waitpid(probe, 0)
    if code := os.waitstatus_to_exitcode(status):
        ctypes.set_errno(code)
        return True
    return bool(_libc.unshare(flags))


def _signal(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)


def _map_user(uid: int, gid: int) -> None:
    for name, text in (("setgroups", "deny"), ("uid_map", f"0 {uid} 1"), ("gid_map", f"0 {gid} 1")):
        with open(f"/proc/self/{name}", "w") as file:
            file.write(text)


def _loopback_up() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        request = struct.pack("16sH14x", b"lo", 0)
        found = fcntl.ioctl(sock, _SIOCGIFFLAGS, request)
        (flags,) = struct.unpack_from("H", found, 16)
        fcntl.ioctl(sock, _SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", flags | _IFF_UP))
