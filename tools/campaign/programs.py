"""Killing, stopping and interrupting every program, while it works.

A run: start it, wait until it is ready, let it work, then SIGKILL, SIGTERM or SIGINT at a moment
of chance; or SIGSTOP, half a second to three, and SIGCONT. Afterwards: no traceback, a right exit
code, no child and no temporary file left, the recording readable, the hand at rest, and the next
start works.
"""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from dexkit.backends import simulators
from dexkit.errors import DexkitError
from dexkit.hand import Side
from dexkit.messages import encode, unitree_go
from dexkit.models import DEX1_1, MODELS, Dialect
from dexkit.robots import ROBOTS
from dexkit.temporary_folder import sweep
from dexkit.traces import sample_path
from tools.campaign.case import Batch, Case
from tools.campaign.devices import DEVICES, M4010, Bench, DeviceBench, Dex3, Mx64, command
from tools.campaign.process import Program
from tools.campaign.waiting import WaitTimeout, until

__all__ = ["Client", "Scene", "Spec", "cases", "specs"]

SIDE = Side.LEFT
_SETTLED = 0.2
"""Seconds of rest that count as standing still."""


class Client:
    """A client on DDS in this process: commands at 100 Hz while it has a goal; reads states.

    :param dialect: that it speaks; ``message`` makes a command of a goal.
    """

    def __init__(self, domain: int, dialect: Dialect, message: Callable[[float], bytes]) -> None:
        from dexkit.dds import DdsNode

        self._message = message
        command, state = dialect.topics(SIDE)
        self.node = DdsNode(domain, "lo")
        self._writer = self.node.writer(command, dialect.cmd_type)
        self._reader = self.node.reader(state, dialect.state_type)
        self.states = 0
        self.newest: Any = None
        self.goal: float | None = None
        self.sent = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="campaign-client", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            for sample in self._reader.take():
                self.states += 1
                self.newest = sample
            goal = self.goal
            if goal is not None:
                self._writer.write_raw(self._message(goal))
                self.sent = time.monotonic()

    def wait_states(self, timeout: float = 60.0) -> None:
        """Wait for new states.

        :raises WaitTimeout: none came.
        """
        before = self.states
        until(lambda: self.states > before + 2, "states", timeout)

    def close(self) -> None:
        """Leave."""
        self._stop.set()
        self._thread.join()
        self.node.close()


@dataclass
class Scene:
    """The devices and clients of a program in a batch.

    :ivar client: a client, where the program has one.
    :ivar device: the emulated device, where it drives one, and ``bench`` what knows it.
    """

    batch: Batch
    client: Client | None = None
    device: Any = None
    bench: Bench | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    @property
    def domain(self) -> str:
        """DDS domain, as text."""
        return str(self.batch.domain)

    @property
    def scratch(self) -> Path:
        """The folder of the batch."""
        return self.batch.scratch

    def position(self) -> float | None:
        """Where the device is, or None."""
        if not isinstance(self.bench, DeviceBench) or self.device is None:
            return None
        return self.bench.position(self.device)


Stage = Callable[[Scene], "contextlib.AbstractContextManager[None]"]


@dataclass(frozen=True)
class Spec:
    """A program with the test that it works.

    :param command: its arguments behind ``python -m``; with the ``{domain}``, the one ``{beside}``
        it, a ``{port}``, the ``{scratch}`` folder and a ``{sample}`` of a recording.
    :param stage: what must be there for it.
    :param ready: what it prints when it works.
    :param codes: exit codes that are right after SIGINT and SIGTERM.
    :param works: waits until it does its work; after a start and after a stop.
    :param after: looks at what it left.
    """

    name: str
    command: str
    stage: Stage
    ready: str = "ready:"
    codes: tuple[int, ...] = (0,)
    works: Callable[[Scene, Program], None] = lambda scene, program: None
    after: Callable[[Scene, bool], None] = lambda scene, killed: None

    def words(self, scene: Scene) -> list[str]:
        """The command in a scene."""
        domain = scene.batch.domain
        places = {
            "domain": domain,
            "beside": domain + 1,
            "port": 4000 + domain,
            "scratch": scene.scratch,
            "sample": sample_path("dex1_pick_place"),
        }
        words = [word.format(**places) for word in self.command.split()]
        if isinstance(scene.bench, DeviceBench) and scene.device is not None:
            words += scene.bench.options(scene.device)
            words.append("--wait-for-device")  # on a busy machine it may answer late
        return words


