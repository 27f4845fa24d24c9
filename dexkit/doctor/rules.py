"""Derive findings from observations: pure functions, no IO."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product

from dexkit.backends import simulators
from dexkit.doctor.awaited_topics import AWAITED, Awaited, awaited
from dexkit.doctor.catalogue import DIAGNOSES, Finding, Severity
from dexkit.doctor.motion_direction import Course, moves_against, swapped
from dexkit.doctor.observations import (
    DomainView,
    Endpoint,
    Environment,
    Link,
    Observations,
    Participant,
    Policies,
    SerialPort,
    Stream,
    UsbDevice,
)
from dexkit.doctor.prefixes import by_prefix, renamed
from dexkit.doctor.topic_spelling import closest_topic, short
from dexkit.doctor.type_hashes import TYPE_HASHES
from dexkit.hand import Side
from dexkit.messages.earlier import EARLIER, earlier_by_hash
from dexkit.models import DIALECTS, MODELS, Dialect, HandModel, ModeByte, short_names
from dexkit.other_interfaces import TWO_FINGERS, other_interface
from dexkit.teleop.hands import teleop_hand
from dexkit.topics import Role, roles, split_prefix, under_prefix
from dexkit.wire import dex3_usb, mx64

__all__ = ["ROBOT_NETWORK", "Readiness", "Scope", "Verdict", "diagnose", "readiness", "verdict"]

ROBOT_NETWORK = "192.168.123."
"""Network of Unitree's robots (docs/sources/unitree-dex.md#a6)."""

_FROZEN_COMMANDS = 0.1  # rad that commands move while a measured state must change
_COMMANDED = 0.2  # rad (or the model's unit) of commands after which a hand must have moved
_STANDS = 0.1  # part of a command's way that is no motion
_FOLLOWS = 0.3  # part of it that is
_FAR = 0.25  # of a joint's range from its goal, where it does not stand by friction
_NO_TORQUE = 0.01  # N m, below which a motor does not try
_TIMEOUT = 0x80  # bit of RIS_Mode_t: protection wanted, or tripped
_MARGIN = 0.9  # of a rate, for what a busy machine does to a measurement
# what a link may have before it is reported; docs/doctor.md gives the reasons
_MOST_LOSS = 0.01
_MOST_ROUND_TRIP = 0.05  # s
_MOST_JITTER = 0.02  # s
_MOST_COMMAND_AGE = 0.2  # s; commands 0.25 s older than usual are stale (docs/service.md)
_MOST_CLOCK_OFFSET = 0.1  # s
_LEAST_BUFFER = 1 << 20  # bytes; what CycloneDDS asks for
_DRIVER_BAUD = 1_000_000
_DURABILITY = ("volatile", "transient_local", "transient", "persistent")


@dataclass(frozen=True)
class Scope:
    """The domain and dialects that are judged.

    :param domain: None for all domains with a hand or a client.
    :param dialects: those that count; empty for all that are found.
    :param devices_only: a device was asked about and nothing on DDS.
    """

    domain: int | None = None
    dialects: tuple[Dialect, ...] = ()
    devices_only: bool = False


@dataclass(frozen=True)
class Readiness:
    """Whether a client of a dialect would get past its wait on a domain.

    :param missing: what it still waits for, or empty.
    :param waiting: there is such a client.
    :param prefix: of the topics; empty for none.
    """

    domain: int
    dialect: str
    ready: bool
    missing: str = ""
    waiting: bool = False
    prefix: str = ""

    @property
    def name(self) -> str:
        """Dialect and prefix, for people."""
        return f"{self.dialect} under {self.prefix}" if self.prefix else self.dialect


@dataclass(frozen=True)
class Verdict:
    """The result in one sentence.

    :param healthy: no errors and no warnings.
    """

    healthy: bool
    text: str


def _finding(
    name: str, seen: str, fix: str = "", severity: Severity | None = None, **where: str | int
) -> Finding:
    known = DIAGNOSES[name]
    return Finding(known, seen, fix or known.fix, severity or known.severity, where)


def diagnose(seen: Observations, scope: Scope | None = None) -> list[Finding]:
    """All findings of the observations, causes before their effects."""
    scope = scope or Scope()
    # each robot's hands on their own; the domain itself is examined with those without a prefix
    (_, own), *others = by_prefix(seen)
    found = [*_prefixes(seen), *_domains(own, scope)]
    if others:  # somebody is there
        found = [f for f in found if f.id != "DDS-NOBODY"]
    for prefix, part in others:
        found += [renamed(f, prefix) for f in _domains(part, scope) if f.id not in _OF_PARTICIPANTS]
    found += _network(seen, scope)
    if seen.environment is not None:
        found += _environment(seen.environment)
    if seen.link is not None:
        found += _link(seen.link)
    for port in seen.serial:
        found += _serial(port)
    found += _usb(seen)
    order = {name: i for i, name in enumerate(DIAGNOSES)}
    rank = list(Severity)
    return sorted(found, key=lambda f: (rank.index(f.severity), order[f.id]))


def verdict(seen: Observations, findings: list[Finding], scope: Scope | None = None) -> Verdict:
    """The result in one sentence: healthy, or the most important finding."""
    scope = scope or Scope()
    problems = [f for f in findings if f.severity is not Severity.NOTE]
    states = readiness(seen, scope)
    ready = [r for r in states if r.ready]
    good = " and ".join(
        f"{_title(DIALECTS[r.dialect])} on domain {r.domain} ({r.name})" for r in ready
    )
    if not problems:
        text = f"Healthy: {good}; a client gets past its wait." if good else "Nothing is wrong."
        return Verdict(True, text)
    first = problems[0]
    more = f" ({len(problems) - 1} more below)" if len(problems) > 1 else ""
    title = first.diagnosis.title
    if first.severity is Severity.WARNING:
        return Verdict(False, f"It works, but {title}{more}.")
    tail = "" if not ready else f" A client of {good} would get past its wait all the same."
    return Verdict(False, f"{title[:1].upper()}{title[1:]}{more}.{tail}")


def _title(dialect: Dialect) -> str:
    return MODELS[dialect.model].title


# --- endpoints by role


@dataclass(frozen=True)
class _Part:
    """An endpoint and the role that its topic has."""

    view: DomainView
    endpoint: Endpoint
    role: Role

    @property
    def who(self) -> str:
        return self.view.owner(self.endpoint)


def _parts(view: DomainView, kind: str, role: str, scope: Scope) -> list[_Part]:
    """Endpoints of a kind whose topic and type have a role in a dialect that counts."""
    return [
        _Part(view, endpoint, found)
        for endpoint in view.endpoints
        if endpoint.kind == kind
        for found in roles(endpoint.topic, endpoint.type_name)
        if found.kind == role and (not scope.dialects or found.dialect in scope.dialects)
    ]


def _hands(view: DomainView, scope: Scope) -> list[_Part]:
    return _parts(view, "writer", "state", scope)


def _clients(view: DomainView, scope: Scope) -> list[_Part]:
    """Endpoints of clients: readers of states, and writers of commands."""
    return _parts(view, "reader", "state", scope) + _parts(view, "writer", "cmd", scope)


