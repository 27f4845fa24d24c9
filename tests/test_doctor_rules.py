"""The doctor's rules on synthetic observations: each diagnosis, and healthy cases."""

from __future__ import annotations

import dataclasses
import io
import json
import math

import pytest
from rich.console import Console

from dexkit.doctor import (
    DIAGNOSES,
    Observations,
    Scope,
    Severity,
    diagnose,
    readiness,
    verdict,
)
from dexkit.doctor.link import RoundTrips, link_to
from dexkit.doctor.observations import (
    DdsSocket,
    DomainView,
    Endpoint,
    Environment,
    Interface,
    Link,
    Participant,
    Policies,
    SerialPort,
    Servo,
    Stream,
    UsbDevice,
)
from dexkit.doctor.report import as_data, print_report
from dexkit.doctor.rtps import Data, parse_message, parse_participant
from dexkit.doctor.topic_spelling import closest_topic
from tests.doctor_packets import FAST_PARTICIPANT
from tests.each import each

CMDS, STATES = (f"unitree_go::msg::dds_::{name}" for name in ("MotorCmds_", "MotorStates_"))
HAND_CMD, HAND_STATE = (f"unitree_hg::msg::dds_::{name}" for name in ("HandCmd_", "HandState_"))
LO = Interface("lo", up=True, loopback=True, multicast=True, addresses=("127.0.0.1",))
DEAF = dataclasses.replace(LO, multicast=False)


def _who(key: str, **more: object) -> Participant:
    values: dict[str, object] = {
        "version": "0.10.5",
        "process": "python",
        "pid": int(key, 36),
        "addresses": ("127.0.0.1",),
        "command": f"{key}.py",
    }
    return Participant(key, **{**values, **more})  # type: ignore[arg-type]


def _end(owner: str, kind: str, topic: str, type_name: str, **more: object) -> Endpoint:
    return Endpoint(topic, type_name, kind, f"{owner}/{kind}/{topic}", owner, **more)  # type: ignore[arg-type]


def _flow(endpoint: Endpoint, **more: object) -> Stream:
    values: dict[str, object] = {
        "seconds": 2.0,
        "samples": 1000,
        "rate": 500.0,
        "q": (2.5,),
        "nonzero": True,
    }
    return Stream(endpoint.topic, endpoint.key, **{**values, **more})  # type: ignore[arg-type]


def _pair(
    sides: tuple[str, ...] = ("left", "right"),
    *,
    hand: Participant | None = None,
    client: Participant | None = None,
    model: str = "dex1",
    number: int = 1,
    reader: Policies | None = None,
    state_hash: tuple[str, str] = ("", ""),
    **flow: object,
) -> DomainView:
    """A hand and a client that get on well, but for what is changed."""
    cmd, state = (HAND_CMD, HAND_STATE) if model == "dex3" else (CMDS, STATES)
    ends, streams = [], []
    for side in sides:
        writer = _end("hand", "writer", f"rt/{model}/{side}/state", state, type_hash=state_hash[0])
        ends += [
            writer,
            _end("hand", "reader", f"rt/{model}/{side}/cmd", cmd),
            _end("client", "writer", f"rt/{model}/{side}/cmd", cmd),
            _end(
                "client",
                "reader",
                f"rt/{model}/{side}/state",
                state,
                qos=reader or Policies("best_effort"),
                type_hash=state_hash[1],
            ),
        ]
        streams.append(_flow(writer, **flow))
    people = (hand or _who("hand"), client or _who("client"))
    return DomainView(number, people, tuple(ends), tuple(streams))


def _seen(*domains: DomainView, **more: object) -> Observations:
    return Observations(domains=domains, interfaces=(LO,), **more)  # type: ignore[arg-type]


GOOD = _pair()
ENV = Environment(cyclonedds="0.10.5")
PORT = SerialPort("/dev/ttyUSB0", named=True, asked=True, servos=(Servo(1, 311, 1_000_000),))
HAND = UsbDevice("1-1", side="left", node="/dev/bus/usb/001/002")


