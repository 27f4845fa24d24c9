"""Reserve a DDS domain on this machine, so that two runs that start at once do not share one.

Discovery alone is not enough: two programs that search at the same time both find the domain empty.
So a domain is reserved by binding a UDP port of it that DDS never uses. The kernel gives the port
to one process of the machine (of the network namespace) and takes it back when the process ends.
"""

from __future__ import annotations

import random
import socket

from dexkit.errors import DexkitError

__all__ = ["AUTOMATIC_DOMAINS", "ReservedDomain", "reserve_free_domain"]

AUTOMATIC_DOMAINS = range(100, 231)
"""Range of domains to choose from when none is given: the highest with all their ports."""

_PORT = 248  # discovery of the last participant, 119 (RTPS 9.6.1.1); dexkit uses 0 to 60


class ReservedDomain:
    """One domain, kept from other runs of this machine until it is closed.

    Programs with a given domain do not reserve it.

    :ivar domain: its number.
    :raises OSError: another process has it.
    """

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", 7400 + 250 * domain + _PORT))
        except OSError:
            self._socket.close()
            raise

    def close(self) -> None:
        """Release it. Idempotent."""
        self._socket.close()

    def __enter__(self) -> ReservedDomain:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def reserve_free_domain(interface: str = "lo") -> ReservedDomain:
    """Reserve a domain of :data:`AUTOMATIC_DOMAINS` on which no participant is discovered.

    :raises DexkitError: there is none.
    :raises DdsError: DDS cannot be used here.
    """
    from dexkit.dds import DdsNode

    for domain in random.sample(AUTOMATIC_DOMAINS, len(AUTOMATIC_DOMAINS)):
        try:
            reserved = ReservedDomain(domain)
        except OSError:
            continue
        try:
            with DdsNode(domain=domain, interface=interface) as node:
                if not node.discovery.wait(
                    lambda endpoints: any(not e.own for e in endpoints), timeout=0.15
                ):
                    return reserved
        except BaseException:
            reserved.close()
            raise
        reserved.close()
    raise DexkitError(
        f"no DDS domain from {AUTOMATIC_DOMAINS[0]} to {AUTOMATIC_DOMAINS[-1]} is free",
        hint="give one: --domain",
    )