def _focus(seen: Observations, scope: Scope) -> list[DomainView]:
    """The domains that are judged."""
    if scope.domain is not None:
        return [v for v in seen.domains if v.number == scope.domain]
    return [
        v
        for v in seen.domains
        if _hands(v, scope) or _clients(v, scope) or (not scope.dialects and _awaiting(v))
    ] or [v for v in seen.domains if v.number in (0, 1)]


def _awaiting(view: DomainView) -> list[Endpoint]:
    """Readers of states that are not a Dex hand's and that Unitree's clients wait for."""
    return [e for e in view.endpoints if e.kind == "reader" and e.topic in AWAITED]


def _wanted(views: Iterable[DomainView], scope: Scope) -> list[Dialect]:
    """The dialects in question: asked for, or a client's, or a hand's."""
    if scope.dialects:
        return list(scope.dialects)
    views = list(views)
    for parts in (_clients, _hands):
        found = {p.role.dialect.name for v in views for p in parts(v, scope)}
        if found:
            return [d for d in DIALECTS.values() if d.name in found]
    return []


def readiness(seen: Observations, scope: Scope | None = None) -> list[Readiness]:
    """Whether a client would get past 'Waiting to subscribe dds...'
    (docs/sources/unitree-dex.md#b1).
    """
    scope = scope or Scope()
    return [
        replace(each, prefix=prefix)
        for prefix, part in by_prefix(seen)
        for each in _readiness(part, scope)
    ]


def _readiness(seen: Observations, scope: Scope) -> list[Readiness]:
    out = []
    for view in _focus(seen, scope):
        names = {p.role.dialect.name for p in _hands(view, scope) + _clients(view, scope)}
        for dialect in DIALECTS.values():
            if dialect.name in names:
                missing = _missing(view, dialect) or _unmet(seen, view, dialect)
                waits = bool(missing) and bool(_read_sides(view, dialect))
                out.append(Readiness(view.number, dialect.name, not missing, missing, waits))
    return out


def _unmet(seen: Observations, view: DomainView, dialect: Dialect) -> str:
    """Why hand and client do not discover each other although both run, or empty."""
    scope = Scope(dialects=(dialect,))
    hands, clients = _hands(view, scope), _clients(view, scope)
    found = [*_apart(view, hands, clients), *_deaf_loopback(seen, view, hands, clients)]
    return found[0].diagnosis.title if found else ""


def _read_sides(view: DomainView, dialect: Dialect) -> set[Side]:
    """The sides whose state some process reads."""
    parts = _parts(view, "reader", "state", Scope(dialects=(dialect,)))
    return {side for part in parts for side in part.role.sides}


def _missing(view: DomainView, dialect: Dialect) -> str:
    scope = Scope(dialects=(dialect,))
    read = _read_sides(view, dialect)
    for side in Side:
        if read and side not in read:
            continue  # its clients are of the other hand alone
        parts = [p for p in _hands(view, scope) if side in p.role.sides]
        who = "both hands" if dialect.topics(Side.LEFT) == dialect.topics(Side.RIGHT) else side
        if not parts:
            return f"no process publishes the state of the {side} hand"
        readers = [
            p.endpoint
            for p in _parts(view, "reader", "state", scope)
            if p.endpoint.topic == parts[0].endpoint.topic
        ]
        if any(all(_qos_problem(p.endpoint.qos, r.qos) for p in parts) for r in readers):
            return f"the state of {who} and its reader do not match"
        flowing = [s for p in parts if (s := view.stream(p.endpoint)) and s.samples > s.undecodable]
        if not flowing:
            return f"no state of {who} comes"
        if dialect.zero_is_no_state and not any(s.nonzero for s in flowing):
            return f"all positions of {who} are exactly 0"
    return ""


# --- DDS

_OF_PARTICIPANTS = frozenset({"DDS-CYCLONE-11", "DDS-NOBODY"})
"""Reported once a domain, whatever the prefixes."""


def _other_interfaces(view: DomainView) -> Iterator[Finding]:
    """Topics and commands of drivers and simulations that have an interface of their own."""
    for endpoint in view.endpoints:
        what, severity = other_interface(endpoint.topic), Severity.NOTE
        stream = view.stream(endpoint)
        if stream is not None and stream.two_fingers:
            what, severity = TWO_FINGERS, Severity.WARNING
        if what:
            yield _finding(
                "DDS-OTHER-INTERFACE",
                f"{endpoint.topic} of {view.owner(endpoint)} on domain {view.number}: {what}",
                severity=severity,
                domain=view.number,
                topic=endpoint.topic,
            )


def _prefixes(seen: Observations) -> Iterator[Finding]:
    """Hands under a prefix, and clients that look for them under another."""
    for view in seen.domains:
        whose: dict[str, dict[str, set[str]]] = {}
        for endpoint in view.endpoints:
            prefix, bare = split_prefix(endpoint.topic)
            for role in roles(bare, endpoint.type_name):
                if role.kind == "state":
                    ends = whose.setdefault(prefix, {})
                    ends.setdefault(endpoint.kind, set()).add(bare)
        for prefix in sorted(filter(None, whose)):
            served = whose[prefix].get("writer", set())
            if not served:
                continue
            lonely = sorted(
                under_prefix(topic, other)
                for other, ends in whose.items()
                for topic in served & ends.get("reader", set()) - ends.get("writer", set())
            )
            states = ", ".join(under_prefix(topic, prefix) for topic in sorted(served))
            yield _finding(
                "DDS-PREFIX",
                f"{states} on domain {view.number}"
                + (f"; a client waits for {', '.join(lonely)}" if lonely else ""),
                severity=Severity.ERROR if lonely else Severity.NOTE,
                domain=view.number,
            )


def _domains(seen: Observations, scope: Scope) -> Iterator[Finding]:
    focus = _focus(seen, scope)
    for view in seen.domains:
        yield from _versions(view)
    found = [f for view in focus for f in _names_and_types(view, scope)]
    yield from found
    for view in focus:
        yield from _other_interfaces(view)
        yield from _matches(view)
        yield from _earlier_layouts(view)
        yield from _listeners(view, scope)
        yield from _streams(view, scope)
        yield from _ways(view, scope)
        yield from _motionless(view, scope)
        yield from _limp_clients(view, scope)
        if not scope.dialects:
            yield from _waiting(seen, view)
    yield from _absent(seen, focus, scope, explained=bool(found))


def _versions(view: DomainView) -> Iterator[Finding]:
    for one in view.participants:
        parts = re.match(r"(\d+)\.(\d+)", one.version)
        if one.vendor != "CycloneDDS" or parts is None:
            continue
        version = int(parts[1]), int(parts[2])
        if version <= (0, 10):
            continue
        ends = [e for e in view.endpoints if e.participant == one.key]
        typed = any(e.type_name.startswith(("unitree_", "std_msgs")) for e in ends)
        if version < (1, 0):
            # 0.11.0 is announced by the wheel of 0.10.2 and by builds that crash it; only how
            # they describe a type differs
            typed = any(
                e.type_hash
                and TYPE_HASHES.get(e.type_name, e.type_hash) != e.type_hash
                and earlier_by_hash(e.type_name, e.type_hash) is None
                for e in ends
            )
            if not typed:
                continue
        peers = [
            p.name for p in view.participants if p is not one and re.match(r"0\.1[01]\.", p.version)
        ]
        risk = ("has Unitree's types" if typed else "has no endpoint of Unitree's types yet") + (
            f"; in danger: {', '.join(peers)}" if peers else "; no 0.10 peer is (still) there"
        )
        yield _finding(
            "DDS-CYCLONE-11",
            f"{one.name} runs CycloneDDS {one.version} on domain {view.number} and {risk}",
            severity=Severity.ERROR if typed else Severity.WARNING,
            domain=view.number,
            pid=one.pid,
        )