def _port(**more: object) -> Observations:
    return Observations(serial=(dataclasses.replace(PORT, **more),))  # type: ignore[arg-type]


def _usb(**more: object) -> Observations:
    return Observations(usb=(dataclasses.replace(HAND, **more),))  # type: ignore[arg-type]


GOOD_LINK = Link(
    *("robot", "192.168.123.161", "eth0", "ICMP echo"),
    sent=100,
    received=100,
    rtt_min=0.001,
    rtt_median=0.002,
    rtt_95=0.004,
    participants=2,
    multicast=True,
    clock_offset=0.01,
    samples=1000,
    rmem_max=16 << 20,
)


def _linked(**more: object) -> Observations:
    return Observations(link=dataclasses.replace(GOOD_LINK, **more))  # type: ignore[arg-type]


def _without(view: DomainView, owner: str, kind: str = "") -> DomainView:
    keep = tuple(e for e in view.endpoints if e.participant != owner or kind not in ("", e.kind))
    return dataclasses.replace(view, endpoints=keep)


def _renamed(view: DomainView, owner: str, **more: str) -> DomainView:
    ends = tuple(
        dataclasses.replace(e, **{k: v.format(e.topic) for k, v in more.items()})
        if e.participant == owner
        else e
        for e in view.endpoints
    )
    return dataclasses.replace(view, endpoints=ends)


def _two_publishers() -> DomainView:
    other = _end("other", "writer", "rt/dex1/left/state", STATES)
    people = (*GOOD.participants, _who("other"))
    return DomainView(1, people, (*GOOD.endpoints, other), (*GOOD.streams, _flow(other)))


def _frozen() -> DomainView:
    commands = [e for e in GOOD.endpoints if e.kind == "writer" and e.topic.endswith("cmd")]
    states = tuple(dataclasses.replace(s, identical=True) for s in GOOD.streams)
    flows = tuple(_flow(e, q_span=1.0, driven_span=1.0) for e in commands)
    return dataclasses.replace(GOOD, streams=states + flows)


def _moving(*courses: tuple[float, float]) -> DomainView:
    """BrainCo hands: q of the left and the right one, then of their commands, first and last."""
    view = _pair(model="brainco")
    ends = [
        e
        for kind in ("state", "cmd")
        for e in view.endpoints
        if e.kind == "writer" and e.topic.endswith(kind)
    ]
    flows = [
        _flow(e, began=(began,) * 6, q=(now,) * 6)
        for e, (began, now) in zip(ends, courses, strict=True)
    ]
    return dataclasses.replace(view, streams=tuple(flows))


def _driven(
    state: dict[str, object], command: dict[str, object], model: str = "dex3"
) -> DomainView:
    """A pair whose states and commands have these statistics."""
    view = _pair(model=model)
    commands = [e for e in view.endpoints if e.kind == "writer" and e.topic.endswith("cmd")]
    states = tuple(dataclasses.replace(s, **{**_AT_REST[model], **state}) for s in view.streams)  # type: ignore[arg-type]
    usual = {**_AT_REST[model], "drives": True, "asks": True}
    flows = tuple(_flow(e, **{**usual, **command}) for e in commands)
    return dataclasses.replace(view, streams=states + flows)