# --- stages


@contextlib.contextmanager
def _nothing(scene: Scene) -> Iterator[None]:
    yield


def _with_client(make: Callable[[Path], Bench]) -> Stage:
    @contextlib.contextmanager
    def stage(scene: Scene) -> Iterator[None]:
        with contextlib.ExitStack() as stack:
            scene.bench = bench = make(scene.scratch)
            if isinstance(bench, DeviceBench):
                scene.device = stack.enter_context(bench.device())
            scene.client = Client(scene.batch.domain, bench.dialect, bench.message)
            stack.callback(scene.client.close)
            yield

    return stage


@contextlib.contextmanager
def _talk(scene: Scene, *, states: bool = True) -> Iterator[None]:
    """A program that publishes commands for a Dex1-1, and states of it."""
    from dexkit.dds import DdsNode

    stop = threading.Event()
    dialect = DEX1_1.dialects[0]
    command_topic, state_topic = dialect.topics(SIDE)
    with DdsNode(scene.batch.domain, "lo") as node:
        writers = [(node.writer(command_topic, dialect.cmd_type), command(dialect, 0.2))]
        if states:
            state = encode(unitree_go.MotorStates_([unitree_go.MotorState_(q=1.0)]))
            writers.append((node.writer(state_topic, dialect.state_type), state))

        def run() -> None:
            while not stop.wait(0.005):
                for writer, data in writers:
                    writer.write_raw(data)

        thread = threading.Thread(target=run, name="campaign-talk", daemon=True)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


# --- what it means that a program works


def _states(scene: Scene, program: Program) -> None:
    assert scene.client is not None
    scene.client.wait_states()


def _topic_flows(topic: str, kind: str, beside: int = 0) -> Callable[[Scene, Program], None]:
    """Samples come on a topic, ``beside`` domains above that of the scene."""

    def works(scene: Scene, program: Program) -> None:
        from dexkit.dds import DdsNode

        with DdsNode(scene.batch.domain + beside, "lo") as node:
            reader = node.reader(topic, kind)
            seen = 0
            end = time.monotonic() + 60.0
            while seen < 3:
                if time.monotonic() > end or not program.running:
                    raise WaitTimeout(f"no {topic} from {program!r}")
                if reader.wait(0.5):
                    seen += len(reader.take())

    return works


def _answers(scene: Scene, program: Program) -> None:
    """A driver can open the emulated device and exchange with it."""
    bench = scene.bench
    assert isinstance(bench, DeviceBench)
    _wait_for_exchange(scene, program, bench.hand)


def _wait_for_exchange(scene: Scene, program: Program, make: Callable[[], Any]) -> None:
    from dexkit.hand import HandCommand

    def once() -> bool:
        hand = make()
        try:
            hand.open()
            hand.exchange(HandCommand.brake(hand.spec.n_joints))
            return True
        except DexkitError as error:
            scene.extra["error"] = error
            return False
        finally:
            hand.close()

    until(once, f"{program!r} to answer a driver")


def _emulated(make: Callable[[Path], Bench]) -> Stage:
    @contextlib.contextmanager
    def stage(scene: Scene) -> Iterator[None]:
        scene.bench = make(scene.scratch)
        yield

    return stage


def _recording_grows(scene: Scene, program: Program) -> None:
    path = scene.scratch / "out.mcap"

    def count() -> int:
        """Messages in the file; what else is in it grows before and without them."""
        from dexkit.traces import open_trace

        try:
            return sum(1 for _ in open_trace(path).messages()) if path.exists() else 0
        except DexkitError:
            return 0

    before = count()
    until(lambda: not program.running or count() > before, f"messages in {path.name}")


