"""Network interfaces of this machine, and its processes with DDS sockets."""

from __future__ import annotations

import contextlib
import re
import socket
from pathlib import Path

from dexkit.doctor.observations import DdsSocket, Interface
from dexkit.doctor.proc_files import command_line, open_sockets
from dexkit.interface_filter import interface_address, interface_flags
from dexkit.interface_names import find_interface

__all__ = ["address_of", "dds_sockets", "interfaces"]

_IFF_UP, _IFF_LOOPBACK, _IFF_MULTICAST = 0x1, 0x8, 0x1000
_GROUP = "0100FFEF"  # 239.255.0.1 as /proc/net/igmp writes it on little-endian machines


def address_of(interface: str) -> str:
    """The IPv4 address of an interface (:func:`dexkit.interface_names.find_interface`).

    :raises DdsSetupError: it is not there, or has none.
    """
    return interface_address(find_interface(interface))


def interfaces() -> tuple[Interface, ...]:
    """Network interfaces of this machine."""
    joined = _joined()
    found = []
    for _, name in socket.if_nameindex():
        flags, address = interface_flags(name), interface_address(name)
        found.append(
            Interface(
                name=name,
                up=bool(flags & _IFF_UP),
                loopback=bool(flags & _IFF_LOOPBACK),
                multicast=bool(flags & _IFF_MULTICAST),
                addresses=(address,) if address else (),
                discovery=name in joined,
            )
        )
    return tuple(found)


def _joined() -> set[str]:
    """Interfaces on which some process has joined the multicast group of discovery."""
    found: set[str] = set()
    name = ""
    with contextlib.suppress(OSError):
        for line in Path("/proc/net/igmp").read_text().splitlines()[1:]:
            if not line.startswith("\t"):
                name = line.split()[1].rstrip(":")
            elif line.split()[0] == _GROUP:
                found.add(name)
    return found


def dds_sockets(domains: list[int]) -> tuple[DdsSocket, ...]:
    """Processes of this machine that listen on the ports of a domain, one entry each.

    Only domains up to 99 are recognised: the ports of higher ones are also handed out to
    ordinary sockets.
    """
    try:
        lines = Path("/proc/net/udp").read_text().splitlines()[1:]
    except OSError:
        return ()
    ports = []
    for line in lines:
        fields = line.split()
        match = re.fullmatch(r"([0-9A-F]{8}):([0-9A-F]{4})", fields[1])
        if match is None:
            continue
        port = int(match[2], 16)
        domain, offset = divmod(port - 7400, 250)
        # discovery by multicast, or by unicast with an index
        if (
            0 <= domain < 100
            and domain in domains
            and (offset == 0 or (offset >= 10 and not offset % 2))
        ):
            ports.append((domain, port, fields[9]))
    if not ports:
        return ()
    owners = open_sockets()
    found: dict[tuple[int, int], set[int]] = {}
    for domain, port, inode in ports:
        found.setdefault((domain, owners.get(inode, 0)), set()).add(port)
    return tuple(
        DdsSocket(
            domain,
            min(found[domain, pid]),
            pid,
            command_line(pid) if pid else "",
            tuple(sorted(found[domain, pid])),
        )
        for domain, pid in sorted(found)
    )