FOC, LOCK, BACK = (tuple(bits | i for i in range(7)) for bits in (0x10, 0, 0x80))
_AT_REST: dict[str, dict[str, object]] = {
    "dex3": {"q": (0.1,) * 7, "modes": FOC},
    "dex1": {"q": (2.0,), "modes": (0,)},
}
MOVES = {"q_span": 1.0, "asked_span": 1.0, "driven_span": 1.0}
ONES = {"modes": (1,) * 7, "drives": False, "q_span": 1.0, "asked_span": 1.0}
AWAY = {"q": (1.0,) * 7}
STANDS: dict[str, tuple[dict[str, object], dict[str, object], str, str]] = {
    # states, commands, the finding, and what its text or remedy has
    "wrong mode byte": ({"modes": LOCK}, ONES, "DDS-MODE", "mode 0x01, which drives no motor"),
    "tripped": ({"modes": BACK}, {"modes": tuple(m | 0x80 for m in FOC)}, "DDS-TRIPPED", "bit 7"),
    "locked": ({"modes": LOCK}, {}, "DDS-NOT-FOLLOWING", "status 0 (locked)"),
    "no force": ({"q_span": 0.001}, MOVES, "DDS-NOT-FOLLOWING", "too small"),
    "only damped": (
        {"q_span": 0.001},
        {"q_span": 1.0, "asks": False, "drives": False},
        "DDS-NOT-FOLLOWING",
        "no position gain",
    ),
    "tripped and still": (
        {"modes": BACK, "identical": True},
        {**MOVES, "modes": tuple(m | 0x80 for m in FOC)},
        "DDS-TRIPPED",
        "7 of 7 motors",
    ),
    "far away": ({}, AWAY, "DDS-NOT-FOLLOWING", "without a torque"),
    "limp": (
        {},
        {**AWAY, "asks": False, "drives": False, "limp": True},
        "DDS-NO-GAINS",
        "kp = kd = dq = tau = 0",
    ),
}


@each("name", list(STANDS))
def test_hand_that_cannot_move_is_not_healthy(name: str) -> None:
    state, command, finding, text = STANDS[name]
    seen = _seen(_driven(state, command))
    found = diagnose(seen)
    assert {f.id for f in found} == {finding}
    assert text in found[0].seen + found[0].fix
    assert not verdict(seen, found).healthy


FINE: dict[str, tuple[dict[str, object], dict[str, object]]] = {
    "follows": ({"q_span": 0.8}, MOVES),
    "stands at its goal": ({}, {}),
    "presses on an object": ({"tau": 0.4}, AWAY),
    "is stopped": (
        {},
        {"q": (0.0,) * 7, "asks": False, "drives": False, "limp": True, "nonzero": False},
    ),
    "is locked on purpose": (
        {"modes": LOCK},
        {"asks": False, "drives": False, "modes": LOCK},
    ),
    "says nothing by its mode bytes": ({"modes": (0,) * 7, "q_span": 0.8}, MOVES),
}


@each("name", list(FINE))
def test_hand_that_moves_or_is_not_asked_to_is_healthy(name: str) -> None:
    state, command = FINE[name]
    assert diagnose(_seen(_driven(state, command))) == []


def test_mode_byte_that_moves_a_hand_is_a_warning() -> None:
    (one, _) = diagnose(_seen(_driven({"modes": LOCK, "q_span": 0.9}, ONES)))
    assert (one.id, one.severity) == ("DDS-MODE", Severity.WARNING)
    assert "this hand moves all the same" in one.seen


@each(("model", "simulated"), [("dex1", "sim-dex1"), ("dex3", "sim-dex3")])
def test_one_handed_set_up_is_healthy(model: str, simulated: str) -> None:
    hand = _pair(("left",), model=model)
    seen = _seen(hand)
    (found,) = diagnose(seen)
    assert (found.id, found.severity) == ("DDS-ONE-SIDE", Severity.NOTE)
    assert f"'dexkit serve {simulated} --side right --domain 1'" in found.fix
    assert verdict(seen, [found]).healthy
    assert all(state.ready for state in readiness(seen))
    alone = _seen(_without(hand, "client"))
    assert not any(f.severity is Severity.ERROR for f in diagnose(alone))
    (state,) = readiness(alone)
    assert (state.ready, state.waiting) == (False, False)


