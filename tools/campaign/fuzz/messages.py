"""DDS messages: CDR, columns of many, what service and bridge make of them; discovery; schemas."""

from __future__ import annotations

import random
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dexkit.bridge.forwarding import Commands, States
from dexkit.clock import ManualClock
from dexkit.doctor import dds as doctor_dds
from dexkit.doctor import rtps
from dexkit.doctor.observer import Observer
from dexkit.doctor.rtps import Data, Locator
from dexkit.emulators.robot import RobotMechanics
from dexkit.emulators.robot.settings import Remote
from dexkit.errors import WireError
from dexkit.hand import JointMode, Side
from dexkit.messages import layout, message_type, message_types
from dexkit.messages.columns import Columns
from dexkit.models import DIALECTS, model
from dexkit.service.dialects import dialect_map
from dexkit.service.hand_core import HandCore
from dexkit.teleop.client_codec import ClientCodec
from dexkit.traces import schemas
from tools.campaign.fuzz.case import Difference, FuzzCase, Target
from tools.campaign.mutate import TextMutator, mutator

__all__ = ["announcements", "cases", "filled"]

_FLOATS = (0.0, 1.5, -2.0, float("nan"), float("inf"), 3e38, -1e-30)


def filled(name: str, rng: random.Random) -> Any:
    """A message of a type with something in every member, sequences of 0 to 3 elements."""
    return _value(layout.STRUCTS[name], rng)


def _value(kind: Any, rng: random.Random) -> Any:
    if isinstance(kind, layout.Struct):
        message = message_type(kind.dds_name).cls()
        for member in kind.fields:
            if member.sequence:
                items = [_value(member.type, rng) for _ in range(rng.randrange(4))]
                setattr(message, member.name, items)
            elif member.array is not None:
                items = [_value(member.type, rng) for _ in range(member.array)]
                setattr(message, member.name, items)
            else:
                setattr(message, member.name, _value(member.type, rng))
        return message
    if kind.python == "float":
        return rng.choice(_FLOATS)
    return rng.getrandbits(7)


def _samples(name: str, rng: random.Random, count: int = 4) -> list[bytes]:
    kind = message_type(name)
    return [kind.encode(filled(name, rng)) for _ in range(count)]


def _cdr(name: str) -> Callable[[random.Random, Path], Target]:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        kind = message_type(name)
        encode, decode = kind.encode, kind.decode

        def run(data: bytes) -> None:
            message = decode(data)
            again = encode(message)
            if encode(decode(again)) != again:
                raise Difference("decoded, encoded, decoded, encoded")

        return Target(mutator(_samples(name, rng), rng), run, (WireError,))

    return prepare


def _columns(rng: random.Random, scratch: Path) -> Target:
    """Columns of ten samples must equal decoding one by one."""
    name = rng.choice([m.name for m in message_types()])
    kind = message_type(name)
    good = _samples(name, rng)
    damaged = mutator(good, rng)

    def make() -> list[bytes]:
        return [damaged() if rng.getrandbits(1) else good[i & 3] for i in range(10)]

    def run(payloads: list[bytes]) -> None:
        columns = Columns(layout.STRUCTS[name], payloads)
        for row, payload in enumerate(payloads):
            try:
                kind.decode(payload)
                fine = True
            except WireError:
                fine = False
            if fine is (row in columns.errors):
                raise Difference(f"{name}: row {row}: {columns.errors.get(row)!r}: {payload.hex()}")

    return Target(make, run, ())


def _service(rng: random.Random, scratch: Path) -> Target:
    """A command as the service takes it: decoded, mapped, gated, and what goes to the hand."""
    spoken = rng.choice(list(DIALECTS.values()))
    hand = model(spoken.model)
    specs = {s: hand.spec(s, io_rate=500.0, simulated=True) for s in Side}
    if spoken.length == 1 or len(hand.joints[Side.LEFT]) > 1:
        specs = {Side.LEFT: specs[Side.LEFT]}
    mapped = dialect_map(spoken, specs)
    kind = message_type(spoken.cmd_type)
    clock = ManualClock()
    core = HandCore(specs[Side.LEFT], hand, clock)
    core.opened(specs[Side.LEFT])
    low, high = specs[Side.LEFT].q_min - 1e-9, specs[Side.LEFT].q_max + 1e-9

    def run(data: bytes) -> None:
        clock.advance(0.002)
        message = kind.decode(data)
        command = mapped.command(message, Side.LEFT)
        mapped.remarks(message, Side.LEFT)
        if command is not None:
            core.submit(command)
        out = core.next_command()
        driven = out.mode != JointMode.BRAKE
        numbers = np.concatenate((out.q, out.dq, out.tau, out.kp, out.kd))
        if not np.isfinite(numbers).all():
            raise Difference(f"not finite: {out}")
        if ((out.q < low) | (out.q > high))[driven].any():
            raise Difference(f"beyond the limits: {out.q}")

    return Target(mutator(_samples(spoken.cmd_type, rng), rng), run, (WireError,))


