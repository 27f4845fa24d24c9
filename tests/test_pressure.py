"""Pressures that rest near 100,000: what programs of real hands see, and what the tools take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from dexkit.conformance.faults import plan_for, run_mutant
from dexkit.conformance.kit.requirements import catalogue, select
from dexkit.conformance.kit.results import Verdict
from dexkit.conformance.stimuli import phases_for, script_class
from dexkit.conformance.virtual.fingers import Dex3Service, FingerHand
from dexkit.dds import DdsNode
from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
from dexkit.drivers.dex3_usb.discovery import parse_server
from dexkit.emulators.barometers import untouched
from dexkit.emulators.dex3_mcu import emulated_dex3
from dexkit.emulators.sim_dex3 import SimDex3
from dexkit.hand import Hand, Side
from dexkit.messages import unitree_hg
from dexkit.models import DEX3_1, dialect
from dexkit.monitor.bars import UNICODE
from dexkit.monitor.screen import hand_lines
from dexkit.pressure import NO_VALUE, resting_pressure
from dexkit.service import HandService
from dexkit.view.drawing import Drawing
from dexkit.watch import Collector
from tests.dds_helpers import dds_domain, dds_node
from tests.each import each
from tests.patience import PATIENCE
from tests.watch_helpers import dex3_state

__all__ = ["dds_domain", "dds_node"]

DEX3 = dialect("dex3")


# -- programs of real hands ------------------------------------------------------------------


def touched_by_threshold(message: Any) -> bool:
    """As `hand_pressure_monitor.py` decides (docs/sources/real-hands.md, source 2)."""
    values = [p for packet in message.press_sensor_state for p in packet.pressure if p != 30000.0]
    return bool(values) and max(values) >= 150_000


def touched_by_change(message: Any, baseline: Any) -> bool:
    """By a difference from an untouched state (docs/sources/real-hands.md#touch-sign)."""
    pairs = zip(message.press_sensor_state, baseline.press_sensor_state, strict=True)
    return any(
        abs(now - rest) > 1000
        for packet, before in pairs
        for now, rest in zip(packet.pressure, before.pressure, strict=True)
        if rest != 30000.0
    )


@contextmanager
def sim() -> Iterator[Hand]:
    yield SimDex3(Side.LEFT, object_at=40.0)


@contextmanager
def usb() -> Iterator[Hand]:
    with emulated_dex3(object_pct=40.0) as emulated:
        server = parse_server(emulated.url)[0]
        yield Dex3Usb(Side.LEFT, Dex3Settings(server=server, timeout=5.0, send_timeout=5.0))


@each("device", [sim, usb])
def test_programs_of_real_hands_see_a_touch_on_dds(
    device: Callable[[], Any], dds_domain: int, dds_node: DdsNode
) -> None:
    cmd, state = DEX3.topics(Side.LEFT)
    closed = [j.q_max if j.closing > 0 else j.q_min for j in DEX3_1.joints[Side.LEFT]]
    with device() as hand, HandService(hand, domain=dds_domain, state_rate=100.0):
        reader = dds_node.reader(state, DEX3.state_type)
        writer = dds_node.writer(cmd, DEX3.cmd_type)

        def until(seen: Callable[[Any], bool], kp: float | None = None) -> Any:
            deadline = time.monotonic() + PATIENCE
            while True:
                reader.wait(0.1)
                messages = [s.message for s in reader.take()]
                if found := [m for m in messages if seen(m)]:
                    return found[0]
                assert time.monotonic() < deadline, messages[-1:]
                if kp is not None:
                    motors = [
                        unitree_hg.MotorCmd_(mode=0x10 | i, q=0.0 if i == 0 else q, kp=kp, kd=0.1)
                        for i, q in enumerate(closed)
                    ]
                    writer.write(unitree_hg.HandCmd_(motors))

        rest = until(lambda m: any(x.q != 0.0 for x in m.motor_state))
        for packet, sensor in zip(rest.press_sensor_state, DEX3_1.sensors, strict=True):
            for slot, p in enumerate(packet.pressure):
                if slot in sensor.slots:
                    assert 100_900 < p < 103_400
                else:
                    assert p == 30000.0  # exactly, also by way of counts of 8 Pa
        assert not touched_by_threshold(rest)
        touched = until(lambda m: touched_by_change(m, rest), kp=0.1)
        assert not touched_by_threshold(touched)
        until(touched_by_threshold, kp=1.5)


# -- what an element reads at rest -----------------------------------------------------------


def readings(seconds: float, rate: float = 100.0) -> tuple[Any, Any]:
    t = np.arange(0.0, seconds, 1.0 / rate)
    return t, np.array([untouched(Side.LEFT, now)[0] for now in t.tolist()])


@each("rate", [9.1, 30.0, 1000.0])
@each(
    ("begin", "end", "push"),
    [
        (0.0, 0.0, 0.0),
        *((1.5, 3.0, push) for push in (60_000.0, 3_000.0, -3_000.0)),
        # a light touch from the beginning on cannot be told from rest
        (0.0, 1.5, 60_000.0),
        (0.0, 0.2, 3_000.0),
    ],
)
def test_rest_is_told_from_contact(rate: float, begin: float, end: float, push: float) -> None:
    t, values = readings(4.0, rate)
    values[(t >= begin) & (t < end)] += push
    found = resting_pressure(t, values)
    there = list(DEX3_1.sensors[0].slots)
    assert np.isnan(np.delete(found, there)).all()
    assert np.abs(found - untouched(Side.LEFT, 0.0)[0])[there].max() < 100


# -- the tools -------------------------------------------------------------------------------


@each("rest", [101_500.0, 0.0])
@each("push", [20_000.0, -2_000.0])
def test_view_and_monitor_show_the_change_from_rest(rest: float, push: float) -> None:
    collector, (_, topic) = Collector(), DEX3.topics(Side.LEFT)
    free, touched = (dex3_state(DEX3_1.rest_q[Side.LEFT], pressure=p) for p in (rest, rest + push))
    times = [10**9 + i * 10**7 for i in range(200)]
    payloads = [touched if i >= 120 else free for i in range(200)]
    collector.take(topic, DEX3.state_type, payloads, times, times)
    calm, pressed = (collector.picture(at).subjects[0] for at in (1.0, 1.9))
    assert (calm.pressure == rest).all()
    assert (calm.pressure_at_rest == rest).all()
    assert set(calm.touched.values()) == {0.0}
    assert pressed.touched == dict.fromkeys(("thumb", "middle", "index", "palm"), push)
    drawing = Drawing(calm)
    still = drawing.at(calm).element_colors
    assert (still == still[0]).all()
    assert not (drawing.at(pressed).element_colors == still).all(axis=1).any()
    sign = "+" if push > 0 else ""
    text = str(hand_lines(pressed, UNICODE, 80)[-1])
    assert (
        text
        == "touch "
        + "  ".join(f"{name} {sign}{push:.0f}" for name in pressed.touched)
        + "  from rest"
    )
    assert len(text) <= 80


# -- legal hands -----------------------------------------------------------------------------


class ThumbFalls(Dex3Service):
    """A touch lowers the pressures of the thumb (docs/sources/real-hands.md#touch-sign)."""

    def pressures(self, hand: FingerHand) -> Any:
        pressure, rest = super().pressures(hand), hand.untouched()
        thumb = [i for i, s in enumerate(DEX3_1.sensors) if s.place.startswith("thumb")]
        pressure = pressure.copy()
        pressure[thumb] = np.maximum(2 * rest - pressure, 0.0)[thumb]
        return pressure


class RestsAtZero(Dex3Service):
    """Its sensors were set to zero, as those of older emulators."""

    def pressures(self, hand: FingerHand) -> Any:
        pressure = super().pressures(hand)
        return np.where(pressure == NO_VALUE, pressure, pressure - hand.untouched())


@each("service", [ThumbFalls, RestsAtZero])
def test_the_sign_of_a_touch_and_the_level_of_rest_fail_no_hand(
    service: type[Dex3Service],
) -> None:
    wanted = select(catalogue("dex3-1"), prefixes=["DEX3-SENS"])
    plan = plan_for("dex3", sides=tuple(Side))
    # what comes after the grip shows that the pressure ends
    beside = {script_class("dex3-1").motion, "limp", "silence"}
    plan = replace(plan, phases=phases_for(wanted) | beside)
    found = run_mutant(service, plan, wanted).results
    assert {r.verdict for r in found} <= {Verdict.PASS, Verdict.NOT_APPLICABLE}, [
        r.explain() for r in found
    ]
    passed = {r.requirement.id for r in found if r.verdict is Verdict.PASS}
    assert passed >= {f"DEX3-SENS-{n:02}" for n in (1, 3, 4, 8, 11)}