def _names_and_types(view: DomainView, scope: Scope) -> Iterator[Finding]:
    reported: set[tuple[str, str]] = set()
    for endpoint in view.endpoints:
        key = (endpoint.topic, endpoint.kind)
        verb = "publishes" if endpoint.kind == "writer" else "reads"
        near = closest_topic(endpoint.topic)
        if near is not None and key not in reported:
            reported.add(key)
            yield _finding(
                "DDS-NAME",
                f"{view.owner(endpoint)} {verb} {endpoint.topic!r} on domain {view.number}; "
                f"{near[0]!r} was probably meant: {near[1]}",
                fix=f"write {near[0]!r}",
                domain=view.number,
                topic=endpoint.topic,
            )
    topics = sorted({e.topic for e in view.endpoints if roles(e.topic)})
    for topic in topics:
        here = [e for e in view.endpoints if e.topic == topic]
        types = sorted({e.type_name for e in here})
        right = {r.type_name for r in roles(topic)}
        if len(types) < 2 and set(types) <= right:
            if not scope.dialects:
                continue
            wanted = [r for r in roles(topic) if r.dialect in scope.dialects]
            if not wanted or types[0] in {r.type_name for r in wanted}:
                continue
            served = roles(topic, types[0])[0].dialect.name
            asked = ", ".join(d.name for d in scope.dialects)
            detail = f"that is the dialect {served}, not {asked}"
            fix = f"'dexkit serve ... --dialect {asked}', or a client of {served}"
        else:
            detail = " and ".join(
                sorted({r.dialect.name + " has " + short(r.type_name) for r in roles(topic)})
            )
            fix = "use the same type on both sides: " + detail
        uses = "; ".join(
            f"{view.owner(e)} {'publishes' if e.kind == 'writer' else 'reads'} {short(e.type_name)}"
            for e in here
        )
        yield _finding(
            "DDS-TYPE",
            f"{topic} on domain {view.number}: {uses} ({detail})",
            fix=fix,
            domain=view.number,
            topic=topic,
        )


def _matches(view: DomainView) -> Iterator[Finding]:
    """Readers and writers of one topic and type that do not match."""
    reported: set[tuple[str, str, str]] = set()
    writers = [e for e in view.endpoints if e.kind == "writer" and roles(e.topic)]
    readers = [e for e in view.endpoints if e.kind == "reader"]
    for writer, reader in product(writers, readers):
        if (writer.topic, writer.type_name) != (reader.topic, reader.type_name):
            continue
        problem = _qos_problem(writer.qos, reader.qos)
        pair = f"{view.owner(reader)} reads {reader.topic} of {view.owner(writer)}"
        if problem and (key := ("qos", writer.key, reader.participant)) not in reported:
            reported.add(key)
            yield _finding(
                "DDS-QOS",
                f"{pair} on domain {view.number}, but {problem}",
                domain=view.number,
                topic=writer.topic,
            )
        ends = view.participant(writer.participant), view.participant(reader.participant)
        # other versions of CycloneDDS describe the same type differently
        alike = ends[0] and ends[1] and _series(ends[0]) == _series(ends[1])
        hashes = writer.type_hash, reader.type_hash
        told = any(earlier_by_hash(writer.type_name, one) for one in hashes)
        if alike and all(hashes) and hashes[0] != hashes[1] and not told:
            key = ("layout", writer.topic, reader.participant)
            if key not in reported:
                reported.add(key)
                yield _finding(
                    "DDS-LAYOUT",
                    f"{pair} on domain {view.number}; both use {short(writer.type_name)} with "
                    "different layouts",
                    domain=view.number,
                    topic=writer.topic,
                )


def _earlier_layouts(view: DomainView) -> Iterator[Finding]:
    """Peers whose types or samples have a layout that Unitree has given up.

    By the hash of the type, which CycloneDDS 0.10 announces, or by the length of the samples: ROS 2
    Foxy and Humble announce none.
    """
    reported: set[tuple[str, str]] = set()
    for endpoint in view.endpoints:
        stream = view.stream(endpoint)
        layouts = EARLIER.get(endpoint.type_name, ())
        sent = stream.earlier if stream is not None else ""
        known = earlier_by_hash(endpoint.type_name, endpoint.type_hash) or next(
            (one for one in layouts if one.when == sent), None
        )
        key = (endpoint.participant, endpoint.topic)
        if known is None or key in reported:
            continue
        reported.add(key)
        verb = "publishes" if endpoint.kind == "writer" else "reads"
        yield _finding(
            "DDS-LAYOUT",
            f"{view.owner(endpoint)} {verb} {endpoint.topic} on domain {view.number} with the "
            f"layout of {short(endpoint.type_name)} of {known.when} ({known.packages})",
            domain=view.number,
            topic=endpoint.topic,
        )


def _series(participant: Participant) -> str:
    return ".".join(participant.version.split(".")[:2])


def _qos_problem(offered: Policies, requested: Policies) -> str:
    """Why a writer's QoS does not match a reader's, or empty."""
    if requested.reliability == "reliable" and offered.reliability != "reliable":
        return "the reader asks for reliable and the writer is best-effort"
    if _DURABILITY.index(requested.durability) > _DURABILITY.index(offered.durability):
        return f"the reader asks for {requested.durability} and the writer is {offered.durability}"
    if requested.deadline < offered.deadline:
        return (
            f"the reader asks for a sample every {requested.deadline:g} s; the writer offers less"
        )
    if requested.liveliness > offered.liveliness:
        return "the reader asks for a stronger liveliness than the writer offers"
    if requested.exclusive != offered.exclusive:
        return "one side wants exclusive ownership and the other shared"
    mine, theirs = set(offered.partitions or ("",)), set(requested.partitions or ("",))
    if not mine & theirs and not any("*" in p or "?" in p for p in mine | theirs):
        return f"they are in different partitions ({sorted(mine)} and {sorted(theirs)})"
    return ""


