"""Namespaces of the campaign's own, so that it does not affect other programs on the machine.

Network: ports, DDS domains. Mounts: pseudo-terminals, and scratch folders that go with the
campaign. As root, or where users may make namespaces; elsewhere the campaign runs without
and reports it.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import signal
import socket
import struct

__all__ = ["die_with_parent", "new_network", "own_namespaces", "subreaper"]

_NEWNS, _NEWUSER, _NEWNET = 0x00020000, 0x10000000, 0x40000000
_MS_REC_PRIVATE, _MS_BIND = 0x4000 | 0x40000, 0x1000
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_SIOCGIFFLAGS, _SIOCSIFFLAGS, _IFF_UP = 0x8913, 0x8914, 1

_libc = ctypes.CDLL(None, use_errno=True)


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


def own_namespaces() -> str:
    """Put this process into a network and mounts of its own; why not, or an empty string."""
    uid, gid = os.geteuid(), os.getegid()
    if _libc.unshare(_NEWNET | _NEWNS | (_NEWUSER if uid else 0)):
        return os.strerror(ctypes.get_errno())
    if uid:
        _map_user(uid, gid)
    _loopback_up()
    _libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None)
    _libc.mount(b"tmpfs", b"/dev/shm", b"tmpfs", 0, b"mode=1777")
    return ""


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
