"""Discovery goes on after any announcement of a peer: in the node, the recorder, the doctor."""

from __future__ import annotations

import os
import random
import struct
from pathlib import Path

import pytest

from dexkit.dds import DdsNode, Participant
from dexkit.doctor.dds import _participant, observe_domains
from dexkit.doctor.rtps import ParticipantData
from dexkit.traces import Recorder, open_trace
from dexkit.traces.dds_recording import DdsRecording
from tests.dds_helpers import free_domain, wait_until
from tests.doctor_packets import CYCLONE_0_10_PUBLICATION
from tests.hostile_peer import HostilePeer, parameter, string
from tests.trace_helpers import CMD, CMD_TYPE, STATE, STATE_TYPE, state

NAME, PID, HOST = b"__ProcessName", b"__Pid", b"__Hostname"
_TYPE_INFORMATION = 0x75  # PID_TYPE_INFORMATION
SUPERSCRIPT = "\u00b2".encode()  # isdigit() is true of it, and int() raises

# what brought a recorder or a doctor down, each by itself
PROPERTIES = [
    [(NAME, b"robot \xff\xfe")],
    [(HOST, b"\xc3\x28")],
    [(PID, SUPERSCRIPT)],
    [(NAME, b"x"), (PID, b"9" * 5000)],
    [(b"\xff", b"\xff"), (NAME, b"\xed\xa0\x80"), (PID, b"-1")],
    [(NAME, b"\x1b[2J\x07"), (PID, b""), (HOST, b"")],
]
ENDPOINTS = [
    (b"rt/\xff\xfe/state", STATE_TYPE.encode()),
    (b"rt/dex1/left/state", b"unitree_go::msg::dds_::\xff"),
    # a topic that CycloneDDS does not let us make, of a type that we know
    (b"not a name!", STATE_TYPE.encode()),
    (b"", STATE_TYPE.encode()),
    (b"rt/" + b"x" * 300, STATE_TYPE.encode()),
]


def finds(node: DdsNode, topic: str) -> bool:
    """Whether ``node`` learns of a writer that another participant makes now."""
    with DdsNode(node.domain) as other:
        other.writer(topic, CMD_TYPE)
        return node.discovery.wait(
            lambda endpoints: any(e.topic == topic and not e.own for e in endpoints), timeout=10
        )


def test_a_node_survives_every_announcement_and_still_finds_others() -> None:
    domain = free_domain()
    hostile: set[Participant] = set()  # each, while its lease lasts
    with DdsNode(domain) as node:

        def announced() -> int:
            found = node.discovery.participants()
            hostile.update(p for p in found if p.pid != os.getpid())
            return len(hostile)

        def topics() -> set[str]:
            return {e.topic for e in node.endpoints()}

        for number, properties in enumerate(PROPERTIES):
            with HostilePeer(domain) as peer:
                peer.announce(properties)
                for topic, type_name in ENDPOINTS:
                    for writer in (True, False):
                        peer.endpoint(topic, type_name, writer=writer)
                assert finds(node, f"rt/after{number}"), properties
                # while the peer repeats what a busy machine has dropped
                wait_until(lambda wanted=number + 1: announced() == wanted)
                wait_until(lambda: {"not a name!", "rt/\ufffd\ufffd/state"} <= topics())
        assert {p.pid for p in hostile} == {0}
        assert any("\ufffd" in p.process for p in hostile)
        assert all(text.isprintable() for p in hostile for text in (p.process, p.host))
        assert node.discovery.unreadable == 0
        assert node.failure is None