def _one_side() -> DomainView:
    """One gripper, and a client of both."""
    view = _pair()
    gone = [e for e in view.endpoints if e.participant == "hand" and "right" in e.topic]
    keep = tuple(e for e in view.endpoints if e not in gone)
    return dataclasses.replace(view, endpoints=keep, streams=view.streams[:1])


def _limp_client() -> DomainView:
    commands = [e for e in GOOD.endpoints if e.kind == "writer" and e.topic.endswith("cmd")]
    flows = tuple(_flow(e, q_span=1.0, limp_span=1.0) for e in commands)
    return dataclasses.replace(GOOD, streams=GOOD.streams + flows)


def _legacy() -> DomainView:
    """A hand of another generation beside a client of this one."""
    hand = _end("hand", "writer", "rt/unitree_actuator/state", STATES)
    ears = _end("hand", "reader", "rt/unitree_actuator/cmd", CMDS)
    view = _without(GOOD, "hand")
    return dataclasses.replace(
        view, endpoints=(*view.endpoints, hand, ears), streams=(_flow(hand),)
    )


def _other_hand() -> DomainView:
    """A Dex3-1 beside a client of the Dex1-1."""
    hand, client = _without(_pair(model="dex3"), "client"), _without(GOOD, "hand")
    return dataclasses.replace(
        client,
        endpoints=(*client.endpoints, *hand.endpoints),
        streams=(*client.streams, *hand.streams),
    )


def _waiting(
    topic: str = "rt/lowstate",
    kind: str = "LowState_",
    *,
    number: int = 0,
    address: str = "10.0.0.7",
    publisher: str = "",
    samples: int = 1000,
) -> DomainView:
    """A client that waits for a state that is not a Dex hand's, and its publisher if any."""
    reader = _end("client", "reader", topic, f"unitree_hg::msg::dds_::{kind}")
    people, ends, streams = [_who("client", addresses=(address,))], [reader], []
    if publisher:
        ends.append(_end("robot", "writer", topic, f"{publisher}::msg::dds_::{kind}"))
        people.append(_who("robot", addresses=(address,)))
        streams.append(_flow(ends[-1], samples=samples))
    return DomainView(number, tuple(people), tuple(ends), tuple(streams))