def _listeners(view: DomainView, scope: Scope) -> Iterator[Finding]:
    for part in _first(_hands(view, scope)):
        dialect = part.role.dialect
        cmd = dialect.topics(part.role.sides[0])[0]
        if not any(
            e.kind == "reader" and e.topic == cmd and e.type_name == dialect.cmd_type
            for e in view.endpoints
        ):
            yield _finding(
                "DDS-HAND-DEAF",
                f"{part.who} publishes {part.endpoint.topic} on domain {view.number}, and no "
                f"process reads {cmd}",
                domain=view.number,
                topic=cmd,
            )
    for part in _first(_parts(view, "writer", "cmd", scope)):
        topic, type_name = part.endpoint.topic, part.endpoint.type_name
        readers = [
            e
            for e in view.endpoints
            if e.kind == "reader" and e.topic == topic and e.type_name == type_name
        ]
        stream = view.stream(part.endpoint)
        if not readers:
            rate = f" {stream.rate:.0f} times a second" if stream and stream.rate else ""
            yield _finding(
                "DDS-UNHEARD",
                f"{part.who} publishes {topic}{rate} on domain {view.number}; no process reads it",
                domain=view.number,
                topic=topic,
            )
        elif teleop_hand(part.role.dialect.model).forks and not (stream and stream.samples):
            late = _late(view, part.endpoint, readers)
            if late:
                yield _finding(
                    "DDS-LATE-JOINER",
                    f"{late} reads {topic} on domain {view.number}; it was started after "
                    f"{part.who}, whose commands do not arrive here either",
                    domain=view.number,
                    topic=topic,
                )
    for state in _first(_hands(view, scope)):
        topic = state.endpoint.topic
        if not any(e.kind == "reader" and e.topic == topic for e in view.endpoints):
            yield _finding(
                "DDS-NO-CLIENT",
                f"no process reads {topic} on domain {view.number}",
                domain=view.number,
                topic=topic,
            )
    for role in ("state", "cmd"):
        by_topic: dict[tuple[str, str], dict[str, _Part]] = {}
        for part in _parts(view, "writer", role, scope):
            key = (part.endpoint.topic, part.endpoint.type_name)
            by_topic.setdefault(key, {})[part.endpoint.participant] = part
        for (topic, _), parts in sorted(by_topic.items()):
            if len(parts) > 1:
                yield _finding(
                    "DDS-TWO-PUBLISHERS",
                    f"{topic} on domain {view.number} is published by "
                    + " and by ".join(sorted(p.who for p in parts.values())),
                    domain=view.number,
                    topic=topic,
                )


def _first(parts: Iterable[_Part]) -> list[_Part]:
    """One part a topic and type."""
    return list({(p.endpoint.topic, p.endpoint.type_name): p for p in parts}.values())


def _late(view: DomainView, writer: Endpoint, readers: Iterable[Endpoint]) -> str:
    """Name of a reader's process that is younger than the writer's, or empty."""
    client = view.participant(writer.participant)
    for reader in readers:
        hand = view.participant(reader.participant)
        if not (client and hand and client.started and hand.started):
            continue
        if hand.started > client.started and hand.pid != client.pid:
            return hand.name
    return ""


def _streams(view: DomainView, scope: Scope) -> Iterator[Finding]:
    for part in _hands(view, scope):
        stream = view.stream(part.endpoint)
        if stream is None or stream.seconds <= 0:
            continue
        dialect, topic = part.role.dialect, part.endpoint.topic
        what = f"{topic} of {part.who} on domain {view.number}"
        if not stream.samples:
            yield _finding(
                "DDS-SILENT",
                f"{what}: no sample in {stream.seconds:.1f} s",
                domain=view.number,
                topic=topic,
            )
            continue
        if stream.undecodable and stream.undecodable >= stream.samples:
            if stream.earlier:  # reported with all streams of one
                continue
            yield _finding(
                "DDS-UNREADABLE",
                f"{what}: {stream.samples} samples are not {short(part.endpoint.type_name)}",
                domain=view.number,
                topic=topic,
            )
            continue
        if not stream.nonzero and dialect.zero_is_no_state:
            yield _finding(
                "DDS-ALL-ZERO",
                f"{what}: every q is 0.0"
                + (", as is every other number: it has not started" if stream.blank else ""),
                domain=view.number,
                topic=topic,
            )
        elif stream.blank:
            yield _finding(
                "DDS-SAYS-NOTHING",
                f"{what}: every number in {stream.samples} states is 0",
                domain=view.number,
                topic=topic,
            )
        least = MODELS[dialect.model].min_state_rate
        if stream.samples > 1 and stream.rate < least * _MARGIN:
            yield _finding(
                "DDS-RATE",
                f"{what}: {stream.rate:.0f} a second; clients need {least:g}",
                domain=view.number,
                topic=topic,
            )
        command = _command(view, part, scope)
        tripped = any(mode & _TIMEOUT for mode in _told(part, stream))  # is reported as that
        moved = command is not None and command.driven_span >= _FROZEN_COMMANDS
        if stream.identical and command is not None and moved and not tripped:
            yield _finding(
                "DDS-FROZEN",
                f"{what}: {stream.samples} identical states while the commands moved by "
                f"{command.driven_span:.2f} {MODELS[dialect.model].unit}",
                domain=view.number,
                topic=topic,
            )


def _positions(part: _Part, stream: Stream | None, side: Side, at: str) -> tuple[float, ...]:
    """A side's part of the positions in a stream; empty where they are not known."""
    if stream is None:
        return ()
    first = part.role.dialect.index[side]
    count = len(MODELS[part.role.dialect.model].joints[side])
    values: tuple[float, ...] = getattr(stream, at)[first : first + count]
    return values if len(values) == count else ()


def _ways(view: DomainView, scope: Scope) -> Iterator[Finding]:
    """Hands that move the wrong way, or with the other one's commands."""
    found: dict[tuple[str, Side], tuple[_Part, Course]] = {}
    for part in _hands(view, scope):
        state, command = view.stream(part.endpoint), _command(view, part, scope)
        for side in part.role.sides:
            course = Course(
                *(
                    _positions(part, stream, side, at)
                    for stream in (state, command)
                    for at in ("began", "q")
                )
            )
            if all(course):
                found[part.role.dialect.name, side] = part, course
                yield from _reversed(view, part, side, course)
    for (name, side), (part, mine) in found.items():
        other = found.get((name, Side.RIGHT))
        if side is Side.LEFT and other is not None and swapped(mine, other[1]):
            yield _finding(
                "DDS-SIDES-SWAPPED",
                f"{part.endpoint.topic} of {part.who} on domain {view.number}: it moves as the "
                "right hand is commanded, and the right one as it is",
                domain=view.number,
                topic=part.endpoint.topic,
            )


def _reversed(view: DomainView, part: _Part, side: Side, course: Course) -> Iterator[Finding]:
    ranges = _ranges(part.role.dialect, side)
    against = moves_against(course, ranges)
    if against:
        yield _finding(
            "DDS-REVERSED",
            f"{part.endpoint.topic} of {part.who} on domain {view.number}: {against} of "
            f"{len(ranges)} joints of the {side} hand moved against their commands",
            domain=view.number,
            topic=part.endpoint.topic,
        )