def _bridge(rng: random.Random, scratch: Path) -> Target:
    pairs = [
        (a, b)
        for a in DIALECTS.values()
        for b in DIALECTS.values()
        if a.model == b.model and a is not b
    ]
    source, target = rng.choice(pairs)
    states = States(target, source, list(Side))
    commands = Commands(source, target, list(Side), states)
    down, up = _samples(source.cmd_type, rng), _samples(target.state_type, rng)
    first, second = mutator(down, rng), mutator(up, rng)
    now = [0.0]

    def make() -> bytes:
        return first() if rng.getrandbits(1) else second()

    def run(data: bytes) -> None:
        now[0] += 0.001
        for way, made in ((commands, target.cmd_type), (states, source.state_type)):
            for topic in way.inputs:
                for out in [*way.receive(topic, data, now[0]), *way.flush(now[0])]:
                    message_type(made).decode(out.payload)

    return Target(make, run, ())


def _teleop(rng: random.Random, scratch: Path) -> Target:
    spoken = rng.choice(list(DIALECTS.values()))
    wire = ClientCodec(spoken)
    topics = list(wire.state_topics.values())

    def run(data: bytes) -> None:
        for topic in topics:
            wire.positions(topic, data)

    return Target(mutator(_samples(spoken.state_type, rng), rng), run, (WireError,))


def _robot(name: str) -> Callable[[random.Random, Path], Target]:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        from dexkit.robots import robot
        from dexkit.wire.low_level import encode_with_crc

        chosen = robot(name)
        emulated = RobotMechanics(chosen)
        message = filled(chosen.cmd_type, rng)
        good = [encode_with_crc(message), encode_with_crc(message_type(chosen.cmd_type).cls())]
        now = [0.0]

        def run(data: bytes) -> None:
            now[0] += 1e-4
            emulated.command(data, now[0])

        return Target(mutator(good, rng), run, ())

    return prepare


# --- discovery


def announcements(rng: random.Random) -> list[bytes]:
    """Announcements of participants and endpoints, with text of every kind in them."""
    texts = ("python", "", "\u00b2", "9" * 30, "-1", "\x1b[31m", "a" * 300, "\u0661", "0")
    place = Locator("127.0.0.1", 7411)
    found = []
    for _ in range(8):
        properties = {
            "__ProcessName": rng.choice(texts),
            "__Pid": rng.choice((*texts, "4711")),
            "__Hostname": rng.choice((*texts, socket.gethostname())),
        }
        found.append(
            rtps.build_participant(rng.randbytes(12), place, lease=10, properties=properties)
        )
    found += [
        rtps.build_endpoint(rng.randbytes(16), topic, "unitree_go::msg::dds_::MotorCmds_")
        for topic in ("rt/dex1/left/cmd", "", "rt/\u00e9", "x" * 200)
    ]
    return found


def _rtps_packet(rng: random.Random, scratch: Path) -> Target:
    packets = []
    for payload in announcements(rng):
        for writer in (rtps.SPDP_WRITER, rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS):
            packets.append(rtps.message(rng.randbytes(12), rtps.build_data(writer, 1, payload)))
    acknack = rtps.build_acknack(
        rtps.SEDP_PUBLICATIONS, 1, [1, 3], 1, destination=rng.randbytes(12), final=True
    )
    packets.append(
        rtps.message(rng.randbytes(12), rtps.build_heartbeat(rtps.SEDP_PUBLICATIONS, 1, 5, 1))
    )
    packets.append(rtps.message(rng.randbytes(12), acknack))

    def run(data: bytes) -> None:
        _, items = rtps.parse_message(data)
        for _, item in items:
            if isinstance(item, Data) and item.payload:
                for read in (
                    rtps.parse_participant,
                    lambda p: rtps.parse_endpoint(p, writer=True),
                ):
                    try:
                        read(item.payload)
                    except WireError:
                        pass

    return Target(mutator(packets, rng), run, (WireError,))


def _rtps_announcement(rng: random.Random, scratch: Path) -> Target:
    """Parse an announcement as the doctor does, with the name of the participant."""

    def run(data: bytes) -> None:
        found = rtps.parse_participant(data)
        doctor_dds._participant(found, "lo")

    return Target(mutator(announcements(rng), rng), run, (WireError,))


