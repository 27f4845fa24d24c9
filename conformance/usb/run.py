"""Run the USB stimulus on real devices and record every transfer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor

from dexkit.clock import RealClock
from dexkit.conformance.kit.heartbeat import Heartbeat
from dexkit.conformance.kit.phased_script import play
from dexkit.conformance.kit.run_queue import RunQueue, Watched
from dexkit.conformance.kit.suspension import sleep_awake
from dexkit.conformance.layers import layer
from dexkit.conformance.stimuli.usb import (
    Action,
    Alone,
    In,
    Observation,
    Out,
    Plan,
    Reopen,
    UsbScript,
    Wait,
)
from dexkit.conformance.usb.access import UsbHost, bulk_pair, open_device
from dexkit.conformance.usb.record import (
    RECORD,
    SCHEMA,
    SCHEMA_NAME,
    Descriptors,
    SideRecord,
    Transfer,
    UsbRecord,
    topic,
)
from dexkit.conformance.usb.recording import Endpoint
from dexkit.errors import ConformanceError
from dexkit.hand import Side
from dexkit.models import DEX3_1
from dexkit.traces.recorder import Recorder

__all__ = ["run"]

_LAST_ANSWER = 0.1  # s to wait for the answer to the last command when a run ends early


def run(
    devices: Mapping[Side, str],
    recorder: Recorder,
    *,
    report: Callable[[str], None] = lambda text: None,
    stop: threading.Event | None = None,
    processes: Callable[[], Iterable[Watched]] = tuple,
) -> bool:
    """Play the script to all hands at the same time, and record their transfers.

    :param devices: where each hand is: ``usbip://host:port``, the same with ``/serial``, a serial
        number, or empty for the only one of its side on this machine.
    :param report: called with progress messages for the user.
    :param stop: ends the run early when set; the recording so far is kept.
    :param processes: those of emulated hands on this machine.
    :returns: False when it was ended early.
    :raises ConformanceError: a hand is not there, or cannot be opened.
    """
    stop = stop or threading.Event()
    hosts: dict[Side, UsbHost] = {}
    record = UsbRecord()
    try:
        for side, where in devices.items():
            hosts[side] = open_device(where, side)
        with (
            Heartbeat() as heart,
            RunQueue(processes) as queue,
            ThreadPoolExecutor(len(hosts)) as pool,
        ):
            turn = threading.Lock()
            runs = {
                side: pool.submit(
                    _play, side, host, recorder, turn, stop, report if i == 0 else lambda text: None
                )
                for i, (side, host) in enumerate(hosts.items())
            }
            try:
                record.sides = {side: future.result() for side, future in runs.items()}
            except BaseException:
                stop.set()  # end the other hand's script as well
                raise
        record.stalls, record.beats, record.waits = heart.stalls, heart.beats, queue.waits
        recorder.add_metadata(RECORD, record.to_metadata())
    finally:
        for host in hosts.values():
            host.close()
    return not stop.is_set()


def _play(
    side: Side,
    host: UsbHost,
    recorder: Recorder,
    turn: threading.Lock,
    stop: threading.Event,
    report: Callable[[str], None],
) -> SideRecord:
    descriptors: Descriptors = host.descriptors
    plan = Plan(side)
    pair = bulk_pair(descriptors)
    for inward in (False, True):
        recorder.add_foreign_channel(topic(side, inward=inward), SCHEMA_NAME, SCHEMA)
    if pair is None:
        report("interface 0 has no pair of bulk endpoints: the device cannot be tested further")
        return SideRecord(
            descriptors, list(plan.buses), trouble="there is no pair of bulk endpoints"
        )
    script: UsbScript = layer("usb").script(DEX3_1.name)(plan, report)
    player = _Player(side, host, pair, recorder, turn)
    try:
        if not play(script, player.carry_out, stop.is_set):
            script.trouble = "it was stopped"
    finally:
        player.end_turn()
        if not script.finished:  # stopped, or the device failed: leave no motor driven
            player.carry_out(Out(script.lock_frame()))
            player.carry_out(In(_LAST_ANSWER))
    phases = [p for p in script.phases if p.end_ns]
    return SideRecord(descriptors, list(plan.buses), phases, script.trouble)


class _Player:
    """Carries out one script's actions."""

    def __init__(
        self,
        side: Side,
        host: UsbHost,
        pair: tuple[Endpoint, Endpoint],
        recorder: Recorder,
        turn: threading.Lock,
    ) -> None:
        self._topics = {inward: topic(side, inward=inward) for inward in (False, True)}
        self._host = host
        self._out, self._in = (endpoint.address for endpoint in pair)
        self._recorder = recorder
        self._turn, self._has_turn = turn, False
        self._clock = RealClock()
        # wall clock, as in recordings, advanced by the monotonic clock
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def _now_ns(self) -> int:
        return time.monotonic_ns() + self._offset_ns

    def carry_out(self, action: Action) -> Observation:
        """Carry out an action and return its result."""
        status, data = 0, b""
        begin = self._now_ns()
        match action:
            case Out(data=sent, timeout=timeout):
                status = self._host.write(self._out, sent, timeout)
                self._put(Transfer(begin, self._now_ns(), self._out, status, len(sent), sent))
            case In(timeout=timeout, length=length):
                status, data = self._host.read(self._in, length, timeout)
                self._put(Transfer(begin, self._now_ns(), self._in, status, length, data))
            case Wait(until_ns=until):
                sleep_awake(self._clock, (until - self._offset_ns) / 1e9)
            case Alone(alone=True):
                self._turn.acquire()
                self._has_turn = True
            case Alone():
                self.end_turn()
            case Reopen():
                try:
                    self._host.reopen()
                except ConformanceError:
                    status = -1  # the next commands get no answer, which the checks report
        return Observation(self._now_ns(), status, data)

    def end_turn(self) -> None:
        """Hand over to the run of the other hand."""
        if self._has_turn:
            self._has_turn = False
            self._turn.release()

    def _put(self, transfer: Transfer) -> None:
        self._recorder.put(
            self._topics[transfer.inward],
            SCHEMA_NAME,
            transfer.payload(),
            transfer.done_ns,
            transfer.submitted_ns,
        )