ETH = Interface("eth0", up=True, loopback=False, multicast=False, addresses=("192.168.123.5",))
CASES: dict[str, Observations] = {
    "DDS-CYCLONE-11": _seen(_pair(client=_who("client", version="11.0.1"))),
    "NET-LO-MULTICAST": Observations(domains=(GOOD,), interfaces=(DEAF,)),
    "NET-INTERFACE": _seen(_pair(client=_who("client", addresses=("192.168.123.5",)))),
    "NET-MULTICAST": Observations(domains=(GOOD,), interfaces=(LO, ETH), examined=("lo", "eth0")),
    "DDS-NOBODY": _seen(_without(GOOD, "hand")),
    "DDS-UNPUBLISHED": _seen(_waiting()),
    "DDS-OTHER-DOMAIN": _seen(_without(GOOD, "hand"), _without(_pair(number=7), "client")),
    "DDS-OTHER-STACK": _seen(_legacy()),
    "DDS-OTHER-HAND": _seen(_other_hand()),
    "DDS-NAME": _seen(_renamed(GOOD, "hand", topic="x{0}")),
    "DDS-PREFIX": _seen(_renamed(GOOD, "hand", topic="rt/r2/dex1/left/state")),
    "DDS-OTHER-INTERFACE": _seen(_renamed(GOOD, "hand", topic="rt/gripper/left/cmd_direct")),
    "DDS-TYPE": _seen(_renamed(GOOD, "hand", type_name=HAND_STATE)),
    "DDS-LAYOUT": _seen(_pair(state_hash=("aa", "bb"))),
    "DDS-QOS": _seen(_pair(reader=Policies("reliable", "transient_local"))),
    "DDS-ONE-SIDE": _seen(_one_side()),
    "DDS-SILENT": _seen(_pair(samples=0)),
    "DDS-UNREADABLE": _seen(_pair(undecodable=1000)),
    "DDS-ALL-ZERO": _seen(_pair(model="dex3", nonzero=False)),
    "DDS-SAYS-NOTHING": _seen(_pair(nonzero=False, blank=True)),
    "DDS-TRIPPED": _seen(_driven(*STANDS["tripped"][:2])),
    "DDS-MODE": _seen(_driven(*STANDS["wrong mode byte"][:2])),
    "DDS-NOT-FOLLOWING": _seen(_driven(*STANDS["locked"][:2])),
    "DDS-TWO-PUBLISHERS": _seen(_two_publishers()),
    "DDS-HAND-DEAF": _seen(_without(GOOD, "hand", "reader")),
    "DDS-UNHEARD": _seen(_without(GOOD, "hand", "reader")),
    "DDS-LATE-JOINER": _seen(
        _pair(model="dex3", hand=_who("hand", started=9.0), client=_who("client", started=5.0))
    ),
    "DDS-FROZEN": _seen(_frozen()),
    "DDS-REVERSED": _seen(_moving((0.9, 0.1), (0.5, 0.5), (0.1, 0.9), (0.5, 0.5))),
    "DDS-SIDES-SWAPPED": _seen(_moving((0.5, 0.1), (0.5, 0.9), (0.5, 0.9), (0.5, 0.1))),
    "DDS-NO-GAINS": _seen(_limp_client()),
    "DDS-RATE": _seen(_pair(rate=50.0)),
    "DDS-NO-CLIENT": _seen(_without(GOOD, "client")),
    "LINK-NO-ANSWER": _linked(received=0, samples=0),
    "LINK-LOSS": _linked(received=97),
    "LINK-LATENCY": _linked(rtt_median=0.06, rtt_95=0.07),
    "LINK-JITTER": _linked(rtt_95=0.04),
    "LINK-AGE": _linked(command_age_95=0.3),
    "LINK-MULTICAST": _linked(multicast=False),
    "LINK-CLOCK": _linked(clock_offset=-2.5),
    "LINK-BUFFER": _linked(rmem_max=212992),
    "ENV-CYCLONEDDS-11": Observations(environment=Environment(cyclonedds="11.0.1")),
    "ENV-CYCLONEDDS-MISSING": Observations(environment=Environment(python="3.12.1")),
    "ENV-CYCLONEDDS-BROKEN": Observations(
        environment=dataclasses.replace(ENV, cyclonedds_error="no libddsc")
    ),
    "ENV-URI": Observations(environment=dataclasses.replace(ENV, uri="x", uri_error="no file")),
    "ENV-SDK": Observations(environment=dataclasses.replace(ENV, sdk="1.0.1", sdk_error="b2")),
    "SERIAL-MISSING": _port(exists=False),
    "SERIAL-PERMISSION": _port(readable=False, group="dialout", asked=False),
    "SERIAL-BUSY": _port(holders=("other (pid 5)",), asked=False),
    "SERIAL-NOT-A-PORT": _port(error="not a tty", asked=False),
    "SERIAL-PROTOCOL-1": _port(servos=(Servo(1, 310, 57600, protocol=1),)),
    "SERIAL-OTHER-SERVO": _port(servos=(Servo(1, 30, 1_000_000),)),
    "SERIAL-NO-ANSWER": _port(servos=()),
    "SERIAL-BAUD": _port(servos=(Servo(1, 311, 57600),)),
    "SERIAL-LATENCY": _port(latency_timer=16),
    "USB-MISSING": Observations(usb_wanted=True),
    "USB-PERMISSION": _usb(writable=False),
    "USB-DRIVER": _usb(drivers=("cdc_acm",)),
    "USB-BUSY": _usb(holders=("vendor (pid 7)",)),
    "USB-UNREACHABLE": _usb(error="refused"),
}