def _observer(rng: random.Random, scratch: Path) -> Target:
    me = bytes(range(12))

    def fresh() -> Observer:
        place = Locator("127.0.0.1", 4711)
        return Observer(me, place, wanted=lambda topic, kind: len(topic) % 2 == 0)

    state: list[Any] = [fresh(), 0]
    whose = [rng.randbytes(12) for _ in range(4)]
    packets = []
    for payload in announcements(rng):
        for writer in (rtps.SPDP_WRITER, rtps.SEDP_PUBLICATIONS, rtps.SEDP_SUBSCRIPTIONS):
            data = rtps.build_data(writer, 1, payload)
            packets.append(rtps.message(rng.choice(whose), data))
    for number in range(3):
        heartbeat = rtps.build_heartbeat(rtps.SEDP_PUBLICATIONS, 1, 5 * number, number)
        packets.append(rtps.message(rng.choice(whose), heartbeat))

    def run(data: bytes) -> None:
        if state[1] >= 500:
            state[:] = [fresh(), 0]
        state[1] += 1
        now = state[1] * 0.01
        sent = state[0].receive(data, now, "127.0.0.1")
        if state[1] % 50 == 0:
            sent += state[0].tick(now)
        if len(sent) > 200:
            raise Difference(f"{len(sent)} packets in answer to one")

    return Target(mutator(packets, rng), run, ())


# --- schemas and names

_MSG_WORDS = (
    "float32", "uint8", "int64", "string", "bool", "[", "]", "[]", "[<=3]", "[20]", "[-1]",
    "[99999999999]", "MSG: a/B", "=" * 80, "#", "\n", "\n\n", " ", "unitree_go/MotorCmd", "=1",
    "wstring<=4", "time", "a/b/c",
)  # fmt: skip
_IDL_WORDS = (
    "module", "struct", "sequence<", ">", "{", "}", ";", "[", "]", "[7]", "unsigned", "long",
    "long long", "float", "octet", "typedef", "const", "enum", "union", "@key", "//", "/*", "*/",
    "#pragma", "::", "string<3>", "a::b::C", "\n", "MotorCmd_", "sequence<sequence<",
)  # fmt: skip


def _schema(encoding: str) -> Callable[[random.Random, Path], Target]:
    def prepare(rng: random.Random, scratch: Path) -> Target:
        ros = encoding == "ros2msg"
        texts = [m.ros2msg if ros else m.omgidl for m in message_types()]
        text = TextMutator(texts, _MSG_WORDS if ros else _IDL_WORDS, rng)
        name = message_types()[0].name
        return Target(text, lambda given: schemas.parse(encoding, name, given))

    return prepare


def _remote(rng: random.Random, scratch: Path) -> Target:
    text = TextMutator(["A,R1,lx=0.5", "", "L2,ry=-1"], ["B", "lx=", "=", ",", "nan"], rng)
    return Target(text, lambda given: Remote.parse(given).bits)


def cases() -> list[FuzzCase]:
    """Every fuzzer of this module."""
    found = [
        FuzzCase(
            f"cdr.{_short(m.name)}", f"payloads of {_short(m.name)}", _cdr(m.name),
        )
        for m in message_types()
    ]  # fmt: skip
    return [
        *found,
        FuzzCase("columns", "samples as columns, against one by one", _columns),
        FuzzCase("service.command", "a command through the service's core", _service),
        FuzzCase("bridge", "both ways of the bridge", _bridge),
        FuzzCase("teleop.state", "a state as the teleoperation client reads it", _teleop),
        FuzzCase("robot.h1", "a command to the emulated H1", _robot("h1")),
        FuzzCase("robot.g1", "a command to the emulated G1", _robot("g1")),
        FuzzCase("rtps.packet", "RTPS packets as the doctor reads them", _rtps_packet),
        FuzzCase("rtps.announcement", "an announcement, and the name in it",
                 _rtps_announcement),
        FuzzCase("rtps.observer", "the doctor's observer", _observer),
        FuzzCase("schema.ros2msg", "schemas of recordings", _schema("ros2msg")),
        FuzzCase("schema.omgidl", "schemas of recordings", _schema("omgidl")),
        FuzzCase("remote", "keys of the emulated remote", _remote),
    ]  # fmt: skip


def _short(name: str) -> str:
    package, _, rest = name.partition("::")
    return f"{package}.{rest.rpartition('::')[2]}"
