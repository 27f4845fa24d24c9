"""``dexkit serve`` as a process: what it prints, how it ends, and an emulated gripper behind it."""

from __future__ import annotations

import json
import signal
import time
from contextlib import AbstractContextManager

import pytest
from click.testing import CliRunner

from dexkit.cli import cli
from dexkit.dds import DdsNode, Qos
from dexkit.emulators.mx64 import emulated_ezgripper
from dexkit.hand import MotorError, Side
from dexkit.messages import unitree_go
from dexkit.models import dialect
from tests.cli_helpers import Process, running
from tests.dds_helpers import dds_domain, dds_node, take_until
from tests.each import each

__all__ = ["dds_domain", "dds_node"]

GO = dialect("unitree_go")
LINK = int(MotorError.HOST_SAW_MOTOR_TIMEOUT)


def serving(*arguments: object) -> AbstractContextManager[Process]:
    return running("serve", *arguments)


def counters(line: str) -> dict[str, object]:
    found: dict[str, object] = json.loads(line.split("counters ", 1)[1])
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signals_end_the_service_cleanly(dds_domain: int, dds_node: DdsNode, number: int) -> None:
    def there() -> bool:
        return any(not e.own and e.topic.startswith("rt/dex1/") for e in dds_node.endpoints())

    with serving("sim-dex1", "--side", "left", "--domain", dds_domain) as process:
        ready = process.ready()
        for part in ("sim-dex1 left", "rt/dex1/left/cmd", "rt/dex1/left/state", "unitree_go",
                     "500 Hz", f"domain {dds_domain}"):  # fmt: skip
            assert part in ready
        assert dds_node.discovery.wait(lambda _: there(), 60)
        code, out, err = process.end(number)
        # the participant said goodbye: its endpoints go now, not when a lease runs out (10 s)
        assert dds_node.discovery.wait(lambda _: not there(), 8)
    assert (code, out) == (0, "")
    assert "Traceback" not in err
    last = counters(next(line for line in err.splitlines() if "counters" in line))
    assert last["published"]


def test_service_under_nohup_survives_the_terminal(dds_domain: int) -> None:
    """A hangup is ignored as it was asked for; an interrupt that is sent still ends it in order."""
    ignored = (signal.SIGHUP, signal.SIGINT)
    before = [signal.signal(number, signal.SIG_IGN) for number in ignored]
    try:
        process = Process("serve", "sim-dex1", "--side", "left", "--domain", dds_domain, "--quiet")
    finally:
        for number, handler in zip(ignored, before, strict=True):
            signal.signal(number, handler)
    try:
        process.ready()
        process.signal(signal.SIGHUP)
        process.signal(signal.SIGUSR1)
        assert counters(process.line("counters"))["state_topic"] == "rt/dex1/left/state"
        assert process.end(signal.SIGINT)[0] == 0
    finally:
        process.end(signal.SIGKILL)


def test_dex3_is_served_in_its_own_dialect(dds_domain: int, dds_node: DdsNode) -> None:
    d = dialect("dex3")
    topics = [d.topics(side)[1] for side in Side] + [
        d.low_rate_topic.format(side=side) for side in Side
    ]
    readers = [dds_node.reader(topic, d.state_type) for topic in topics]
    settings = ("--set", "supply=30", "--set", "right.supply=48")
    with serving("sim-dex3", "--side", "both", "--domain", dds_domain, *settings) as process:
        for side in Side:
            ready = process.ready()
            for part in (f"sim-dex3 {side} on rt/dex3/{side}/cmd", "(dex3)", "1000 Hz"):
                assert part in ready
        volts = [round(take_until(reader, bool)[-1].message.power_v) for reader in readers]
        assert volts == [30, 48, 30, 48]
        assert process.end(signal.SIGTERM)[0] == 0


def test_two_grippers_each_with_its_device_and_settings(dds_domain: int, dds_node: DdsNode) -> None:
    readers = [dds_node.reader(GO.topics(side)[1], GO.state_type) for side in Side]
    with (
        emulated_ezgripper(start=20.0, closed_at=1500) as left,
        emulated_ezgripper(start=80.0, closed_at=1400) as right,
        serving(
            *("ezgripper", "--side", "both", "--domain", dds_domain),
            *("--device", f"left={left.path}", "--set", "left.zero=1500"),
            *("--device", f"right={right.path}", "--set", "right.zero=1400"),
        ) as process,
    ):
        process.ready()
        assert "right" in process.ready()
        q = [take_until(reader, bool)[-1].message.states[0].q for reader in readers]
        assert q == [pytest.approx(0.2 * 5.4, abs=0.1), pytest.approx(0.8 * 5.4, abs=0.1)]


def test_client_of_another_dialect_is_reported(dds_domain: int, dds_node: DdsNode) -> None:
    dds_node.writer("rt/unitree_actuator/cmd", GO.cmd_type)
    with serving("sim-dex1", "--side", "left", "--domain", dds_domain) as process:
        process.ready()
        line = process.line("WARNING")
        assert "rt/unitree_actuator/cmd" in line
        assert "--dialect unitree_actuator" in line