def _ids(seen: Observations, scope: Scope | None = None) -> set[str]:
    return {f.id for f in diagnose(seen, scope)}


def test_every_diagnosis_has_a_test() -> None:
    assert set(CASES) == set(DIAGNOSES)


@each("name", list(CASES))
def test_each_case_gets_its_diagnosis(name: str) -> None:
    # what concerns devices only: that no hand is on DDS is another matter
    found = [f for f in diagnose(CASES[name]) if f.id == name]
    assert found, _ids(CASES[name])
    assert found[0].seen
    assert found[0].fix
    if found[0].severity is not Severity.NOTE:
        assert not verdict(CASES[name], found).healthy


def test_healthy_observation_has_no_finding() -> None:
    usual = _seen(GOOD, environment=ENV, serial=(PORT,), usb=(HAND,))
    assert diagnose(usual) == []
    said = verdict(usual, [])
    assert said.healthy
    assert "a client gets past its wait" in said.text
    assert _ids(_seen(_pair(model="dex3"))) == set()
    # a gripper that rests at 0 is closed, and its clients know
    assert _ids(_seen(_pair(nonzero=False))) == set()


@each(
    "name",
    [
        *("DDS-NOBODY", "DDS-QOS", "DDS-ONE-SIDE", "DDS-SILENT", "DDS-ALL-ZERO", "DDS-TYPE"),
        *("NET-LO-MULTICAST", "NET-INTERFACE", "DDS-OTHER-STACK"),
    ],
)
def test_client_is_reported_to_wait_where_state_is_missing(name: str) -> None:
    states = readiness(CASES[name])
    assert states
    assert not any(s.ready for s in states if s.dialect in ("unitree_go", "dex3"))
    assert all(s.missing for s in states if not s.ready)


def test_missing_multicast_is_no_fault_with_dexkit_or_static_peers() -> None:
    view = _pair(hand=_who("hand", command="dexkit serve sim-dex1 --side both"))
    assert _ids(Observations(domains=(view,), interfaces=(DEAF,))) == set()
    view = _pair(client=_who("client", dds_config="<Peers><Peer address='127.0.0.1'/></Peers>"))
    assert _ids(Observations(domains=(view,), interfaces=(DEAF,))) == set()


def test_silent_process_is_reported_on_another_interface() -> None:
    eth = dataclasses.replace(ETH, discovery=True)
    seen = Observations(
        domains=(_without(GOOD, "hand"),),
        interfaces=(LO, eth),
        sockets=(DdsSocket(1, 7650, 4242, "dex1_1_service"),),
    )
    (found,) = [f for f in diagnose(seen) if f.id == "NET-INTERFACE"]
    assert "dex1_1_service (pid 4242)" in found.seen
    assert "--interface eth0" in found.fix
    known = dataclasses.replace(seen, sockets=(DdsSocket(1, 7650, _who("client").pid),))
    assert "NET-INTERFACE" not in _ids(known)


def test_fast_dds_client_on_loopback_is_known_by_its_port() -> None:
    """It announces no process id in CycloneDDS's way; its announcement is a genuine one."""
    _, ((_, item),) = parse_message(FAST_PARTICIPANT)
    assert isinstance(item, Data)
    places = tuple((p.address, p.port) for p in parse_participant(item.payload).discovery)
    assert places == (("127.0.0.1", 7662),)
    client = Participant("client", "Fast DDS", addresses=("127.0.0.1",), places=places)
    seen = Observations(
        domains=(_pair(client=client),),
        interfaces=(LO,),
        sockets=(DdsSocket(1, 7650, 4242, "fastclient", (7650, 7662)),),
    )
    assert "NET-INTERFACE" not in _ids(seen)
    elsewhere = dataclasses.replace(client, places=(("192.168.123.5", 7662),))
    seen = dataclasses.replace(seen, domains=(_pair(client=elsewhere),))
    assert "NET-INTERFACE" in _ids(seen)