def _motionless(view: DomainView, scope: Scope) -> Iterator[Finding]:
    """Hands that cannot move, or do not, though a client commands them."""
    for part in _hands(view, scope):
        state, command = view.stream(part.endpoint), _command(view, part, scope)
        if state is None or not state.samples:
            continue
        topic = part.endpoint.topic
        what = f"{topic} of {part.who} on domain {view.number}"
        told = _told(part, state)
        tripped = [i for i, mode in enumerate(told) if mode & _TIMEOUT]
        if tripped:
            again = command is not None and any(
                command.modes[i] & _TIMEOUT for i in tripped if i < len(command.modes)
            )
            yield _finding(
                "DDS-TRIPPED",
                f"{what}: {len(tripped)} of {len(told)} motors report that it has tripped (mode "
                f"byte 0x{told[tripped[0]]:02x})"
                + ("; the commands still have bit 7" if again else ""),
                severity=None if again else Severity.WARNING,
                domain=view.number,
                topic=topic,
            )
        if command is None:
            continue
        moves = command.asked_span >= _FROZEN_COMMANDS and (
            state.q_span >= _FOLLOWS * command.asked_span
        )
        if command.asks and not command.drives:
            bytes_sent = ", ".join(f"0x{m:02x}" for m in dict.fromkeys(command.modes))
            yield _finding(
                "DDS-MODE",
                f"{what}: commands with gains have mode {bytes_sent}, which drives no motor by the "
                "documents" + ("; this hand moves all the same" if moves else ""),
                fix="in the client: mode = "
                + ("0x10 | index" if part.role.dialect.mode_byte is ModeByte.RIS else "1")
                + " while it drives a motor",
                severity=Severity.WARNING if moves else None,
                domain=view.number,
                topic=topic,
            )
        elif not tripped and (why := _stands(part, state, command, told)):
            seen, causes, sure = why
            yield _finding(
                "DDS-NOT-FOLLOWING",
                f"{what}: {seen}",
                fix=f"likeliest first: {'; '.join(causes)}",
                severity=None if sure else Severity.WARNING,
                domain=view.number,
                topic=topic,
            )


def _told(part: _Part, state: Stream) -> tuple[int, ...]:
    """The mode bytes of a hand's motors, where they are RIS_Mode; else empty.

    Only a hand that fills the ids says anything by the other bits.
    """
    modes = state.modes if part.role.dialect.mode_byte is ModeByte.RIS else ()
    return modes if all(mode & 15 == i for i, mode in enumerate(modes)) else ()


def _stands(
    part: _Part, state: Stream, command: Stream, told: tuple[int, ...]
) -> tuple[str, list[str], bool] | None:
    """What shows that a hand does not do what it is commanded, the causes, and whether it is sure;
    None if it does, or if another finding says so.
    """
    locked = bool(told) and all(mode >> 4 & 7 == 0 for mode in told)
    if command.drives and locked and state.q_span < _STANDS:
        causes = ["a motor error or a lost device: see the log of the hand's service"]
        return "its motors report status 0 (locked), though the commands drive them", causes, True
    said = (
        state.identical and command.driven_span >= _FROZEN_COMMANDS
    ) or command.limp_span >= _FROZEN_COMMANDS
    if said:
        return None
    causes = [
        "the hand is not powered, or in an error: see the log of its service",
        "its gains are too small to move it (what its client sends: docs/teleop.md)",
        "something holds the fingers",
    ]
    if command.q_span >= _COMMANDED and state.q_span < _STANDS * command.q_span:
        if not command.asks:
            causes.insert(0, "the commands have no position gain")
        unit = MODELS[part.role.dialect.model].unit
        seen = f"q of the commands changed by {command.q_span:.2f} {unit}, that of the hand by "
        return f"{seen}{state.q_span:.3f}", causes, True
    far = command.drives and part.role.dialect.gains_are_used and state.tau < _NO_TORQUE
    if far and _far(part, state, command) and state.q_span < _STANDS * _COMMANDED:
        return "it stands far from where it is commanded, without a torque", causes, False
    return None


def _far(part: _Part, state: Stream, command: Stream) -> bool:
    """Whether most joints are far from their goals."""
    far = count = 0
    for side in part.role.sides:
        here, goal = (_positions(part, s, side, "q") for s in (state, command))
        if not here or not goal:
            return False
        for q, target, (low, high) in zip(
            here, goal, _ranges(part.role.dialect, side), strict=True
        ):
            count += 1
            far += abs(min(max(target, low), high) - q) > _FAR * (high - low)
    return far > count / 2


def _ranges(spoken: Dialect, side: Side) -> list[tuple[float, float]]:
    """Lower and upper limit of each joint of a side."""
    return [
        (0.0, spoken.q_open) if spoken.is_gripper else (joint.q_min, joint.q_max)
        for joint in MODELS[spoken.model].joints[side]
    ]


def _limp_clients(view: DomainView, scope: Scope) -> Iterator[Finding]:
    for part in _parts(view, "writer", "cmd", scope):
        stream = view.stream(part.endpoint)
        # what is driven at times is let go on purpose; a stop has q = 0, or the hand's own
        if stream is None or stream.drives or stream.driven_span:
            continue
        goes = stream.limp_span >= _FROZEN_COMMANDS
        stays = stream.limp and not stream.asks and stream.nonzero and not stream.limp_span
        if not goes and not (stays and _elsewhere_than_hand(view, part, stream, scope)):
            continue
        how = f"q changed by {stream.limp_span:.2f} rad" if goes else "q is not where the hand is"
        yield _finding(
            "DDS-NO-GAINS",
            f"{part.endpoint.topic} of {part.who} on domain {view.number}: {how}, with "
            "kp = kd = dq = tau = 0",
            fix=_gains_of(part.role.dialect),
            domain=view.number,
            topic=part.endpoint.topic,
        )


def _gains_of(spoken: Dialect) -> str:
    """Advice for a client that sends none."""
    kp, kd = MODELS[spoken.model].gains[0]
    advice = f"send gains with q (Unitree's client: kp {kp:g}, kd {kd:g})"
    if spoken.is_gripper:
        advice += (
            "; an EZGripper obeys q alone with 'dexkit serve ezgripper --set zero_gains=position'"
        )
    return advice


def _elsewhere_than_hand(view: DomainView, part: _Part, command: Stream, scope: Scope) -> bool:
    """Whether the hand that a client commands is far from the commanded q."""
    return any(
        _far(hand, state, command)
        for hand in _hands(view, scope)
        if hand.role.dialect is part.role.dialect
        and hand.role.sides == part.role.sides
        and (state := view.stream(hand.endpoint)) is not None
    )


