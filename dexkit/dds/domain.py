"""The domains of this process: configured on one interface, shared by its nodes."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import tempfile
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dexkit import interface_filter
from dexkit.dds.cyclone import INFINITY, OK, library
from dexkit.dds_socket_filter import DomainSockets, open_sockets
from dexkit.errors import DdsSetupError
from dexkit.escaping import html
from dexkit.interface_names import named_peers

__all__ = [
    "FILES",
    "MAX_PARTICIPANT_INDEX",
    "acquire_domain",
    "config",
    "domains",
    "domains_lock",
    "interfaces",
    "release_domain",
]

_log = logging.getLogger("dexkit.dds")

_PRECONDITION_NOT_MET = -4
MAX_PARTICIPANT_INDEX = 60
"""Processes on one machine and domain; each is probed at start-up."""


def interfaces() -> list[str]:
    """Names of this machine's network interfaces."""
    return [name for _, name in socket.if_nameindex()]


def _trace(verbosity: str, path: str) -> str:
    return (
        f"<Tracing><Verbosity>{verbosity}</Verbosity><AppendToFile>true</AppendToFile>"
        f"<OutputFile>{html(path)}</OutputFile></Tracing>"
    )


# until the filter is there; dds_domain_set_deafmute() ends it
_DEAF = "<Internal><ControlTopic><Deaf>true</Deaf></ControlTopic></Internal>"


def config(interface: str, more: str = "", peers: Sequence[str] = ()) -> str:
    """CycloneDDS configuration of a domain (docs/sources/unitree-dex.md#a6).

    On loopback peers are called on 127.0.0.1 by port, since multicast may be off there;
    ``multicast="default"`` keeps listening to it where it is on, because an SDK process then
    listens to nothing else. With named peers only discovery uses multicast: what does not carry
    multicast would lose the samples of two readers.

    On a network participants are announced twice a second instead of every 8 s: after a link was
    down for more than the lease (10 s), both sides have forgotten each other, and the first
    announcement ends that.
    """
    loopback = interface_filter.is_loopback(interface)
    called = ("127.0.0.1",) if loopback else tuple(peers)
    listed = "".join(f'<Peer address="{peer}"/>' for peer in called)
    announce = "" if loopback else "<SPDPInterval>500ms</SPDPInterval>"
    unicast = "<AllowMulticast>spdp</AllowMulticast>" if peers and not loopback else ""
    return (
        "<CycloneDDS><Domain>"
        "<General><Interfaces>"
        f'<NetworkInterface name="{html(interface)}" priority="default" multicast="default"/>'
        f"</Interfaces>{unicast}</General>"
        "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
        f"<MaxAutoParticipantIndex>{MAX_PARTICIPANT_INDEX}</MaxAutoParticipantIndex>"
        + (f"<Peers>{listed}</Peers>" if listed else "")
        + f"{announce}</Discovery>{more}"
        "</Domain></CycloneDDS>"
    )


@dataclass
class _Domain:
    """A domain of this process; its configuration is that of the first node."""

    interface: str
    entity: Any  # None when other code in this process configured the domain
    nodes: int = 0
    sockets: DomainSockets | None = None  # None when nothing is kept out


domains: dict[int, _Domain] = {}
FILES = 16  # descriptors of a participant; short of them, CycloneDDS dies
domains_lock = threading.Lock()
# CycloneDDS describes a type when its first topic is made, and not for two threads at once
types_lock = threading.RLock()


def acquire_domain(number: int, interface: str) -> None:
    """Configure the domain, or use it if it is configured already. Needs ``domains_lock``."""
    cyclone = library()
    known = domains.get(number)
    if known is not None:
        if known.interface != interface and known.entity is not None:
            raise DdsSetupError(
                f"domain {number} of this process is on {known.interface}, not {interface}",
                hint="a process has one interface per domain: use another domain or process",
            )
        known.nodes += 1
        return
    peers = named_peers()
    path = os.environ.get("DEXKIT_DDS_LOG")
    tracing = _trace("config", path) if path else ""
    before = open_sockets()
    sockets = None
    try:
        entity = cyclone.domain.Domain(number, config(interface, _DEAF + tracing, peers))
    except cyclone.error as error:
        if error.code != _PRECONDITION_NOT_MET:
            raise DdsSetupError(
                f"domain {number} cannot be set up on {interface}: "
                f"{_setup_error_text(number, interface) or error}",
                hint=f"this machine has: {', '.join(interfaces())}; at most "
                f"{MAX_PARTICIPANT_INDEX} processes share a domain",
            ) from error
        _log.warning(
            "domain %d was configured by other code in this process; its interface is used, not "
            "%s, and any machine on any network of this one can take part",
            number,
            interface,
        )
        entity = None
    else:
        try:
            sockets = _filter_interfaces(number, interface, before)
            code = cyclone.dds_domain_set_deafmute(entity._ref, False, False, INFINITY)
            if code != OK:
                raise DdsSetupError(f"domain {number} cannot receive (CycloneDDS error {code})")
        except BaseException:
            cyclone.delete(entity)
            raise
    domains[number] = _Domain(interface, entity, 1, sockets)


def _filter_interfaces(number: int, interface: str, before: dict[int, int]) -> DomainSockets | None:
    """Accept only packets that arrive on ``interface``; call it while the domain receives nothing.

    :returns: None when the user allows all interfaces.
    :raises DdsSetupError: the system has no such filter.
    """
    try:
        return DomainSockets(number, interface, before)
    except OSError as error:
        if interface_filter.all_interfaces_allowed():
            _log.warning(
                "domain %d is open to every network of this machine, not only to %s (%s=1)",
                number,
                interface,
                interface_filter.ALL_INTERFACES,
            )
            return None
        raise DdsSetupError(
            f"packets of networks other than {interface} cannot be kept out of domain {number}: "
            f"{error.strerror or error}",
            hint=interface_filter.HINT,
        ) from error


def _setup_error_text(number: int, interface: str) -> str:
    """Try once more, with CycloneDDS's warnings going to a file, and return them."""
    cyclone = library()
    with tempfile.TemporaryDirectory(prefix="dexkit-") as folder:
        path = Path(folder) / "dds.log"
        try:
            text = config(interface, _DEAF + _trace("warning", str(path)))
            cyclone.delete(cyclone.domain.Domain(number, text))
        except cyclone.error:
            pass
        text = path.read_text(errors="replace") if path.exists() else ""
    # "1795254363.143174 [151]     python: message"
    return "; ".join(line.split(": ", 1)[-1] for line in text.splitlines() if line.strip())


def release_domain(number: int) -> None:
    """Drop one use; delete the domain after the last. Needs ``domains_lock``."""
    domain = domains[number]
    domain.nodes -= 1
    if domain.nodes:
        return
    cyclone = library()
    if domain.entity is not None and cyclone.dds_lookup_participant(number, None, 0) > 0:
        return  # other code made participants on it: they would vanish with the domain
    del domains[number]
    if domain.entity is not None:
        with domain.sockets.ending() if domain.sockets else contextlib.nullcontext():
            cyclone.delete(domain.entity)