def test_state_of_another_robot_silent_or_on_another_domain() -> None:
    (found,) = [
        f for f in diagnose(_seen(_waiting(publisher="unitree_go"))) if f.severity is Severity.ERROR
    ]
    assert found.id == "DDS-TYPE"
    assert "--arm" in found.fix
    assert "DDS-SILENT" in _ids(_seen(_waiting(publisher="unitree_hg", samples=0)))
    robot = _waiting(number=1, publisher="unitree_hg")
    seen = _seen(_waiting(number=0), _without(robot, "client"))
    (found,) = [f for f in diagnose(seen) if f.severity is Severity.ERROR]
    assert found.id == "DDS-OTHER-DOMAIN"
    assert "robot.py (pid" in found.seen


def test_link_figures_follow_from_samples_and_round_trips() -> None:
    trips = RoundTrips("ICMP echo")
    trips.sent, trips.times = 5, [0.10, 0.11, 0.12, 0.30]
    hand = _who("hand", addresses=("10.0.0.4",))
    view = _pair(("left",), hand=hand, lost=50, delay_min=-2.0, delay_95=-1.9)
    found = link_to("robot", "10.0.0.4", "eth0", trips, [], [view], rmem_max=7, dropped=3)
    assert (found.sent, found.received, found.multicast, found.participants) == (5, 4, False, 1)
    assert found.clock_offset == pytest.approx(2.05)  # half of the least round trip here
    assert found.state_age_95 == pytest.approx(0.15)
    assert math.isnan(found.command_age_95)
    assert found.loss == pytest.approx(0.2)
    assert (found.lost, found.samples, found.rmem_max, found.dropped) == (50, 1000, 7, 3)
    with_multicast = link_to("robot", "10.0.0.4", "eth0", trips, [view], [view])
    assert with_multicast.multicast is True
    nothing = link_to("robot", "10.0.0.9", "eth0", RoundTrips("x"), [], [view])
    assert (nothing.participants, nothing.multicast) == (0, None)
    assert math.isnan(nothing.rtt_median)
    text = io.StringIO()
    seen = Observations(link=found)
    print_report(Console(file=text, width=200), seen, [], verdict(seen, [], Scope()), [])
    assert "\n  round trip     120.0 ms median, 100.0 ms least" in text.getvalue()
    assert "clock there    +2.050 s" in text.getvalue()
    assert "multicast      does not work" in text.getvalue()
    json.dumps(as_data(seen, [], verdict(seen, [], Scope()), []), allow_nan=False)


def test_restarted_hand_is_not_reported_as_late_joiner() -> None:
    """A hand younger than a client whose commands do arrive is a hand that was restarted."""
    view = _pair(hand=_who("hand", started=9.0), client=_who("client", started=5.0))
    assert "DDS-LATE-JOINER" not in _ids(_seen(view))


def test_port_in_use_by_a_service_is_no_finding() -> None:
    (found,) = diagnose(_port(holders=("dexkit serve ezgripper (pid 5)",), asked=False))[-1:]
    assert (found.id, found.severity) == ("SERIAL-BUSY", Severity.NOTE)


@each(
    ("topic", "meant"),
    [
        ("dex1/left/state", "rt/dex1/left/state"),
        ("/dex1/left/state", "rt/dex1/left/state"),
        ("/rt/dex1/left/cmd", "rt/dex1/left/cmd"),
        ("rt/Dex3/Left/cmd", "rt/dex3/left/cmd"),
        ("rt/dex1//left/cmd", "rt/dex1/left/cmd"),
        ("rt/dex3/left/states", "rt/dex3/left/state"),
        ("rt/unitree_actuators/cmd", "rt/unitree_actuator/cmd"),
    ],
)
def test_misspelt_topic_is_recognised(topic: str, meant: str) -> None:
    found = closest_topic(topic)
    assert found is not None
    assert found[0] == meant
