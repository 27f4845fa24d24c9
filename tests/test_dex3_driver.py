"""The Dex3-1's USB driver: discovery, opening, exchanging, faults. No process but this one."""

from __future__ import annotations

import errno
import logging
import re
import socket
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import usb.backend.libusb1
from hypothesis import given
from hypothesis import strategies as st
from usb.core import USBError, USBTimeoutError

from dexkit.backends import BackendOptions
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb, Server, discovery, find_hand
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.drivers.dex3_usb.link import UsbLink
from dexkit.drivers.dex3_usb.settings import from_options
from dexkit.errors import (
    HandError,
    HandLost,
    HandNotFound,
    HandRefused,
    HandTimeout,
    UsageError,
)
from dexkit.hand import HandCommand, JointMode, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.usbip import Connection
from dexkit.wire.dex3_usb import (
    COMMAND_734,
    COMMAND_1234,
    PRODUCT_ID,
    VENDOR_ID,
    HandCodec,
    parse_command,
)
from tests.dex3_driver_helpers import (
    Answer,
    FakeBackend,
    FakeHand,
    RawDevice,
    serving,
    usb_error,
)
from tests.each import each
from tests.patience import PATIENCE, waits_of

GO = HandCommand.position(np.full(7, 0.1), kp=1.5, kd=0.2)
QUICK = Dex3Settings(timeout=0.05, send_timeout=0.05)
SHORT = 0.1
"""Seconds for hands that shall be silent for longer."""