def _waiting(seen: Observations, view: DomainView) -> Iterator[Finding]:
    """Clients of the body and of other hands whose state does not come."""
    readers = _awaiting(view)
    for one in awaited(e.topic for e in readers):
        topic = one.topic
        here = [e for e in readers if e.topic == topic]
        writers = [e for e in view.endpoints if e.kind == "writer" and e.topic == topic]
        who = " and ".join(sorted({view.owner(e) for e in here}))
        kinds = " or ".join(sorted({short(e.type_name) for e in here}))
        elsewhere = [
            (other.number, other.owner(e))
            for other in seen.domains
            for e in other.endpoints
            if other is not view and e.kind == "writer" and e.topic == topic
        ]
        if not writers and elsewhere:
            number, publisher = elsewhere[0]
            yield _finding(
                "DDS-OTHER-DOMAIN",
                f"{publisher} publishes {topic} on domain {number}; {who} waits for it on domain "
                f"{view.number}",
                fix=f"start the client on domain {number}, or its publisher on {view.number}: "
                "xr_teleoperate uses domain 0, and 1 with --sim",
                domain=view.number,
                topic=topic,
            )
        elif not writers:
            if any(_instead(view, role.dialect) for role in roles(topic)):
                continue  # that another hand is there is reported
            yield _finding(
                "DDS-UNPUBLISHED",
                f"{who} waits for {topic} ({kinds}) on domain {view.number}: no process publishes "
                f"it; {one.publisher} does, {_place(one)}",
                fix=_remedy(one, view, here),
                domain=view.number,
                topic=topic,
            )
        for writer in writers:
            stream = view.stream(writer)
            others = [e for e in here if e.type_name != writer.type_name]
            if len(others) == len(here):
                yield _finding(
                    "DDS-TYPE",
                    f"{topic} on domain {view.number}: {view.owner(writer)} publishes "
                    f"{short(writer.type_name)}; {who} reads {kinds}",
                    fix="select the robot that is there in the client (xr_teleoperate: --arm): G1, "
                    "H1-2, H2 and R1 use unitree_hg, H1, Go2 and B2 unitree_go",
                    domain=view.number,
                    topic=topic,
                )
            elif stream is not None and stream.seconds > 0 and not stream.samples:
                yield _finding(
                    "DDS-SILENT",
                    f"{topic} of {view.owner(writer)} on domain {view.number}: no sample in "
                    f"{stream.seconds:.1f} s",
                    fix=f"check {view.owner(writer)}: {one.publisher} publishes {topic}",
                    domain=view.number,
                    topic=topic,
                )


def _place(one: Awaited) -> str:
    if one.simulation:
        return "on domain 1; no robot does"
    return f"on domain 0, on the robot's network ({ROBOT_NETWORK}x)"


def _remedy(one: Awaited, view: DomainView, readers: Iterable[Endpoint]) -> str:
    """Advice if no process publishes the state that clients wait for."""
    if one.simulation:
        return "start the simulator on this domain, or the client without --sim"
    parts = []
    if view.number == 0:
        ends = [view.participant(e.participant) for e in readers]
        places = sorted({a for p in ends if p for a in p.addresses})
        if places and not _robot(places):
            parts.append(
                f"the client is at {', '.join(places)}: name its interface in the robot's network "
                "(xr_teleoperate 1.5: --network-interface)"
            )
        parts.append(f"check {one.publisher}")
    else:
        parts.append(
            f"the client is on domain {view.number}, the robot on 0: start it without --sim, or "
            "the simulator on this domain"
        )
    if one.emulators:
        to = " or ".join(f"'{command} --domain {view.number}'" for command in one.emulators)
        parts.append(f"without a robot: {to}")
    return "; ".join(parts)


def _command(view: DomainView, hand: _Part, scope: Scope) -> Stream | None:
    """The commands that a client sends to a hand."""
    for part in _parts(view, "writer", "cmd", scope):
        if part.role.dialect is hand.role.dialect and part.role.sides == hand.role.sides:
            stream = view.stream(part.endpoint)
            if stream is not None and stream.samples:
                return stream
    return None


def _absent(
    seen: Observations, focus: list[DomainView], scope: Scope, *, explained: bool
) -> Iterator[Finding]:
    """State topics that a client needs and that are missing."""
    everything = Scope()
    wanted = _wanted(focus, scope)
    # a hand and a client on different domains
    elsewhere = [p for v in seen.domains if v not in focus for p in _hands(v, scope)]
    apart = False
    if scope.domain is None:
        for view in focus:
            clients = [p for p in _clients(view, scope) if p.endpoint.kind == "reader"]
            needed = {p.role.dialect.name for p in clients}
            served = {p.role.dialect.name for p in _hands(view, everything)}
            others = [
                p
                for v in focus
                if v is not view
                for p in _hands(v, scope)
                if p.role.dialect.name in needed - served
            ]
            if others:
                apart = True
                yield _other_domain(others, f"{clients[0].who} waits on domain {view.number}")
    hands = [p for v in focus for p in _hands(v, scope)]
    if not hands and elsewhere:
        apart = True
        asked = " and ".join(str(v.number) for v in focus)
        yield _other_domain(elsewhere, f"no process publishes a hand's state on domain {asked}")
    if scope.domain is None and hands and not apart:
        odd = [p for p in _first(hands) if p.view.number > 1]
        if odd and not any(_clients(v, scope) for v in focus):
            yield _other_domain(
                odd, "xr_teleoperate looks at domain 0, or 1 with --sim", Severity.WARNING
            )
    for view in focus:
        here = _hands(view, everything)
        names = {p.role.dialect.name for p in here}
        needed_dialects = [
            d
            for d in (scope.dialects or wanted)
            if scope.dialects
            or any(
                p.role.dialect is d and p.endpoint.kind == "reader" for p in _clients(view, scope)
            )
        ]
        for dialect in needed_dialects:
            if dialect.name in names:
                continue
            others = [p for p in here if p.role.dialect.model == dialect.model]
            same_topic = [p for p in others if p.endpoint.topic in dialect.topics(p.role.sides[0])]
            if others and not same_topic:  # a type that differs is reported as that
                explained = True
                other = others[0]
                yield _finding(
                    "DDS-OTHER-STACK",
                    f"{other.who} publishes {other.endpoint.topic} "
                    f"({other.role.dialect.name}) on domain {view.number}; the client needs "
                    f"{dialect.topics(Side.LEFT)[1]} ({dialect.name})",
                    fix=f"'dexkit serve ... --dialect {dialect.name}', or a client of "
                    f"{other.role.dialect.name}",
                    domain=view.number,
                    topic=other.endpoint.topic,
                )
            elif (instead := _instead(view, dialect)) is not None:
                explained = True
                yield _other_hand(view, dialect, instead)
        for dialect in wanted:
            parts = [p for p in _hands(view, scope) if p.role.dialect is dialect]
            sides = {side for p in parts for side in p.role.sides}
            if len(sides) == 1:
                (there,) = sides
                other_side = Side.RIGHT if there is Side.LEFT else Side.LEFT
                is_read = other_side in _read_sides(view, dialect)
                backend = simulators().get(dialect.model, "BACKEND")
                replacement = (
                    f"'dexkit serve {backend} --side {other_side} --domain {view.number}' replaces "
                    "a missing one"
                )
                yield _finding(
                    "DDS-ONE-SIDE",
                    f"domain {view.number} has {dialect.topics(there)[1]}, but not "
                    f"{dialect.topics(other_side)[1]}"
                    + ("" if is_read else ", which no process reads"),
                    fix=f"start the other hand too; {replacement}"
                    if is_read
                    else f"nothing, for one hand; for a client of both, {replacement}",
                    severity=None if is_read else Severity.NOTE,
                    domain=view.number,
                    topic=dialect.topics(other_side)[1],
                )
    if not hands and not explained and not apart:
        people = sum(len(v.participants) for v in focus)
        numbers = ", ".join(str(v.number) for v in seen.domains)
        which = " and ".join(str(v.number) for v in focus) or numbers
        who = {0: "is no process", 1: "is one other process"}.get(people, f"are {people} others")
        # a client of the body or of other hands may need no Dex hand
        other_clients = any(_awaiting(v) and not _clients(v, scope) for v in focus)
        yield _finding(
            "DDS-NOBODY",
            f"there {who} on domain {which}, and no hand on any domain looked at ({numbers}) "
            f"on {', '.join(seen.examined)}",
            fix=_elsewhere(seen),
            severity=Severity.NOTE
            if scope.devices_only or (other_clients and not wanted)
            else None,
        )