def _readable(scene: Scene, killed: bool) -> None:
    from dexkit.traces import open_trace

    path = scene.scratch / "out.mcap"
    if not path.exists():
        scene.batch.found("no recording", "record", f"killed: {killed}")
        return
    try:
        trace = open_trace(path)
        count = len(list(trace.messages()))
    except DexkitError as error:
        scene.batch.found("unreadable recording", "record", f"killed: {killed}: {error}")
        return
    if not count:
        scene.batch.found("empty recording", "record", f"killed: {killed}")
    if not killed and (trace.truncated or trace.warnings):
        scene.batch.found("recording not finished", "record", f"{trace.warnings}")


def _output_grows(scene: Scene, program: Program) -> None:
    if scene.extra.get("heard") == program.process.pid:
        return  # it speaks when something has changed
    size = len(program.output)
    scene.extra["heard"] = program.process.pid
    until(lambda: len(program.output) > size or not program.running, f"more words of {program!r}")


# --- the programs


def _served() -> dict[str, Callable[[Path], Bench]]:
    """The benches of ``serve``, by backend: simulated hands with torque control, emulated
    devices.
    """
    found: dict[str, Callable[[Path], Bench]] = {
        backend: partial(Bench, backend=backend)
        for name, backend in simulators().items()
        if not MODELS[name].dialects[0].position_servo
    }
    return found | {bench.backend: bench for bench in DEVICES}


def specs() -> list[Spec]:
    """Every program that runs until it is asked to end."""
    source, target = DEX1_1.dialects[:2]
    asked, forwarded = source.topics(SIDE)[0], target.topics(SIDE)[0]
    ends = (0, 1, 130, 143, -2, -15)

    def robot(name: str, like: str) -> Spec:
        works = _topic_flows("rt/lowstate", ROBOTS[like].state_type)
        return Spec(f"emulate-{name}", f"dexkit emulate {name} --domain {{domain}}", _nothing,
                    works=works)  # fmt: skip

    return [
        *(
            Spec(f"serve-{backend}", f"dexkit serve {backend} --side left --domain {{domain}}",
                 _with_client(bench), works=_states)
            for backend, bench in _served().items()
        ),
        Spec("bridge",
             f"dexkit bridge {source.name} {target.name} --side left "
             "--domain {domain} --to-domain {beside}",
             partial(_talk, states=False), works=_topic_flows(forwarded, target.cmd_type, 1)),
        Spec("record", "dexkit record {scratch}/out.mcap --overwrite --domain {domain}", _talk,
             works=_recording_grows, after=_readable),
        Spec("publish",
             f"dexkit publish {{sample}} --loop --wait 0 --domain {{domain}} --topic {asked}",
             _nothing, ready="", codes=(0, 1, 130), works=_topic_flows(asked, source.cmd_type)),
        Spec("emulate-mx64", "dexkit emulate mx64 --link {scratch}/mx64 --set any-baudrate=yes",
             _emulated(Mx64), works=_answers),
        Spec("emulate-dex1-motor", "dexkit emulate dex1-motor --link {scratch}/m4010",
             _emulated(M4010), works=_answers),
        Spec("emulate-dex3-usb", "dexkit emulate dex3-usb --link usbip://127.0.0.1:{port}",
             _emulated(Dex3), works=_usb_answers),
        robot("h1", "h1"),
        robot("g1", "g1"),
        robot("all", "g1"),
        Spec("doctor-watch", "dexkit doctor --watch --domain {domain} --scan none --seconds 0.3",
             _talk, ready="", codes=ends, works=_output_grows),
        Spec("conformance",
             "pytest conformance/ --backend sim-dex1 --quick --side left -p no:cacheprovider "
             "--domain {domain} --result {scratch}/result.json",
             _nothing, ready="", codes=(*ends, 2), works=_output_grows),
    ]  # fmt: skip


