"""DDS: one participant on a chosen domain and interface, raw readers and writers, discovery.

The only package that touches CycloneDDS, which is imported when the first :class:`DdsNode` is made.

    with DdsNode(domain=1) as node:
        states = node.writer("rt/dex1/left/state", "unitree_go::msg::dds_::MotorStates_")
        commands = node.reader("rt/dex1/left/cmd", "unitree_go::msg::dds_::MotorCmds_")
        states.write(MotorStates_([MotorState_(q=2.7)]))
        if commands.wait(timeout=1.0):
            for sample in commands.take():
                print(sample.source_timestamp_ns, sample.message)

Samples are bytes, encapsulation header included; :mod:`dexkit.messages` gives them meaning.

Threads: each node has one dispatcher thread that sleeps in a CycloneDDS waitset. CycloneDDS
never calls into Python (listeners that do can deadlock on the interpreter lock), so ``on_data``
and discovery callbacks run in the dispatcher. They must only note that something happened.

What peers announce is not believed: the built-in topics are read through ctypes, as bytes,
because CycloneDDS's Python raises at text that is not UTF-8, and then loses what other peers
announced together with it.

On loopback a node finds every other process of the machine, whether or not ``lo`` carries the
MULTICAST flag, without changing the system (docs/sources/unitree-dex.md#a6).

A node sees only what comes in by its interface or from this machine
(:mod:`dexkit.interface_filter`). CycloneDDS by itself would listen to every interface of the
machine. Where the system has no filter for that, a node is refused, unless
``DEXKIT_ALL_INTERFACES=1`` allows it.

``DEXKIT_PEERS=HOST,...`` names other machines that are called by unicast, for networks
without multicast. Samples then go by unicast only.

``DEXKIT_DDS_LOG=PATH`` appends CycloneDDS's own log to a file; otherwise its warnings only become
part of a :class:`~dexkit.errors.DdsSetupError`.
"""

from __future__ import annotations

from dexkit.dds.cyclone import cyclone_type, type_hash
from dexkit.dds.domain import interfaces
from dexkit.dds.node import DdsNode, Discovery, Reader, Writer
from dexkit.dds.records import DiscoveryEvent, Endpoint, Participant, Qos, Sample

__all__ = [
    "DdsNode",
    "Discovery",
    "DiscoveryEvent",
    "Endpoint",
    "Participant",
    "Qos",
    "Reader",
    "Sample",
    "Writer",
    "cyclone_type",
    "interfaces",
    "type_hash",
]
