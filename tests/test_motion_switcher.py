"""The MotionSwitcher service of the emulated robots, and the messages of Unitree's services."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dexkit.emulators.robot import MotionSwitcher
from dexkit.errors import EncodeError, UsageError, WireError
from dexkit.messages import decode, encode, message_type, message_types
from dexkit.messages.layout import IdlError, parse
from dexkit.messages.unitree_api import (
    Request_,
    RequestHeader_,
    RequestIdentity_,
    RequestPolicy_,
    Response_,
)
from tests.each import each
from tests.messages_helpers import SERVICE_NAMES, messages

REQUEST = SERVICE_NAMES[0]


def request(api: int, parameter: str = "{}", *, noreply: bool = False) -> Request_:
    identity, policy = RequestIdentity_(7, api), RequestPolicy_(0, noreply)
    return Request_(RequestHeader_(identity, policy=policy), parameter)


def ask(switcher: MotionSwitcher, api: int, parameter: str = "{}") -> tuple[int, str]:
    response = switcher.answer(request(api, parameter))
    assert response is not None
    assert response.header.identity == RequestIdentity_(7, api)
    return response.header.status.code, response.data


def test_no_program_is_selected_at_first_and_after_a_release() -> None:
    switcher = MotionSwitcher()
    none = 0, '{"form": "0", "name": ""}'
    assert ask(switcher, 1001) == none
    for name, form in (("ai", "0"), ("normal", "0"), ("advanced", "0"), ("ai-w", "1")):
        assert ask(switcher, 1002, json.dumps({"name": name})) == (0, "")
        code, data = ask(switcher, 1001)
        assert (code, json.loads(data)) == (0, {"form": form, "name": name})
        assert ask(switcher, 1003) == (0, "")
        assert ask(switcher, 1001) == none


def test_motion_switcher_answers_its_other_requests() -> None:
    switcher = MotionSwitcher()
    assert ask(switcher, 1) == (0, "1.0.0.1")
    assert ask(switcher, 1005) == (0, '{"silent": false}')
    assert ask(switcher, 1004, '{"silent": true}') == (0, "")
    assert ask(switcher, 1005) == (0, '{"silent": true}')
    assert switcher.answer(request(1002, '{"name": "ai"}', noreply=True)) is None
    assert switcher.name == "ai"


@each(
    ("api", "parameter", "code"),
    [
        (1006, "{}", 3203),
        (-1, "", 3203),
        (1002, '{"name": "dance"}', 7004),
        (1002, "no json", 7001),
        (1002, "[" * 100_000, 7001),
        (1002, "[]", 7001),
        (1002, '{"name": 3}', 7001),
        (1004, '{"silent": "yes"}', 7001),
    ],
)
def test_motion_switcher_answers_invalid_requests_with_error_codes(
    api: int, parameter: str, code: int
) -> None:
    switcher = MotionSwitcher()
    assert ask(switcher, api, parameter) == (code, "")
    assert switcher.name == ""


# ------------------------------------------------------------------------- messages

any_service = st.sampled_from(SERVICE_NAMES).flatmap(lambda n: st.tuples(st.just(n), messages(n)))


@given(any_service, st.data())
def test_damaged_samples_raise_nothing_but_wire_errors(
    pair: tuple[str, Request_ | Response_], data: st.DataObject
) -> None:
    name, message = pair
    sample = encode(message)
    assert decode(name, sample) == decode(name, memoryview(sample)) == message
    damaged = bytearray(sample)
    damaged[data.draw(st.integers(0, len(sample) - 1))] = data.draw(st.integers(0, 255))
    for some in (bytes(damaged), sample[: data.draw(st.integers(0, len(sample) - 1))]):
        try:
            decode(name, some)
        except WireError:
            pass


@each(
    ("tail", "problem"),
    [
        (b"\x00\x00\x00\x00" + bytes(4), "only zero"),
        (b"\x02\x00\x00\x00ab" + bytes(6), "only zero"),
        (b"\x03\x00\x00\x00a\x00\x00" + bytes(5), "only zero"),
        (b"\x02\x00\x00\x00\xff\x00" + bytes(6), "not UTF-8"),
        (b"\xff\xff\xff\x7f", "at most 65536"),
        (b"\x09\x00\x00\x00ab\x00", "needs at least"),
    ],
)
def test_invalid_strings_are_refused(tail: bytes, problem: str) -> None:
    with pytest.raises(WireError, match=problem):
        decode(REQUEST, b"\x00\x01\x00\x00" + bytes(32) + tail)


@each(
    ("message", "problem"),
    [
        (Request_(parameter="a\0b"), "parameter cannot be sent as a string: a zero inside"),
        (Request_(parameter="x" * 65536), "too many bytes"),
        (Request_(parameter="\ud800"), "parameter cannot be sent as a string"),
        (Request_(binary="text"), "binary is a str, not a sequence of bytes"),  # type: ignore[arg-type]
        (Request_(RequestHeader_(RequestIdentity_(2**63))), "does not fit int64"),
    ],
)
def test_unsendable_values_are_named(message: Request_, problem: str) -> None:
    with pytest.raises(EncodeError, match=problem):
        encode(message)


def test_services_have_no_columns_and_are_no_types_of_recordings() -> None:
    kind = message_type(REQUEST)
    assert kind not in message_types()
    assert "string parameter" in kind.ros2msg
    assert "sequence<octet> binary;" in kind.omgidl
    assert "  string parameter;" in kind.omgidl
    with pytest.raises(UsageError, match="no columns"):
        kind.columns([])


@each(
    "members",
    [
        "string a[2];",
        "sequence<string> a;",
        "sequence<float> a;",
        "string a; uint8 b;",
        "sequence<E> a; string b;",
        "sequence<L> a;",
    ],
)
def test_text_outside_the_subset_is_refused(members: str) -> None:
    inner = "@final struct E { uint32 a; }; @final struct L { int64 a; };"
    with pytest.raises(IdlError):
        parse(f"module a {{ module b {{ {inner} @final struct X {{ {members} }}; }}; }};")


# ------------------------------------------------------------------------- Unitree's client


@pytest.mark.skipif(find_spec("cyclonedds") is None, reason="needs CycloneDDS")
@pytest.mark.skipif(find_spec("unitree_sdk2py") is None, reason="needs the unitree-sdk2 package")
def test_unitrees_client_is_answered() -> None:
    from dexkit.emulators.robot import EmulatedRobot
    from dexkit.robots import G1
    from tests.dds_helpers import free_domain
    from tests.unitree_sdk import SdkClient

    domain = free_domain()
    with EmulatedRobot(G1, domain=domain) as robot, SdkClient(domain) as sdk:
        calls = [(1001, "{}"), (1002, '{"name": "ai"}'), (1001, "{}"), (1003, "{}"), (1006, "{}")]
        answers = [sdk.request("motion_switcher", api, parameter) for api, parameter in calls]
        assert answers == [
            (0, '{"form": "0", "name": ""}'),
            (0, ""),
            (0, '{"form": "0", "name": "ai"}'),
            (0, ""),
            (3203, ""),
        ]
        assert robot.switcher.requests == len(calls)