def _usb_answers(scene: Scene, program: Program) -> None:
    from dexkit.drivers.dex3_usb import Dex3Settings, Dex3Usb
    from dexkit.drivers.dex3_usb.discovery import Server

    server = Server("127.0.0.1", 4000 + scene.batch.domain)
    settings = Dex3Settings(server=server, timeout=1.0)
    _wait_for_exchange(scene, program, lambda: Dex3Usb(SIDE, settings))


class _Runs(Case):
    """Runs of one program."""

    limit = 400.0

    def __init__(self, spec: Spec) -> None:
        self.spec = spec

    def run(self, batch: Batch) -> None:
        logging.disable()
        scene = Scene(batch)
        with self.spec.stage(scene):
            try:
                self.runs(batch, scene)
            except WaitTimeout as error:
                batch.found("not ready", self.name, str(error))
        temporary = batch.scratch / "tmp"
        if temporary.exists():
            sweep(
                temporary
            )  # as whatever starts next does; the last program may not have come so far
        left = sorted(p.name for p in temporary.iterdir()) if temporary.exists() else []
        if left and not batch.findings:
            batch.found("temporary files left", self.name, ", ".join(left))

    def runs(self, batch: Batch, scene: Scene) -> None:
        """Start, disturb, look; several times in one scene."""
        raise NotImplementedError

    def start(self, batch: Batch, scene: Scene) -> Program:
        """Start it and wait until it works."""
        program = Program(batch, self.spec.words(scene))
        try:
            if self.spec.ready:
                program.wait_for(self.spec.ready)
            self.spec.works(scene, program)
        except WaitTimeout as error:
            program.end()
            program.check_output(batch)
            raise WaitTimeout(f"{error}; it printed: {program.output[-1500:]}") from None
        except BaseException:
            program.end()
            raise
        return program

    def ended(self, batch: Batch, scene: Scene, program: Program, number: int) -> None:
        """Wait for its end and look at everything that it must not leave."""
        how = signal.Signals(number).name
        code = program.wait()
        if code is None:
            batch.found("does not end", f"{self.name} {how}", program.output[-2000:])
            program.end()
        elif number == signal.SIGKILL:
            if code != -signal.SIGKILL:
                batch.found("ended by itself", self.name, f"{code}: {program.output[-2000:]}")
        elif code not in self.spec.codes:
            batch.found("exit code", f"{self.name} {how}", f"{code}: {program.output[-2000:]}")
        program.check_output(batch)
        left = program.left_behind()
        if left:
            batch.found("child left behind", f"{self.name} {how}", "\n".join(left))
        self.spec.after(scene, number == signal.SIGKILL)


class KillCase(_Runs):
    """Ends it in every way."""

    unit = "kills"

    def __init__(self, spec: Spec) -> None:
        super().__init__(spec)
        self.name = f"kill:{spec.name}"
        self.what = f"{spec.name}, ended by SIGKILL, SIGTERM and SIGINT"

    def runs(self, batch: Batch, scene: Scene) -> None:
        endings = [signal.SIGKILL, signal.SIGTERM, signal.SIGINT]
        batch.random.shuffle(endings)
        if batch.sample:
            endings = [signal.SIGKILL]
        # the last one in good order
        for number in [*endings, signal.SIGTERM]:
            program = self.start(batch, scene)
            try:
                if scene.client is not None and scene.bench is not None:
                    scene.client.goal = batch.random.choice((scene.bench.low, scene.bench.high))
                time.sleep(batch.random.uniform(0.0, 0.6))
                program.signal(number)
                self.ended(batch, scene, program, number)
                batch.units += 1
                self._at_rest(batch, scene, number)
            finally:
                if scene.client is not None:
                    scene.client.goal = None
                program.end()

    def _at_rest(self, batch: Batch, scene: Scene, number: int) -> None:
        """The device stops by itself within its time-out, though the client goes on."""
        if scene.device is None or scene.bench is None:
            return
        try:
            _wait_still(scene, 5.0)
        except WaitTimeout:
            batch.found("moves afterwards", f"{self.name} {signal.Signals(number).name}", "for 5 s")