@pytest.fixture
def no_usb(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This machine has libusb and no device, and nothing serves the default port."""
    empty = FakeBackend(FakeHand())
    monkeypatch.setattr(empty, "enumerate_devices", list)
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: empty)
    with socket.socket() as taken:  # bound and not listening: refuses connections
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setattr(discovery, "LOCAL_SERVER", Server("127.0.0.1", taken.getsockname()[1]))
        yield


def at(server: Any) -> Server:
    return parse_server(server.url)[0]


def hand_on(server: Any, timeout: float = 5.0, **values: Any) -> Dex3Usb:
    """A hand whose answers come in the end, on a busy machine too; SHORT where they do not."""
    return Dex3Usb(
        Side.LEFT, Dex3Settings(server=at(server), timeout=timeout, send_timeout=timeout, **values)
    )


def fake_hand(fake: FakeBackend, monkeypatch: pytest.MonkeyPatch) -> Dex3Usb:
    monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: fake)
    return Dex3Usb(Side.LEFT, QUICK)


def _to_the_deadline(connection: Connection, deadline: float) -> float:
    return max(1e-3, deadline - time.monotonic())


class TestAddress:
    def test_usbip_address_has_host_and_optional_port_and_serial_number(self) -> None:
        assert parse_server("usbip://robot") == (Server("robot", 3240), None)
        assert parse_server("usbip://10.0.0.5:99/S1") == (Server("10.0.0.5", 99), "S1")
        assert parse_server("usbip://[::1]:99") == (Server("::1", 99), None)
        assert str(Server("::1", 99)) == "usbip://[::1]:99"

    @each(
        "text",
        ["robot", "http://robot", "usbip://", "usbip://h:x", "usbip://h/a/b", "usbip://h?x=1"],
    )
    def test_other_addresses_are_refused_with_an_example(self, text: str) -> None:
        with pytest.raises(UsageError) as caught:
            parse_server(text)
        assert "usbip://" in caught.value.hint


class TestSettings:
    def options(self, device: str | None = None, **settings: str) -> BackendOptions:
        return BackendOptions(Side.LEFT, device, settings)

    def test_all_settings_are_read(self) -> None:
        found = from_options(
            self.options(
                "S1",
                usb="usbip://h:1",
                timeout="0.02",
                send_timeout="0.03",
                protect="off",
                frame="734",
                head="eb90",
                motors="3.0,3.1,3.2,1.0,1.1,2.0,2.1",
                signs="+,-,+1,-1,1,+,-",
                offsets="0.1,0,0,0,0,0,-0.2",
                ratios="189,108,108,108,108,108,108",
                limits="-0.5:0.5,0:1,0:1,-1:0,-1:0,-1:0,-1:0",
                poll_sensors="on",
                config="trial.json",
                out_endpoint="0x04",
                in_endpoint="133",
            )
        )
        assert found.server == Server("h", 1)
        assert found.serial == "S1"
        assert found.layout is COMMAND_734
        assert found.head == b"\xeb\x90"
        assert found.bus_map.motors[:2] == ((3, 0), (3, 1))
        assert (found.protect, found.timeout, found.send_timeout) == (False, 0.02, 0.03)
        assert found.signs == (1, -1, 1, -1, 1, 1, -1)
        assert found.mounting(Side.LEFT).offsets[6] == -0.2
        assert found.joints(Side.LEFT)[0].gear_ratio == 189
        assert found.joints(Side.LEFT)[1].q_max == 1
        assert (found.poll_sensors, found.config) == (True, Path("trial.json"))
        assert "signs" in found.given
        assert (found.out_endpoint, found.in_endpoint) == (0x04, 0x85)

    @each(
        ("device", "settings", "server", "serial", "local"),
        [
            (None, {}, None, None, True),
            ("S1", {}, None, "S1", True),
            (None, {"usb": "system"}, None, None, False),
            ("usbip://h", {}, Server("h"), None, True),
            ("usbip://h/S1", {"usb": "usbip://h"}, Server("h"), "S1", True),
            ("S1", {"usb": "usbip://h/S1"}, Server("h"), "S1", True),
        ],
    )
    def test_device_setting_selects_the_hand(
        self, device: str | None, settings: dict[str, str], server: Any, serial: Any, local: bool
    ) -> None:
        found = from_options(self.options(device, **settings))
        assert (found.server, found.serial, found.local) == (server, serial, local)


class TestDiscovery:
    def test_hand_is_found_by_side(self) -> None:
        left, right = RawDevice(FakeHand()), RawDevice(FakeHand(Side.RIGHT), side=Side.RIGHT)
        other = RawDevice(FakeHand(), vendor=0x1209)
        with serving(other, right, left) as server:
            found = find_hand(Side.LEFT, server=at(server))
            assert found.side is Side.LEFT
            assert (left.attachments, right.attachments, other.attachments) == (0, 0, 0)
            hand = Dex3Usb(Side.RIGHT, Dex3Settings(server=at(server)))
            with hand:
                assert right.attachments == 1

    def test_hand_is_found_by_serial_number(self) -> None:
        hands = [RawDevice(FakeHand(), serial=s) for s in ("A1", "A2", None)]
        with serving(*hands) as server, hand_on(server, serial="A2") as hand:
            assert hand.serial == "A2"
            assert hands[1].received
            assert not hands[0].received

    def test_two_hands_of_one_side_are_refused_and_listed(self) -> None:
        hands = [RawDevice(FakeHand(), serial=s) for s in ("A1", "A2")]
        with (
            serving(*hands) as server,
            pytest.raises(HandNotFound, match=r"more than one left.*A1.*A2") as caught,
        ):
            hand_on(server).open()
        assert "--device SERIAL" in caught.value.hint

    def test_the_serial_number_of_the_other_side_is_refused(self) -> None:
        right = RawDevice(FakeHand(Side.RIGHT), side=Side.RIGHT, serial="R7")
        with serving(right) as server, pytest.raises(HandRefused, match=r"R7.*right hand"):
            hand_on(server, serial="R7").open()

    def test_error_names_the_hands_that_were_found(self) -> None:
        right = RawDevice(FakeHand(Side.RIGHT), side=Side.RIGHT, serial="R7")
        with serving(right) as server:
            with pytest.raises(HandNotFound, match=r"34b7:1010.*there is the right"):
                hand_on(server).open()
            assert not right.attachments  # another program may be about to open it
            with pytest.raises(HandNotFound, match=r"X9.*there is the right hand R7"):
                hand_on(server, serial="X9").open()

    def test_no_hand_found_is_an_error(self, no_usb: None) -> None:
        with pytest.raises(HandNotFound, match=r"34b7:1010.*no USB/IP server there") as caught:
            Dex3Usb(Side.LEFT).open()
        for word in ("powered", "lsusb -d 34b7:", "dexkit emulate dex3-usb --side left"):
            assert word in caught.value.hint

    def test_missing_libusb_is_reported_with_a_hint(
        self, no_usb: None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: None)
        for local in (True, False):
            with pytest.raises(HandNotFound, match="libusb is not installed") as caught:
                Dex3Usb(Side.LEFT, Dex3Settings(local=local)).open()
            assert "apt install libusb-1.0-0" in caught.value.hint

    def test_local_usbip_server_is_tried_last_and_reported(
        self,
        no_usb: None,
        monkeypatch: pytest.MonkeyPatch,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        caplog.set_level(logging.INFO)
        with serving(RawDevice(FakeHand())) as server:
            monkeypatch.setattr(discovery, "LOCAL_SERVER", at(server))
            with Dex3Usb(Side.LEFT) as hand:
                assert hand.serial == "SN1"
            assert "no left hand on this machine's USB; taking the left Dex3-1 on usbip" in (
                caplog.text
            )
            with pytest.raises(HandNotFound):
                Dex3Usb(Side.LEFT, Dex3Settings(local=False)).open()

    @pytest.mark.parametrize("first", ["usb", "server"])
    def test_lost_hand_is_searched_at_its_old_place(
        self, first: str, no_usb: None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        real = FakeBackend(FakeHand())
        there: list[str] = ["device"] if first == "usb" else []
        monkeypatch.setattr(real, "enumerate_devices", lambda: there)
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: real)
        emulated = RawDevice(FakeHand())
        emulated.plugged = first == "server"
        with serving(emulated) as server:
            monkeypatch.setattr(discovery, "LOCAL_SERVER", at(server))
            hand = Dex3Usb(Side.LEFT, QUICK)
            hand.open()
            hand.close()
            there[:] = ["device"] if first == "server" else []
            emulated.plugged = first == "usb"
            with pytest.raises(HandNotFound):
                hand.open()
            there[:] = ["device"]
            emulated.plugged = True
            with hand:
                assert hand.exchange(GO).measured
            assert (emulated.attachments > 0) == (first == "server")

    def test_hand_in_use_is_reported_with_the_free_one(self) -> None:
        hands = [RawDevice(FakeHand(), serial=s) for s in ("A1", "A2")]
        with (
            serving(*hands) as server,
            hand_on(server, serial="A1"),
            pytest.raises(HandNotFound, match=r"another program has it.*\(A2\)"),
        ):
            hand_on(server).open()


class TestOpening:
    """What is asked of libusb, and what becomes of its answers."""

    def test_open_claims_the_interface_and_close_releases_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake = FakeBackend(FakeHand())
        fake.kernel_driver = True
        hand = fake_hand(fake, monkeypatch)
        hand.open()
        hand.open()  # is open
        assert not fake.kernel_driver
        assert fake.calls.count("claim_interface") == 1
        assert "set_configuration" not in fake.calls
        fake.calls.clear()
        hand.close()
        hand.close()
        assert fake.calls == [
            "bulk_write",
            "bulk_read",
            "release_interface",
            "attach_kernel_driver",
            "close_device",
        ]
        assert fake.kernel_driver

    def test_first_bulk_endpoints_are_used_by_default(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake = FakeBackend(FakeHand())
        link = UsbLink(fake, "device", "it")
        assert (link.endpoints.out, link.endpoints.into) == (0x02, 0x81)
        link = UsbLink(fake, "device", "it", out_endpoint=0x04, in_endpoint=0x85)
        assert (link.endpoints.out, link.endpoints.into) == (0x04, 0x85)
        for wrong in ({"out_endpoint": 0x81}, {"in_endpoint": 0x83}, {"in_endpoint": 0x02}):
            fake.calls.clear()
            with pytest.raises(HandRefused, match="no bulk") as caught:
                UsbLink(fake, "device", "it", **wrong)
            assert "0x02, 0x81, 0x04, 0x85" in caught.value.hint
            assert fake.calls[-2:] == ["release_interface", "close_device"]
        fake.endpoints = [(0x81, 2), (0x02, 3)]
        with pytest.raises(HandRefused, match="no bulk OUT and IN"):
            UsbLink(fake, "device", "it")

    @pytest.mark.parametrize("call", ["open_device", "claim_interface", "detach_kernel_driver"])
    def test_missing_permission_is_refused_with_a_hint(
        self, call: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake = FakeBackend(FakeHand())
        fake.kernel_driver = True
        fake.fail[call] = usb_error(errno.EACCES)
        with pytest.raises(HandRefused, match="no permission") as caught:
            fake_hand(fake, monkeypatch).open()
        assert "sudo cp packaging/70-dexkit-dex3.rules /etc/udev/rules.d/" in caught.value.hint
        assert "udevadm" in caught.value.hint
        assert ("close_device" in fake.calls) == (call != "open_device")

    def test_interface_that_another_program_claims_is_refused(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake = FakeBackend(FakeHand())
        fake.fail["claim_interface"] = usb_error(errno.EBUSY)
        with pytest.raises(HandRefused, match="another program holds") as caught:
            fake_hand(fake, monkeypatch).open()
        assert "another dexkit" in caught.value.hint
        assert "lsof" in caught.value.hint
        assert "bulk_write" not in fake.calls

    def test_the_rule_is_for_both_hands(self) -> None:
        path = Path(__file__).parents[1] / "packaging" / "70-dexkit-dex3.rules"
        active = re.findall(
            r'^SUB.*idVendor}=="(\w+)".*idProduct}=="(\w+)"', path.read_text(), re.M
        )
        assert active == [(f"{VENDOR_ID:04x}", f"{PRODUCT_ID[side]:04x}") for side in Side]

    def test_silent_device_is_a_timeout_on_open(self, monkeypatch: pytest.MonkeyPatch) -> None:
        device = RawDevice(lambda data: [])
        with serving(device) as server:
            hand = hand_on(server, SHORT)
            waits = waits_of(monkeypatch, Connection, "_fill", _to_the_deadline)
            with pytest.raises(HandTimeout, match="does not answer") as caught:
                hand.open()
            assert sum(waits) < 1.0
            hand.configuration = replace(hand.configuration, timeout=5.0, send_timeout=5.0)
            assert "--set frame=734" in caught.value.hint
            assert device.plugged  # and is free again:
            device.script = FakeHand()
            hand.open()
            hand.close()

    def test_open_and_close_do_not_move_the_hand(self) -> None:
        device = RawDevice(FakeHand())
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        with serving(device) as server, hand_on(server):
            pass
        assert len(device.received) >= 2  # at opening and at closing
        for data in device.received:
            command = codec.decode_command(data).command
            assert command.is_brake
            assert command.timeout is not None
            assert not command.timeout.any()

    def test_motor_missing_at_its_place_is_refused(self) -> None:
        fake = FakeHand()
        fake.silent = (2, 6)
        with (
            serving(RawDevice(fake)) as server,
            pytest.raises(HandRefused, match=r"thumb_2 \(bus 0 id 2\), index_1") as caught,
        ):
            hand_on(server).open()
        assert "0.0, 0.1, 1.0, 1.1, 2.0" in caught.value.hint
        assert "--set motors=" in caught.value.hint


class TestExchange:
    def test_one_send_one_receive(self) -> None:
        device = RawDevice(FakeHand())
        with serving(device) as server, hand_on(server) as hand:
            sent = len(device.received)
            for count in range(1, 20):
                before = time.monotonic()
                state = hand.exchange(GO)
                assert len(device.received) == sent + count
                assert state.q[0] == pytest.approx(device.script.q(device.script.count), abs=1e-4)  # type: ignore[attr-defined]
                assert before <= state.stamp <= time.monotonic()

    @pytest.mark.parametrize("layout", [COMMAND_1234, COMMAND_734])
    def test_exchange_sends_the_expected_frame(self, layout: Any) -> None:
        device = RawDevice(FakeHand())
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        q = np.array([0.1, 0.2, 0.3, -0.4, -0.5, -0.6, -0.7])
        with (
            serving(device) as server,
            hand_on(server, layout=layout, head=b"\xeb\x90") as hand,
        ):
            hand.exchange(HandCommand.position(q, kp=1.5, kd=0.2))
        data = device.received[-2]
        assert len(data) == layout.size
        assert data[:2] == b"\xeb\x90"
        decoded = codec.decode_command(data)
        assert decoded.command.q == pytest.approx(q, abs=1e-5)
        assert decoded.command.kp == pytest.approx(np.full(7, 1.5), rel=0.03)
        assert decoded.command.mode.tolist() == [JointMode.FOC] * 7
        assert decoded.command.timeout is not None
        assert decoded.command.timeout.all()

    def test_protection_can_be_left_off(self) -> None:
        device = RawDevice(FakeHand())
        with serving(device) as server, hand_on(server, protect=False) as hand:
            hand.exchange(GO)
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        for data in device.received:
            timeout = codec.decode_command(data).command.timeout
            assert timeout is not None
            assert not timeout.any()

    def test_a_tripped_motor_is_locked_once_and_reported(self) -> None:
        fake = FakeHand()
        device = RawDevice(fake)
        codec = HandCodec(DEX3_1.joints[Side.LEFT])
        with serving(device) as server, hand_on(server) as hand:
            hand.exchange(GO)
            fake.tripped[[1, 4]] = True
            state = hand.exchange(GO)
            assert np.flatnonzero(state.fault).tolist() == [1, 4]
            assert state.fault[1] == int(MotorError.MOTOR_SAW_HOST_TIMEOUT)
            fake.tripped[:] = False
            state = hand.exchange(GO)
            assert not state.fault.any()
            locked = codec.decode_command(device.received[-1]).command
            assert np.flatnonzero(locked.mode == 0).tolist() == [1, 4]
            assert locked.timeout is not None
            assert np.flatnonzero(~locked.timeout).tolist() == [1, 4]
            assert not locked.kp[[1, 4]].any()
            hand.exchange(GO)
            again = codec.decode_command(device.received[-1]).command
            assert again.mode.all()
            assert again.timeout is not None
            assert again.timeout.all()
            assert hand.statistics.trips == 1

    def test_silent_motor_keeps_its_last_state_and_is_reported(self) -> None:
        fake = FakeHand()
        lost = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)
        with serving(RawDevice(fake)) as server, hand_on(server) as hand:
            before = hand.exchange(GO)
            fake.silent = (0, 5)
            for count in range(1, 21):
                state = hand.exchange(GO)
                assert state.q[0] == before.q[0]
                assert state.temperature[0] == 30.0
                assert state.winding_temperature is not None
                assert not np.isnan(state.winding_temperature).any()
                assert state.mode.tolist() == [1] * 7
                assert np.flatnonzero(state.fault).tolist() == ([0, 5] if count >= 10 else [])
            assert state.fault[5] == lost
            fake.silent = ()
            state = hand.exchange(GO)
            assert not state.fault.any()
            assert state.q[0] != before.q[0]
            assert hand.exchange(GO).q[0] != state.q[0]

    @each(
        "damage",
        [
            lambda a: a[:1000],
            lambda a: b"",
            lambda a: a + b"\0",
            lambda a: a + bytes(700),
            lambda a: a[:100] + b"\xff" + a[101:],
            lambda a: b"\0" + a[1:],
        ],
        ids=["short", "empty", "long", "longer", "crc", "head"],
    )
    def test_damaged_answer_is_a_timeout_and_the_next_exchange_works(self, damage: Any) -> None:
        fake = FakeHand()
        device = RawDevice(fake)
        with serving(device) as server, hand_on(server) as hand:
            hand.exchange(GO)
            fake.spoil = damage
            with pytest.raises(HandTimeout, match="no intact answer"):
                hand.exchange(GO)
            assert hand.statistics.damaged_frames == 1
            fake.spoil = lambda answer: answer
            state = hand.exchange(GO)
            assert state.q[0] == pytest.approx(fake.q(fake.count), abs=1e-4)


class LateHand(FakeHand):
    """Answers the command that comes ``next_late`` seconds late, or never."""

    next_late: float | None = 0.0

    def __call__(self, data: bytes) -> Answer:
        late, self.next_late = self.next_late, 0.0
        state = self.state()
        return [] if late is None else [(late, state)]


class TestLateAnswers:
    """An answer belongs to the command that it follows, however late it comes."""

    @each("late", [0.105, 0.115, 0.15, 0.3])
    def test_late_answer_over_usbip_is_dropped(
        self, late: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # how long the driver looks out for it: a machine that stalls may exceed half a second
        monkeypatch.setattr("dexkit.drivers.dex3_usb.link._LATE_ANSWER_WATCH", PATIENCE)
        fake = LateHand()
        with serving(RawDevice(fake)) as server, hand_on(server, SHORT) as hand:
            hand.exchange(GO)
            fake.next_late = late
            before = time.monotonic()
            try:  # a machine that wakes it late may find the answer there already
                state = hand.exchange(GO)
                assert state.q[0] == pytest.approx(fake.q(fake.count), abs=1e-4)
            except HandTimeout:
                assert time.monotonic() - before >= 0.09
            begin = time.monotonic()
            while True:
                assert time.monotonic() < begin + PATIENCE
                try:
                    state = hand.exchange(GO)
                except HandTimeout:
                    continue
                # until then an answer may be that of a time-out, which nothing in it says
                if hand.statistics.link.late == hand.statistics.link.timeouts:
                    assert state.q[0] == pytest.approx(fake.q(fake.count), abs=1e-4)
                    break

    def test_late_answer_on_libusb_is_dropped(self, monkeypatch: pytest.MonkeyPatch) -> None:
        fake = FakeBackend(FakeHand())
        with fake_hand(fake, monkeypatch) as hand:
            hand.exchange(GO)
            kept: list[bytes] = []
            script = fake.script

            def late(data: bytes) -> Answer:
                kept.extend(answer for _, answer in script(data))
                return []

            fake.script = late
            with pytest.raises(HandTimeout):
                hand.exchange(GO)
            fake.script = script
            fake.pending += kept
            state = hand.exchange(GO)
            assert state.q[0] == pytest.approx(script.q(script.count), abs=1e-4)  # type: ignore[attr-defined]
            assert hand.statistics.link.late == 1

    def test_answer_left_by_a_previous_client_is_discarded(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        script = FakeHand()
        fake = FakeBackend(script)
        fake.pending.append(script.state())
        with fake_hand(fake, monkeypatch) as hand:
            state = hand.exchange(GO)
            assert state.q[0] == pytest.approx(script.q(script.count), abs=1e-4)


class TestTroubleOnTheWay:
    @pytest.mark.parametrize(
        ("call", "number", "expected"),
        [
            ("bulk_write", errno.ENODEV, HandLost),
            ("bulk_read", errno.ENODEV, HandLost),
            ("bulk_read", errno.EIO, HandLost),
            ("bulk_write", errno.ETIMEDOUT, HandTimeout),
            ("bulk_read", errno.EINTR, HandTimeout),
            ("bulk_read", errno.EOVERFLOW, HandError),
            ("bulk_read", errno.ENOMEM, HandError),
            ("bulk_write", errno.EACCES, HandRefused),
        ],
    )
    def test_libusb_errors_map_to_typed_errors(
        self,
        call: str,
        number: int,
        expected: type[HandError],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        fake = FakeBackend(FakeHand())
        with fake_hand(fake, monkeypatch) as hand:
            fake.fail[call] = usb_error(number)
            with pytest.raises(expected) as caught:
                hand.exchange(GO)
            assert type(caught.value) is expected

    @pytest.mark.parametrize("call", ["bulk_write", "bulk_read"])
    def test_a_stalled_endpoint_is_cleared(
        self, call: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        fake = FakeBackend(FakeHand())
        with fake_hand(fake, monkeypatch) as hand:
            fake.fail[call] = usb_error(errno.EPIPE)
            with pytest.raises(HandTimeout, match=r"stalled its (OUT|IN) endpoint"):
                hand.exchange(GO)
            assert fake.calls[-1] == "clear_halt"
            fake.fail.clear()
            hand.exchange(GO)
            assert hand.statistics.link.stalls == 1

    def test_partially_written_command_is_an_error(self, monkeypatch: pytest.MonkeyPatch) -> None:
        fake = FakeBackend(FakeHand())
        with fake_hand(fake, monkeypatch) as hand:
            monkeypatch.setattr(fake, "bulk_write", lambda *args: 512)
            with pytest.raises(HandTimeout, match="took 512 of the 1234"):
                hand.exchange(GO)

    def test_an_interrupted_exchange_leaves_no_answer_for_the_next_command(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        script = FakeHand()
        fake = FakeBackend(script)
        with fake_hand(fake, monkeypatch) as hand:
            hand.exchange(GO)
            fake.fail["bulk_read"] = KeyboardInterrupt()
            with pytest.raises(KeyboardInterrupt):
                hand.exchange(GO)
            fake.fail.clear()
            for _ in range(3):
                state = hand.exchange(GO)
                assert state.q[0] == pytest.approx(script.q(script.count), abs=1e-4)

    @pytest.mark.parametrize("protect", [True, False])
    def test_closing_brakes_a_hand_whose_endpoint_has_stalled(
        self, protect: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        received: list[bytes] = []
        script = FakeHand()

        def noting(data: bytes) -> Answer:
            received.append(data)
            return script(data)

        fake = FakeBackend(noting)
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: fake)
        hand = Dex3Usb(Side.LEFT, replace(QUICK, protect=protect))
        hand.open()
        hand.exchange(GO)
        fake.fail["bulk_write"] = usb_error(errno.EPIPE)
        monkeypatch.setattr(fake, "clear_halt", lambda *args: fake.fail.clear())
        hand.close()
        assert {m.status for _, m in parse_command(received[-1]).motors} == {0}

    @pytest.mark.parametrize(
        ("protect", "expected"), [(True, "within a second"), (False, "cut their power")]
    )
    def test_motors_that_could_not_be_braked_are_reported(
        self,
        protect: bool,
        expected: str,
        monkeypatch: pytest.MonkeyPatch,
        caplog: pytest.LogCaptureFixture,
    ) -> None:
        fake = FakeBackend(FakeHand())
        monkeypatch.setattr(usb.backend.libusb1, "get_backend", lambda: fake)
        hand = Dex3Usb(Side.LEFT, replace(QUICK, protect=protect))
        hand.open()
        fake.fail["bulk_write"] = usb_error(errno.ENODEV)
        hand.close()
        assert "could not brake" in caplog.text
        assert expected in caplog.text

    def test_server_that_stops_answering_is_a_timeout(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Time-outs are kept by the client, whatever the server does."""
        frozen = threading.Event()
        fake = FakeHand()

        def script(data: bytes) -> Answer:
            if len(device.received) == 3:
                frozen.wait(PATIENCE)  # the server's only thread
            return fake(data)

        device = RawDevice(script)
        with serving(device) as server:
            hand = hand_on(server, SHORT)
            hand.open()
            hand.exchange(GO)
            waits = waits_of(monkeypatch, Connection, "_fill", _to_the_deadline)
            for _ in range(3):
                waits.clear()
                with pytest.raises(HandTimeout):
                    hand.exchange(GO)
                assert 0 < sum(waits) <= hand.spec.exchange_timeout
            monkeypatch.undo()
            frozen.set()
            until = time.monotonic() + PATIENCE
            while True:
                try:
                    state = hand.exchange(GO)
                except HandTimeout:
                    assert time.monotonic() < until
                    continue
                if state.q[0] == pytest.approx(fake.q(fake.count), abs=1e-4):
                    break
                assert time.monotonic() < until
            hand.close()


class TestUsbIpClient:
    """The transfers over USB/IP, with a server that a test writes byte by byte."""

    def reply(self, seq: int, data: bytes = b"", status: int = 0, command: int = 3) -> bytes:
        # as the kernel's server does: everything but the number is 0
        return (
            struct.pack(">IIIIIiiiii8x", command, seq, 0, 0, 0, status, len(data), 0, 0, 0) + data
        )

    def connected(self) -> tuple[Connection, socket.socket]:
        client, server = socket.socketpair()
        server.settimeout(PATIENCE)
        return Connection(client, 0x10002), server

    def exchange(self, connection: Connection, timeout: int = 50) -> tuple[int, int, bytes]:
        return connection.exchange(2, b"command", 1, 64, timeout, timeout)

    def test_replies_in_pieces_and_in_either_order(self) -> None:
        connection, server = self.connected()
        first = self.reply(1, b"") + self.reply(2, b"answer")
        second = self.reply(4, b"other") + self.reply(3)
        pieces = [first[:10], first[10:60], first[60:], second]

        def serve() -> None:
            for piece in pieces:
                server.sendall(piece)

        thread = threading.Thread(target=serve)
        thread.start()
        assert self.exchange(connection, 2000) == (0, 0, b"answer")
        assert self.exchange(connection, 2000) == (0, 0, b"other")
        thread.join()
        assert len(server.recv(4096)) == 2 * (48 + 7 + 48)
        connection.close()
        server.close()

    def test_a_cancelled_transfer_is_not_taken_for_another(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        connection, server = self.connected()
        waits = waits_of(monkeypatch, Connection, "_fill", _to_the_deadline)
        with pytest.raises(USBTimeoutError):
            self.exchange(connection, 20)
        assert sum(waits) < 0.05
        monkeypatch.undo()
        sent = server.recv(4096)
        numbers = [struct.unpack_from(">II", sent, at) for at in (0, 55, 103, 151)]
        assert numbers == [(1, 1), (1, 2), (2, 3), (2, 4)]  # two transfers, two calls back
        # the write was done after all, the late answer crosses the calls back, which succeed
        server.sendall(self.reply(1) + self.reply(2, b"late") + self.reply(3, command=4))
        server.sendall(self.reply(4, command=4) + self.reply(5) + self.reply(6, b"right"))
        assert self.exchange(connection, 2000) == (0, 0, b"right")
        assert connection.passed_over == 1  # the link behind it is informed
        connection.close()
        server.close()

    def test_reply_cut_by_a_timeout_is_completed_later(self) -> None:
        connection, server = self.connected()
        whole = self.reply(1) + self.reply(2, b"late answer")
        server.sendall(whole[:-4])
        with pytest.raises(USBTimeoutError):
            self.exchange(connection, 20)
        server.sendall(whole[-4:] + self.reply(3, command=4) + self.reply(4, command=4))
        server.sendall(self.reply(5) + self.reply(6, b"right"))
        assert self.exchange(connection, 2000) == (0, 0, b"right")
        connection.close()
        server.close()

    @given(
        st.lists(
            st.one_of(
                st.binary(max_size=120),
                st.builds(
                    lambda seq, command, size, data: (
                        struct.pack(">IIIIIiiiii8x", command, seq, 0, 0, 0, 0, size, 0, 0, 0) + data
                    ),
                    st.integers(0, 4),
                    st.integers(0, 5),
                    st.integers(-2, 100),
                    st.binary(max_size=80),
                ),
            ),
            max_size=4,
        )
    )
    def test_any_server_data_raises_only_usb_errors(self, chunks: list[bytes]) -> None:
        connection, server = self.connected()
        server.sendall(b"".join(chunks))
        server.shutdown(socket.SHUT_WR)
        try:
            _, _, data = self.exchange(connection, 20)
            assert len(data) <= 64
        except USBError:
            pass
        finally:
            connection.close()
            server.close()


class _DroppingLibUsb:
    """A libusb that lists a hand only when it is made anew, as after a transfer that failed."""

    made = 0

    def __init__(self, lib: object) -> None:
        self.lib = lib
        kind = type(self)
        kind.made += 1
        self._devices = ["hand"] if kind.made > 1 else []

    def enumerate_devices(self) -> list[str]:
        return self._devices

    def get_device_descriptor(self, device: str) -> SimpleNamespace:
        return SimpleNamespace(idVendor=0x34B7, idProduct=0x1010, bus=1, address=4)


def _folder_in_sysfs(folder: Path, devnum: int) -> None:
    folder.mkdir()
    values = {"idVendor": "34b7", "idProduct": "1010", "busnum": "1", "devnum": str(devnum)}
    for name, value in values.items():
        (folder / name).write_text(value + "\n")


def test_a_hand_that_libusb_has_dropped_is_found_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(_DroppingLibUsb, "made", 0)
    monkeypatch.setattr(usb.backend.libusb1, "_LibUSB", _DroppingLibUsb)
    monkeypatch.setattr(usb.backend.libusb1, "_lib_object", _DroppingLibUsb(None))
    monkeypatch.setattr(discovery, "_SYSFS", tmp_path)
    monkeypatch.setattr(discovery, "_given_up", set())
    assert discovery._list_on_usb([], []) == []  # there is none
    assert _DroppingLibUsb.made == 1
    _folder_in_sysfs(tmp_path / "1-1", 4)
    (found,) = discovery._list_on_usb([], [])
    assert found.node == (1, 4)
    _folder_in_sysfs(tmp_path / "1-2", 5)  # in no list: asked for once
    for _ in range(3):
        assert len(discovery._list_on_usb([], [])) == 1
    assert _DroppingLibUsb.made == 3
