"""A cable that delays and loses: frames between two interfaces of a namespace, in user space.

``tc netem`` is a module that many kernels lack, so a host in the middle forwards frames itself:

    client --- (port0) middle (port1) --- hand

    python -m tests.impaired_link port0 port1 --delay 0.05 --loss 0.02 [--no-multicast]

It prints ``ready`` and runs until its standard input ends. Delay is one-way, in seconds; a frame is
lost with the probability ``--loss`` in each direction; ``--no-multicast`` drops IPv4 multicast, as
many access points and VPNs do.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import fcntl
import heapq
import random
import select
import socket
import struct
import sys
import time

_ETH_P_ALL, _ETH_P_IP = 3, 0x0800
_OUTGOING = 4  # PACKET_OUTGOING
_SIOCETHTOOL, _ETHTOOL_STXCSUM = 0x8946, 0x17

__all__ = ["compute_checksums"]


def compute_checksums(interface: str) -> None:
    """Let the sender compute checksums: on a veth they stay empty, and forwarded ones are wrong."""
    memory = ctypes.create_string_buffer(struct.pack("II", _ETHTOOL_STXCSUM, 0))  # ethtool_value
    packed = struct.pack("16sP", interface.encode(), ctypes.addressof(memory)).ljust(40, b"\0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        fcntl.ioctl(handle.fileno(), _SIOCETHTOOL, packed)


def _open(interface: str) -> socket.socket:
    found = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
    found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
    found.bind((interface, 0))
    # promiscuous: frames are for the other side
    index = socket.if_nametoindex(interface)
    found.setsockopt(263, 1, struct.pack("iHH8s", index, 1, 0, b""))
    found.setblocking(False)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ports", nargs="*")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--no-multicast", action="store_true")
    parser.add_argument("--checksums", metavar="IF", help="only set an interface of a host up")
    options = parser.parse_args()
    if options.checksums:
        compute_checksums(options.checksums)
        return
    ends = [_open(port) for port in options.ports]
    other = {ends[0].fileno(): ends[1], ends[1].fileno(): ends[0]}
    dice = random.Random(1)
    waiting: list[tuple[float, int, int, bytes]] = []
    count = 0
    print("ready", flush=True)
    while True:
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, to, frame = heapq.heappop(waiting)
            with contextlib.suppress(OSError):  # a cable that is unplugged
                other[to].send(frame)
        patience = max(waiting[0][0] - now, 0.0) if waiting else None
        readable, _, _ = select.select([*ends, sys.stdin], [], [], patience)
        if sys.stdin in readable and not sys.stdin.read(1):
            return
        for end in (e for e in ends if e in readable):
            for _ in range(256):
                try:
                    frame, where = end.recvfrom(65536)
                except OSError:
                    break
                ip = frame[12:14] == _ETH_P_IP.to_bytes(2, "big")
                if where[2] == _OUTGOING or (
                    ip and (dice.random() < options.loss or (options.no_multicast and frame[0] & 1))
                ):
                    continue
                count += 1
                heapq.heappush(
                    waiting, (time.monotonic() + options.delay, count, end.fileno(), frame)
                )


if __name__ == "__main__":
    main()