class TestEmulatedGripper:
    """The real driver on an emulated MX-64 behind the service. No real servo was involved."""

    # an emulator on a busy machine answers late
    ZERO = ("--set", "zero=1510", "--set", "timeout=0.3")

    def test_emulated_gripper_is_driven_and_recovers_after_unplugging(
        self, dds_domain: int, dds_node: DdsNode
    ) -> None:
        cmd, state = GO.topics(Side.LEFT)
        states = dds_node.reader(state, GO.state_type, qos=Qos("best_effort", depth=5000))
        commands = dds_node.writer(cmd, GO.cmd_type)

        def drive(q: float, arrived: object = None) -> unitree_go.MotorState_:
            def there(samples: list[object]) -> bool:
                commands.write(unitree_go.MotorCmds_([unitree_go.MotorCmd_(q=q, kp=5.0, kd=0.05)]))
                time.sleep(0.005)
                if not samples:
                    return False
                motor = samples[-1].message.states[0]  # type: ignore[attr-defined]
                if callable(arrived):
                    return bool(arrived(motor))
                return abs(motor.q - q) < 0.15 and motor.lost == 0

            return take_until(states, there, 20.0)[-1].message.states[0]  # type: ignore[no-any-return]

        with emulated_ezgripper(process=True, start=50.0) as servo:
            device = ("--device", servo.path, *self.ZERO)
            with serving("ezgripper", "--side", "left", "--domain", dds_domain, *device) as p:
                p.ready()
                assert take_until(states, bool)[-1].message.states[0].q == pytest.approx(
                    2.7, abs=0.1
                )
                moved = drive(4.0)
                assert moved.temperature > 0  # the servo measures it, so it is said
                drive(1.0, lambda m: m.q < 3.5)  # on its way ...
                servo.inject("unplug:for=1s")  # ... the adapter is pulled out
                lost = drive(1.0, lambda m: m.lost > 0 and m.reserve[0] == LINK)
                assert 0.5 < lost.q < 4.2
                p.line("reconnect|answers again|lost|gone|vanish|went")
                drive(1.0)  # it came back, and follows commands that are new
                code, _, err = p.end(signal.SIGTERM)
                assert code == 0
                last = counters(next(x for x in err.splitlines() if "counters" in x))
                assert last["hands"]["left"]["reconnects"] >= 1  # type: ignore[index]

    def test_a_missing_device_is_an_error_with_a_hint(self, dds_domain: int) -> None:
        with serving("ezgripper", "--side", "left", "--domain", dds_domain,
                     "--device", "/dev/no-such-port") as process:  # fmt: skip
            code, out, err = process.end(0)
            assert (code, out) == (1, "")
            assert "error: there is no device /dev/no-such-port" in err
            assert "Traceback" not in err


class TestArguments:
    @each(
        ("arguments", "message"),
        [
            (["nope", "--side", "left"], "no backend 'nope'"),
            (["sim-dex1"], "--side"),
            (["sim-dex1", "--side", "up"], "--side"),
            (["sim-dex1", "--side", "left", "--dialect", "x"], "--dialect"),
            (["sim-dex1", "--side", "left", "--set", "colour=red"], "no setting 'colour'"),
            (["sim-dex1", "--side", "left", "--set", "colour"], "not KEY=VALUE"),
            (["sim-dex1", "--side", "left", "--set", "right.start=1"], "only the left"),
            (["sim-dex1", "--side", "left", "--dialect", "dex3"], "has no dialect dex3"),
            (["sim-dex3", "--side", "left", "--dialect", "unitree_go"], "its dialects: dex3"),
            (["sim-dex1", "--side", "left", "--set", "usb=usbip://x:1"], "no setting 'usb'"),
            (["ezgripper", "--side", "left"], "names none for the left hand"),
            (
                ["ezgripper", "--side", "both", "--device", "/dev/x"],
                "--device /dev/x names no side",
            ),
            (
                ["ezgripper", "--side", "both", "--device", "left=/dev/x"],
                "names none for the right",
            ),
            (["ezgripper", "--side", "left", "--device", "right=/dev/x"], "only the left"),
            (
                ["ezgripper", "--side", "left", "--device", "a", "--device", "left=b"],
                "two devices",
            ),
            (["sim-dex1", "--side", "left", "--state-rate", "0"], "--state-rate"),
            (["sim-dex1", "--side", "left", "--interface", "nix0"], "no network interface"),
        ],
    )
    def test_contradicting_arguments_are_refused(self, arguments: list[str], message: str) -> None:
        result = CliRunner().invoke(cli, ["serve", *arguments])
        assert result.exit_code != 0
        hint = getattr(result.exception, "hint", "")
        assert message in f"{result.output} {result.exception} {hint}"


def test_a_mistyped_command_gets_a_suggestion() -> None:
    result = CliRunner().invoke(cli, ["srve"])
    assert result.exit_code == 2
    assert "Did you mean 'serve'?" in result.output
    assert "mean" not in CliRunner().invoke(cli, ["xyzzy"]).output
