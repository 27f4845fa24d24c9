"""Accept packets on a socket from one network interface only: a filter in the kernel.

CycloneDDS binds its UDP ports to all addresses whatever interface it is given, and even a port on
127.0.0.1 can be reached from a network where the kernel routes such packets (``route_localnet``).
So each socket gets a classic BPF program (SO_ATTACH_FILTER) that looks at one thing, the index of
the interface by which a packet came in, and drops the packet unless that is the chosen interface
or loopback. What a packet claims of its sender plays no part. It needs no privilege.

Loopback is always let in: packets to an address of this machine's own come in by it, whichever
interface has that address.

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        restrict(sock, "eth0")        # before bind: nothing gets in meanwhile
        sock.bind(("0.0.0.0", 7410))

Linux only; numbers are those of ``linux/filter.h``, ``linux/sockios.h`` and ``linux/if.h``.
"""

from __future__ import annotations

import array
import contextlib
import errno
import os
import socket
import struct
import sys
from collections.abc import Sequence

__all__ = [
    "ALL_INTERFACES",
    "HINT",
    "accept_only",
    "accepted_indices",
    "all_interfaces_allowed",
    "interface_address",
    "interface_addresses",
    "interface_flags",
    "is_loopback",
    "program",
    "restrict",
]

ALL_INTERFACES = "DEXKIT_ALL_INTERFACES"
"""Environment variable: ``1`` goes on where the system has no such filter, open to all networks."""

HINT = (
    "this needs Linux, and a sandbox that permits SO_ATTACH_FILTER. Where no other machine is on "
    f"any network of this machine, {ALL_INTERFACES}=1 goes on without"
)
"""Advice for systems without such a filter."""

_SO_ATTACH_FILTER = 26
_SO_GET_FILTER = 26
_INSTRUCTION = struct.Struct("=HBBI")  # sock_filter: code, jump if true, jump if false, operand
_LOAD_WORD, _JUMP_EQUAL, _RETURN = 0x20, 0x15, 0x06  # BPF_LD|W|ABS, BPF_JMP|JEQ|K, BPF_RET|K
_INCOMING_INDEX = 0xFFFFF008  # SKF_AD_OFF + SKF_AD_IFINDEX
_SENDER = 0xFFF0000C  # SKF_NET_OFF + the place of the sender's address in an IPv4 header
_WHOLE, _DROP = 0xFFFFFFFF, 0  # how many bytes of the packet are kept
_SIOCGIFADDR, _SIOCGIFFLAGS, _SIOCGIFCONF = 0x8915, 0x8913, 0x8912
_REQUEST = 16 + 24  # ifreq: name and a union of 24 bytes (64 bit)
_MOST_ADDRESSES = 4096
_IFF_LOOPBACK = 0x8


def all_interfaces_allowed() -> bool:
    """Whether the user allows to run without a filter."""
    return os.environ.get(ALL_INTERFACES) == "1"


def _ask(request: int, interface: str) -> bytes:
    """The result of an ioctl for an interface; empty when it fails."""
    if sys.platform != "linux":
        return b""
    import fcntl

    # not from /sys, which may be another network namespace's
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        packed = struct.pack("256s", interface.encode()[:15])
        return fcntl.ioctl(handle.fileno(), request, packed)
    return b""


def interface_flags(interface: str) -> int:
    """Flags of a network interface (IFF_*), or 0 when there is no such interface."""
    answer = _ask(_SIOCGIFFLAGS, interface)
    return int(struct.unpack_from("H", answer, 16)[0]) if answer else 0


def interface_address(interface: str) -> str:
    """The IPv4 address of a network interface, or an empty string."""
    answer = _ask(_SIOCGIFADDR, interface)
    return socket.inet_ntoa(answer[20:24]) if answer else ""


def interface_addresses(interface: str) -> set[str]:
    """All IPv4 addresses of a network interface, those with a label (``eth0:1``) as well."""
    if sys.platform != "linux":
        return set()
    import fcntl

    memory = array.array("B", bytes(_MOST_ADDRESSES * _REQUEST))
    # ifconf: length in bytes, pointer; the kernel puts in the length that it has filled
    request = bytearray(struct.pack("@iP", len(memory), memory.buffer_info()[0]))
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
            fcntl.ioctl(handle.fileno(), _SIOCGIFCONF, request)
    except OSError:
        return set()
    table = memory.tobytes()[: struct.unpack_from("@i", request)[0]]
    return {
        socket.inet_ntoa(table[at + 20 : at + 24])
        for at in range(0, len(table), _REQUEST)
        if table[at : at + 16].split(b"\0")[0].split(b":")[0] == interface.encode()
    }


def is_loopback(interface: str) -> bool:
    """Whether packets sent by this interface stay on this machine."""
    if sys.platform != "linux":
        return interface.startswith("lo")
    return bool(interface_flags(interface) & _IFF_LOOPBACK)


def accepted_indices(interface: str) -> tuple[int, ...]:
    """Indices of the interfaces that may reach a socket on ``interface``: it, and loopback.

    Loopback alone while ``interface`` is not there.
    """
    return tuple(
        index for index, name in socket.if_nameindex() if name == interface or is_loopback(name)
    )


def program(indices: Sequence[int], sender: str | None = None) -> bytes:
    """A filter that keeps packets that came in by one of these interfaces, and drops the others.

    :param sender: of those, keep the packets from this IPv4 address.
    """
    count = len(indices)
    lines = [(_LOAD_WORD, 0, 0, _INCOMING_INDEX)]
    # from line 1 + i to the last line
    lines += [(_JUMP_EQUAL, count - i, 0, index) for i, index in enumerate(indices)]
    lines += [(_RETURN, 0, 0, _DROP)]
    if sender is not None:
        wanted = int.from_bytes(socket.inet_aton(sender), "big")
        lines += [(_LOAD_WORD, 0, 0, _SENDER), (_JUMP_EQUAL, 1, 0, wanted), (_RETURN, 0, 0, _DROP)]
    lines += [(_RETURN, 0, 0, _WHOLE)]
    # never reached: qemu-user reads a program back into memory for four instructions, whoever asks.
    # The kernel refuses a longer one, where a short one overwrites the emulator's stack.
    lines += [(_RETURN, 0, 0, _DROP)] * (5 - len(lines))
    return b"".join(_INSTRUCTION.pack(*line) for line in lines)


def accept_only(sock: socket.socket, indices: Sequence[int], sender: str | None = None) -> None:
    """Accept packets only from interfaces with these indices, from now on.

    :param sender: and from this IPv4 address only.
    :raises OSError: the system has no such filter.
    """
    code = program(indices, sender)
    if sys.platform != "linux":
        raise OSError(errno.ENOPROTOOPT, "this system has no socket filters")
    memory = array.array("B", code)
    count = len(code) // _INSTRUCTION.size
    # sock_fprog: number of instructions, pointer to them
    packed = struct.pack("@HP", count, memory.buffer_info()[0])
    sock.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, packed)
    # A sandbox may accept what it does not do. The kernel copies the instructions and returns
    # their number as the length, so that many bytes are left of the copy.
    held = sock.getsockopt(socket.SOL_SOCKET, _SO_GET_FILTER, len(code))
    if held != code[:count]:
        raise OSError(errno.ENOPROTOOPT, "the system has not kept the socket's filter")


def restrict(sock: socket.socket, interface: str) -> None:
    """Accept packets only from ``interface`` and loopback, from now on.

    Connections that a listening socket accepts inherit it.

    :raises OSError: the system has no such filter.
    """
    accept_only(sock, accepted_indices(interface))