def _random_policies(rng: random.Random) -> bytes:
    """Policies, user data and type information of random content, some of them valid.

    Type information keeps its form: CycloneDDS 0.10.5 itself aborts at an identifier of a kind
    that it does not expect (``ddsi_typeid_kind_impl``), which no code above it can prevent.
    """
    described = CYCLONE_0_10_PUBLICATION.index(struct.pack("<HH", _TYPE_INFORMATION, 0x94))
    information = bytearray(CYCLONE_0_10_PUBLICATION[described + 4 : described + 4 + 0x94])
    for kind in (0xF1, 0xF2):  # the hash of each identifier follows its kind
        at = information.index(kind)
        information[at + 1 : at + 15] = rng.randbytes(14)
    pid = rng.randrange(2, 0x4000)
    choices = [
        (0x1A, struct.pack("<IiI", rng.choice([0, 1, 2, 9]), 0, rng.getrandbits(32))),
        (0x1D, struct.pack("<I", rng.choice([0, 1, 2, 3, 7]))),
        (0x40, struct.pack("<Ii", rng.choice([0, 1, 5]), rng.choice([-1, 0, 1, 1 << 30]))),
        (0x2C, struct.pack("<I", 8) + rng.randbytes(8)),  # user data
        (0x29, struct.pack("<I", 2) + string(rng.randbytes(5).replace(b"\0", b"x")) * 2),
        (_TYPE_INFORMATION, bytes(information)),
        (0x59, struct.pack("<I", rng.getrandbits(32))),
        (pid if pid != _TYPE_INFORMATION else 2, rng.randbytes(4 * rng.randrange(8))),
    ]
    return b"".join(parameter(*rng.choice(choices)) for _ in range(rng.randrange(5)))


def _name(rng: random.Random) -> bytes:
    known = [CMD.encode(), STATE.encode(), CMD_TYPE.encode(), STATE_TYPE.encode(), b"", b"%s%n"]
    raw = rng.randbytes(rng.randrange(1, 40)).replace(b"\0", b"\1")
    return rng.choice([*known, raw, raw + b"\xc3", "ሴ€".encode()])


def fuzz(domain: int, seed: int, peers: int) -> None:
    """Hostile peers, one after another; a node must still find an honest one after them."""
    rng = random.Random(seed)
    arrived: set[str] = set()
    with DdsNode(domain) as node:
        for _ in range(peers):
            with HostilePeer(domain, b"\x01\x10" + rng.randbytes(10)) as peer:
                peer.announce(
                    [
                        (rng.choice([NAME, PID, HOST, _name(rng)]), _name(rng))
                        for _ in range(rng.randrange(6))
                    ],
                    _random_policies(rng),
                )
                for _ in range(rng.randrange(1, 5)):
                    peer.endpoint(
                        _name(rng),
                        _name(rng),
                        writer=rng.random() < 0.5,
                        extra=_random_policies(rng),
                    )
            # now, because the lease of a peer ends while the next ones announce themselves
            arrived |= {p.key for p in node.discovery.participants()}
        assert finds(node, "rt/after/all"), f"seed {seed}"
        assert node.failure is None, f"seed {seed}"
        assert node.discovery.unreadable == 0, f"seed {seed}"
        # announcements did arrive, or nothing was tried
        arrived |= {p.key for p in node.discovery.participants()}
        assert len(arrived) > peers // 6


def test_random_announcements_do_not_stop_discovery() -> None:
    for seed in range(3):
        fuzz(free_domain(), seed, 60)


@pytest.mark.soak
def test_many_random_announcements_do_not_stop_discovery() -> None:
    for seed in range(100, 200):
        fuzz(free_domain(), seed, 100)


def test_recorder_continues_to_record(tmp_path: Path) -> None:
    domain = free_domain()
    with (
        DdsNode(domain) as hand,
        DdsNode(domain) as node,
        Recorder(tmp_path / "a.mcap") as recorder,
        DdsRecording(node, recorder) as recording,
    ):
        for properties in PROPERTIES:
            with HostilePeer(domain) as peer:
                peer.announce(properties)
                for topic, type_name in ENDPOINTS:
                    peer.endpoint(topic, type_name)
                wait_until(lambda: "not a name!" in recording.unknown)
        writer = hand.writer(STATE, STATE_TYPE)
        assert writer.wait_matched(10)
        for n in range(5):
            writer.write_raw(state(float(n)))
        wait_until(lambda: recorder.offered.get(STATE) == 5)
    assert len(open_trace(tmp_path / "a.mcap").samples(STATE)) == 5


def test_doctor_reads_every_hostile_announcement() -> None:
    domain = free_domain()
    with HostilePeer(domain) as peer, DdsNode(domain) as node:
        peer.announce(PROPERTIES[0])
        for properties in PROPERTIES:
            data = ParticipantData(
                bytes(12),
                0x0110,
                "",
                {k.decode("utf-8", "replace"): v.decode("utf-8", "replace") for k, v in properties},
                (),
                (),
                False,
            )
            assert _participant(data, "lo").pid == 0
        node.writer(STATE, STATE_TYPE)
        (view,) = observe_domains([domain], seconds=0.1)
    assert any(e.topic == STATE for e in view.endpoints)