def _instead(view: DomainView, dialect: Dialect) -> _Part | None:
    """A hand of another model than the dialect's, without a client for that model."""
    served = _hands(view, Scope())
    if any(p.role.dialect.model == dialect.model for p in served):
        return None
    asked = {p.role.dialect.model for p in _clients(view, Scope())}
    return next((p for p in served if p.role.dialect.model not in asked), None)


def _client_option(hand: HandModel) -> str:
    """A hand's name in xr_teleoperate's ``--ee``."""
    short = next(name for name, each in short_names().items() if each is hand)
    return teleop_hand(hand.name).option or short


def _other_hand(view: DomainView, dialect: Dialect, instead: _Part) -> Finding:
    wanted, there = MODELS[dialect.model], MODELS[instead.role.dialect.model]
    readers = _parts(view, "reader", "state", Scope(dialects=(dialect,)))
    return _finding(
        "DDS-OTHER-HAND",
        f"{instead.who} publishes {instead.endpoint.topic} ({there.title}) on domain "
        f"{view.number}; {readers[0].who if readers else 'the client'} waits for "
        f"{dialect.topics(Side.LEFT)[1]} ({wanted.title})",
        fix="select the hand that is there in the client (xr_teleoperate: "
        f"--ee={_client_option(there)}), or serve the other one",
        domain=view.number,
        topic=instead.endpoint.topic,
    )


def _other_domain(parts: list[_Part], instead: str, severity: Severity | None = None) -> Finding:
    part = parts[0]
    where = " and ".join(str(n) for n in sorted({p.view.number for p in parts}))
    return _finding(
        "DDS-OTHER-DOMAIN",
        f"{part.who} publishes {part.endpoint.topic} on domain {where}; {instead}",
        severity=severity,
        domain=part.view.number,
        topic=part.endpoint.topic,
    )


def _elsewhere(seen: Observations) -> str:
    """The remedy when no hand is found: start one, or use another interface."""
    text = DIAGNOSES["DDS-NOBODY"].fix
    others = [
        f"{i.name} ({', '.join(i.addresses)})"
        for i in sorted(seen.interfaces, key=lambda i: not _robot(i.addresses))
        if i.up and i.addresses and i.name not in seen.examined
    ]
    if others:
        text += f"; if it runs elsewhere: --interface NAME, this machine has {', '.join(others)}"
    return text


def _robot(addresses: Iterable[str]) -> bool:
    return any(a.startswith(ROBOT_NETWORK) for a in addresses)


# --- network


def _network(seen: Observations, scope: Scope) -> Iterator[Finding]:
    by_name = {i.name: i for i in seen.interfaces}
    for name in seen.examined:
        known = by_name.get(name)
        if known and not known.loopback and not known.multicast:
            yield _finding(
                "NET-MULTICAST",
                f"{name} ({', '.join(known.addresses)}) has no multicast",
                fix=DIAGNOSES["NET-MULTICAST"].fix.replace("INTERFACE", name),
                interface=name,
            )
    focus = _focus(seen, scope)
    for view in focus:
        hands, clients = _hands(view, scope), _clients(view, scope)
        yield from _apart(view, hands, clients)
        yield from _deaf_loopback(seen, view, hands, clients)
    yield from _hidden(seen, focus)


def _pairs(hands: list[_Part], clients: list[_Part]) -> Iterator[tuple[Participant, Participant]]:
    """Participants of a hand and a client that should talk to each other, each pair once."""
    reported = set()
    for hand, client in product(hands, clients):
        keys = (hand.endpoint.participant, client.endpoint.participant)
        if hand.role.dialect is not client.role.dialect or keys in reported:
            continue
        reported.add(keys)
        ends = [hand.view.participant(key) for key in keys]
        if ends[0] and ends[1] and keys[0] != keys[1]:
            yield ends[0], ends[1]


def _apart(view: DomainView, hands: list[_Part], clients: list[_Part]) -> Iterator[Finding]:
    for hand, client in _pairs(hands, clients):
        local = [all(a.startswith("127.") for a in p.addresses) for p in (hand, client)]
        if hand.addresses and client.addresses and local[0] != local[1]:
            yield _finding(
                "NET-INTERFACE",
                f"on domain {view.number} {hand.name} is at {', '.join(hand.addresses)} and "
                f"{client.name} at {', '.join(client.addresses)}",
                domain=view.number,
            )


def _deaf_loopback(
    seen: Observations, view: DomainView, hands: list[_Part], clients: list[_Part]
) -> Iterator[Finding]:
    name = next((i.name for i in seen.interfaces if i.loopback and not i.multicast), "")
    if not name:
        return
    for ends in _pairs(hands, clients):
        local = all(a.startswith("127.") for p in ends for a in p.addresses)
        calls = any("dexkit" in p.command or "<Peer" in p.dds_config for p in ends)
        if local and all(p.command for p in ends) and not calls:
            yield _finding(
                "NET-LO-MULTICAST",
                f"{name} has no MULTICAST flag, and on domain {view.number} neither "
                f"{ends[0].name} nor {ends[1].name} finds its peers by unicast",
                fix=DIAGNOSES["NET-LO-MULTICAST"].fix.replace("set lo", f"set {name}"),
                domain=view.number,
                interface=name,
            )


def _hidden(seen: Observations, focus: list[DomainView]) -> Iterator[Finding]:
    """Processes of this machine on a domain that did not answer on the observed interface."""
    local = {address for i in seen.interfaces for address in i.addresses}
    for view in focus:
        known = {p.pid for p in view.participants}
        # who announces no process id (Fast DDS) is known by its port
        places = {p for one in view.participants for p in one.places if p[0] in local}
        ports = {port for _, port in places}
        # one of another user has no pid here; it is probably one of those that answered
        hidden = [
            s
            for s in seen.sockets
            if s.domain == view.number
            and s.pid
            and s.pid not in known
            and not ports.intersection((s.port, *s.ports))
        ]
        if not hidden:
            continue
        joined = [i.name for i in seen.interfaces if i.discovery and i.name not in seen.examined]
        on = f"; DDS discovery listens on {', '.join(joined)}" if joined else ""
        names = ", ".join(f"{s.command or 'a process'} (pid {s.pid})" for s in hidden)
        yield _finding(
            "NET-INTERFACE",
            f"{names} on this machine uses domain {view.number} but does not answer on "
            f"{', '.join(seen.examined)}{on}",
            fix="start both sides with the same interface; look there with "
            f"--interface {joined[0] if joined else 'NAME'}",
            severity=Severity.WARNING,
            domain=view.number,
        )


# --- the link to another machine


