"""TCP sockets that listen: the one place where dexkit's own servers get theirs.

A port on a loopback address is for processes of this machine. The kernel lets networks reach it all
the same where it is told to (``net.ipv4.conf.*.route_localnet=1``), so it has a filter
(:mod:`dexkit.interface_filter`).
"""

from __future__ import annotations

import ipaddress
import logging
import socket

from dexkit import interface_filter

__all__ = ["listen"]

_log = logging.getLogger(__name__)


def listen(host: str, port: int, backlog: int = 100) -> socket.socket:
    """A socket that listens at an address of this machine, IPv6 if there is a colon in it.

    On a loopback address it accepts from this machine only; where the system has no filter for
    that, a warning is logged.

    :param port: 0 for any.
    :raises OSError: the address cannot be had.
    :raises ValueError: no host has such a name.
    """
    version6 = ":" in host
    listener = socket.socket(socket.AF_INET6 if version6 else socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if version6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind((host, port))
        if ipaddress.ip_address(listener.getsockname()[0]).is_loopback:
            _keep_networks_out(listener)
        listener.listen(backlog)
    except BaseException:
        listener.close()
        raise
    return listener


def _keep_networks_out(listener: socket.socket) -> None:
    try:
        interface_filter.restrict(listener, "lo")
    except OSError as error:
        # without this option the loopback address keeps them out, unless route_localnet is set
        _log.warning("packets from networks are not kept from 127.0.0.1: %s", error.strerror)