class StopCase(_Runs):
    """Stops it for a while, and lets it go on."""

    unit = "stops"

    def __init__(self, spec: Spec) -> None:
        super().__init__(spec)
        self.name = f"stop:{spec.name}"
        self.what = f"{spec.name}, stopped for half a second to three"

    def runs(self, batch: Batch, scene: Scene) -> None:
        program = self.start(batch, scene)
        try:
            for _ in range(1 if batch.sample else 6):
                if not program.running:
                    break  # a conformance run that came to its end
                self._stop(batch, scene, program)
                batch.units += 1
            program.signal(signal.SIGTERM)
            if program.running or self.spec.ready:
                self.ended(batch, scene, program, signal.SIGTERM)
            else:
                program.check_output(batch)
        finally:
            with contextlib.suppress(ProcessLookupError):
                program.process.send_signal(signal.SIGCONT)
            program.end()

    def _stop(self, batch: Batch, scene: Scene, program: Program) -> None:
        rng = batch.random
        client, bench = scene.client, scene.bench
        if client is not None and bench is not None:
            # to and fro until it is in motion, then stop it there
            client.goal = rng.choice((bench.low, bench.high))
            if scene.device is not None:
                self._set_off(scene, client, bench)
        time.sleep(rng.uniform(0.0, 0.3))
        program.signal(signal.SIGSTOP)
        stopped = time.monotonic()
        seconds = rng.uniform(0.5, 3.0) if rng.random() < 0.4 else rng.uniform(0.5, 1.0)
        if client is not None and bench is not None:
            if rng.random() < 0.7:
                client.goal = bench.low + bench.high - (client.goal or bench.low)
            time.sleep(rng.uniform(0.0, max(0.0, min(0.5, seconds - 0.8))))
            client.goal = None  # the client goes away while the service is stopped
        time.sleep(max(0.0, stopped + seconds - time.monotonic()))
        before = None
        if scene.device is not None:
            with contextlib.suppress(WaitTimeout):
                before = _wait_still(scene, 3.0)
        program.signal(signal.SIGCONT)
        if before is not None and client is not None and bench is not None:
            old_enough = time.monotonic() - client.sent > 0.4
            time.sleep(0.6)
            now = scene.position()
            assert now is not None
            if old_enough and abs(now - before) > bench.still:
                batch.found(
                    "moved unasked",
                    self.name,
                    f"by {now - before:.3f} when it went on after {seconds:.2f} s; the client had "
                    f"gone {time.monotonic() - client.sent:.2f} s before",
                )
        self.spec.works(scene, program)
        if scene.device is not None and client is not None and bench is not None:
            client.goal = rng.choice((bench.low, bench.high))
            self._set_off(scene, client, bench)
            client.goal = None

    def _set_off(self, scene: Scene, client: Client, bench: Bench) -> None:
        """Wait until the device moves by the client's commands."""
        start, began = scene.position(), time.monotonic()
        assert start is not None
        turned = False

        def moved() -> bool:
            nonlocal turned
            if not turned and time.monotonic() - began > 3.0:
                turned = True
                client.goal = bench.low + bench.high - (client.goal or bench.low)
            return abs((scene.position() or 0.0) - start) > bench.still

        until(moved, f"{self.spec.name} to obey a fresh command")


def _wait_still(scene: Scene, timeout: float) -> float:
    """Wait until the device has stood still for a moment; where.

    :raises WaitTimeout: it goes on moving.
    """
    assert scene.bench is not None
    last, since = scene.position() or 0.0, time.monotonic()

    def still() -> bool:
        nonlocal last, since
        assert scene.bench is not None
        now = scene.position() or 0.0
        if abs(now - last) > scene.bench.still / 10:
            last, since = now, time.monotonic()
        return time.monotonic() - since > _SETTLED

    until(still, "the hand to stand still", timeout)
    return last


def cases() -> list[Case]:
    """Every program, killed and stopped."""
    found: list[Case] = []
    for spec in specs():
        found += [KillCase(spec), StopCase(spec)]
    return found