def _link(link: Link) -> Iterator[Finding]:
    def about(name: str, seen: str, severity: Severity | None = None) -> Finding:
        fix = DIAGNOSES[name].fix.replace("INTERFACE", link.interface).replace("HOST", link.host)
        return _finding(name, seen, fix=fix, severity=severity, host=link.host)

    where = f"{link.host} by {link.interface}"
    if not link.received and not link.samples:
        yield about(
            "LINK-NO-ANSWER", f"none of {link.sent} echoes ({link.method}) to {where} came back"
        )
        return
    if link.loss > _MOST_LOSS:
        parts = [f"{link.sent - link.received} of {link.sent} echoes"]
        if link.samples:
            parts.append(f"{link.lost} of {link.samples + link.lost} samples")
        yield about(
            "LINK-LOSS",
            f"{where} lost {' and '.join(parts)} ({100 * link.loss:.1f} %)",
            severity=Severity.ERROR if link.loss > 10 * _MOST_LOSS else None,
        )
    if link.rtt_median > _MOST_ROUND_TRIP:
        yield about(
            "LINK-LATENCY",
            f"a round trip to {where} takes {1000 * link.rtt_median:.0f} ms (median)",
        )
    if link.rtt_95 - link.rtt_median > _MOST_JITTER:
        yield about(
            "LINK-JITTER",
            f"one round trip in 20 to {where} takes {1000 * link.rtt_95:.0f} ms or more, the "
            f"median is {1000 * link.rtt_median:.0f} ms",
        )
    measured = link.command_age_95 == link.command_age_95
    age = link.command_age_95 if measured else link.rtt_95 - link.rtt_min / 2
    if age > _MOST_COMMAND_AGE:
        how = "measured by their time stamps" if measured else "estimated from the round trips"
        yield about(
            "LINK-AGE",
            f"one command in 20 is {1000 * age:.0f} ms old or more when it arrives ({how})",
        )
    if link.multicast is False:
        yield about(
            "LINK-MULTICAST",
            f"{link.participants} participants at {where} answer to unicast, none to multicast",
        )
    if abs(link.clock_offset) > _MOST_CLOCK_OFFSET:
        ahead = "ahead of" if link.clock_offset > 0 else "behind"
        yield about(
            "LINK-CLOCK",
            f"the clock of {link.host} is {abs(link.clock_offset):.3f} s {ahead} this machine's",
        )
    if link.dropped or 0 < link.rmem_max < _LEAST_BUFFER:
        seen = f"net.core.rmem_max is {link.rmem_max} bytes"
        if link.dropped:
            seen += f"; {link.dropped} datagrams found a full buffer meanwhile"
        yield about("LINK-BUFFER", seen)


# --- environment


def _environment(env: Environment) -> Iterator[Finding]:
    if not env.cyclonedds:
        yield _finding(
            "ENV-CYCLONEDDS-MISSING", f"Python {env.python} on {env.machine} has no cyclonedds"
        )
    elif not env.cyclonedds.startswith("0.10."):
        yield _finding("ENV-CYCLONEDDS-11", f"cyclonedds {env.cyclonedds} is installed")
    elif env.cyclonedds_error:
        yield _finding(
            "ENV-CYCLONEDDS-BROKEN", f"cyclonedds {env.cyclonedds}: {env.cyclonedds_error}"
        )
    if env.uri_error:
        yield _finding("ENV-URI", f"CYCLONEDDS_URI={env.uri}: {env.uri_error}")
    if env.sdk_error:
        yield _finding("ENV-SDK", f"version {env.sdk}: {env.sdk_error}")


# --- serial


def _serial(port: SerialPort) -> Iterator[Finding]:
    path = port.path
    if not port.exists:
        yield _finding("SERIAL-MISSING", f"there is no {path}", path=path)
        return
    if not port.readable:
        group = f"; it belongs to the group {port.group}" if port.group else ""
        fix = DIAGNOSES["SERIAL-PERMISSION"].fix.replace("dialout", port.group or "dialout")
        yield _finding("SERIAL-PERMISSION", f"no permission to use {path}{group}", fix, path=path)
    served = [h for h in port.holders if "dexkit" in h and "serve" in h]
    if port.holders and port.named:
        yield _finding(
            "SERIAL-BUSY",
            f"{path} is open in {', '.join(port.holders)}"
            + ("; that is a dexkit service, as expected; nothing was sent" if served else ""),
            severity=Severity.NOTE if served and len(port.holders) == 1 else None,
            path=path,
        )
    elif port.error:
        yield _finding("SERIAL-NOT-A-PORT", f"{path}: {port.error}", path=path)
    if port.latency_timer is not None and port.latency_timer > 1:
        name = path.rpartition("/")[2]
        yield _finding(
            "SERIAL-LATENCY",
            f"the latency timer of {path} is {port.latency_timer} ms",
            fix=DIAGNOSES["SERIAL-LATENCY"].fix.replace("NAME", name),
            path=path,
        )
    if not port.asked:
        return
    old = [s for s in port.servos if s.protocol == 1]
    new = [s for s in port.servos if s.protocol == 2]
    for servo in old:
        yield _finding(
            "SERIAL-PROTOCOL-1",
            f"id {servo.id} (model {servo.model}) on {path} at {servo.baudrate} baud",
            path=path,
        )
    for servo in new:
        if servo.model == mx64.MODEL_PROTOCOL_1:
            yield _finding("SERIAL-PROTOCOL-1", f"id {servo.id} on {path} is an MX-64", path=path)
        elif servo.model != mx64.MODEL:
            yield _finding(
                "SERIAL-OTHER-SERVO",
                f"id {servo.id} on {path} is model {servo.model}, not {mx64.MODEL}",
                path=path,
            )
        elif servo.baudrate != _DRIVER_BAUD:
            yield _finding(
                "SERIAL-BAUD",
                f"id {servo.id} on {path} answers at {servo.baudrate} baud, not {_DRIVER_BAUD}",
                path=path,
            )
    if not port.servos:
        yield _finding("SERIAL-NO-ANSWER", f"no servo answers on {path}", path=path)


# --- USB


def _usb(seen: Observations) -> Iterator[Finding]:
    if seen.usb_wanted and not seen.usb:
        yield _finding("USB-MISSING", "no Dex3-1 is on this machine's USB")
    for device in seen.usb:
        yield from _usb_device(device)


def _usb_device(device: UsbDevice) -> Iterator[Finding]:
    what = f"the {device.side + ' ' if device.side else ''}hand at {device.where}"
    if device.error:
        yield _finding("USB-UNREACHABLE", f"{device.where}: {device.error}", device=device.where)
        return
    if not device.writable:
        yield _finding(
            "USB-PERMISSION",
            f"{what}: {device.node} may not be written",
            fix=f'echo \'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{dex3_usb.VENDOR_ID:04x}", '
            'MODE="0660", GROUP="plugdev", TAG+="uaccess"\' | sudo tee '
            "/etc/udev/rules.d/70-dex3.rules; sudo udevadm control --reload; plug it in again",
            device=device.where,
        )
    kernel = [d for d in device.drivers if d not in ("usbfs",)]
    if kernel:
        yield _finding(
            "USB-DRIVER",
            f"{what} is bound to the driver {', '.join(kernel)}",
            fix=f"echo {device.where}:1.0 | sudo tee /sys/bus/usb/drivers/{kernel[0]}/unbind; "
            "dexkit detaches it by itself when it may use the device",
            device=device.where,
        )
    served = [h for h in device.holders if "dexkit" in h and "serve" in h]
    if device.holders and not served:
        yield _finding(
            "USB-BUSY", f"{what} is open in {', '.join(device.holders)}", device=device.where
        )
