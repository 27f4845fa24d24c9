"""Implement :class:`dexkit.hand.Hand` for the Dex3-1 on USB or USB/IP."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from dexkit.backends import Backend, BackendOptions, Emulator
from dexkit.clock import Clock, RealClock
from dexkit.command_age import WriteDeadline
from dexkit.drivers.dex3_usb.discovery import Server, find_hand
from dexkit.drivers.dex3_usb.link import LinkStatistics, UsbLink
from dexkit.drivers.dex3_usb.settings import (
    MEASURED,
    SETTINGS,
    Dex3Settings,
    from_options,
    with_stored,
)
from dexkit.drivers.dex3_usb.stored import Store, record_key
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout, UsageError, WireError
from dexkit.hand import HandCommand, HandSpec, HandState, MotorError, Side
from dexkit.lazy import Lazy
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import COMMAND_LAYOUTS, CommandLayout, HandCodec, parse_state

__all__ = ["Dex3Statistics", "Dex3Usb", "backend"]

log = logging.getLogger(__name__)

_IO_RATE = 1000.0  # the Dex3-1 manual "Communication rate"
_LATE_ANSWER_TIME = 0.05  # seconds of an exchange beyond its two time-outs, for a late answer
_LOST_AFTER = 10
"""Exchanges in a row without a motor's packet until the motor is reported as lost: 10 ms at 1000
Hz, which random bit errors do not reach."""
_OPENING_EXCHANGES = 5
"""Exchanges that ``open`` makes at most until every motor has reported its state."""
_BRAKE_ATTEMPTS = 2
"""Brake commands that ``close`` sends at most to a hand that does not answer."""


@dataclass
class Dex3Statistics:
    """Counters since the object was created.

    :ivar damaged_frames: answers that were not intact frames.
    :ivar damaged_packets: motor and sensor packets lost inside intact frames.
    :ivar trips: times that the motors' time-out protection had stopped them.
    :ivar link: counters of the link since it was opened.
    """

    damaged_frames: int = 0
    damaged_packets: int = 0
    trips: int = 0
    link: LinkStatistics = field(default_factory=LinkStatistics)


class Dex3Usb:
    """A Dex3-1 on USB, or behind a USB/IP server.

    :param side: which hand.
    :param configuration: place, frame layout, bus map, protection and time-outs.

    ``open`` finds the hand and brakes it; it searches a lost hand where it was found the first
    time. Commands enable the motors' time-out protection (unless ``protect`` is off): each motor
    stops one second after its last command, so none is driven after this process dies. A motor
    whose protection has tripped gets one brake command, which clears the trip, and obeys the next.
    """

    reconnect_interval = 0.5
    """Longest time between the service's attempts to open a lost hand again, seconds. Short,
    because listing USB devices is cheap."""

    def __init__(
        self,
        side: Side,
        configuration: Dex3Settings | None = None,
        *,
        clock: Clock | None = None,
    ) -> None:
        self.configuration = configuration if configuration is not None else Dex3Settings()
        self.statistics = Dex3Statistics()
        self._clock: Clock = clock if clock is not None else RealClock()
        self._link: UsbLink | None = None
        self._found = False
        self._server: Server | None = None  # where the hand was found
        self._spec = DEX3_1.spec(
            side,
            io_rate=_IO_RATE,
            exchange_timeout=self.configuration.send_timeout
            + self.configuration.timeout
            + _LATE_ANSWER_TIME,
        )
        n = self._spec.n_joints
        self._brake = HandCommand.brake(n)
        self._protect: NDArray[np.bool_] = np.full(n, self.configuration.protect)
        self._reset()

    def _reset(self) -> None:
        self._apply(self.configuration)
        self._last: HandState | None = None
        self._tripped: NDArray[np.bool_] | None = None
        self._missed = np.zeros(self._spec.n_joints, np.intp)
        self._any_missed = False

    def _apply(self, effective: Dex3Settings) -> None:
        """Take over settings that describe the hand.

        :raises UsageError: limits that are not within the model's.
        """
        side = self._spec.side
        joints = effective.joints(side)
        self._effective = effective
        self._spec = replace(self._spec, joints=joints)
        self._limits = None if effective.limits is None else (self._spec.q_min, self._spec.q_max)
        self._codec = self._make_codec(bool(effective.poll_sensors))

    def _make_codec(self, poll_sensors: bool) -> HandCodec:
        effective = self._effective
        return HandCodec(
            self._spec.joints,
            effective.bus_map,
            effective.layout,
            head=effective.head,
            mounting=effective.mounting(self._spec.side),
            poll_sensors=poll_sensors,
        )

    def _load_stored(self, serial: str) -> None:
        """Apply the settings that the file holds for this hand.

        :raises HandRefused: nobody has found its wiring, and guesses are not accepted.
        """
        if self.configuration.config is None:
            return
        store, key = Store(self.configuration.config), record_key(serial, self._spec.side)
        texts = store.section(key, "settings")
        try:
            self._apply(with_stored(self.configuration, texts))
        except UsageError as error:
            raise UsageError(
                f"{store.path}: {key}: {error.message}", hint=error.hint or "dexkit bringup"
            ) from error
        guessed = [what for name, what in MEASURED.items()
                   if name not in texts and name not in self.configuration.given]  # fmt: skip
        if guessed and not self.configuration.guesses:
            raise HandRefused(
                f"hand {key} has not been brought up: {store.path} does not say "
                f"{', '.join(guessed)}",
                hint=f"dexkit bringup dex3-usb --side {self._spec.side} finds them; "
                "--set config=FILE names another file; --set guesses=accept commands the hand on "
                "dexkit's guesses",
            )
        if guessed:
            log.warning("hand %s has not been brought up; guessed: %s", key, ", ".join(guessed))
        if texts:
            log.info("settings of hand %s from %s: %s", key, store.path, ", ".join(sorted(texts)))

    @property
    def settings(self) -> Dex3Settings:
        """The settings in force: those given, and what the file holds for the open hand."""
        return self._effective

    @property
    def spec(self) -> HandSpec:
        """Side, joints, rates and time-outs of this hand."""
        return self._spec

    @property
    def serial(self) -> str:
        """Serial number of the open hand; empty if it has none or is not open."""
        return self._link.serial if self._link is not None else ""

    # --- opening and closing

    def open(self) -> None:
        """Find the hand, claim its interface, brake it and wait for every motor's state. No motion.

        :raises HandNotFound: there is none, or more than one; the message lists what there is.
        :raises HandRefused: no permission, another program uses it, it is the other side's, or a
            motor is not where the bus map says, or it was never brought up.
        :raises HandTimeout: it does not answer, or not with whole state frames.
        :raises HandLost: it goes away meanwhile.
        """
        if self._link is not None:
            return
        configuration = self.configuration
        candidate = find_hand(
            self._spec.side,
            serial=configuration.serial,
            server=self._server if self._found else configuration.server,
            local=configuration.local and not self._found,
        )
        self._reset()
        self._link = UsbLink(
            candidate.backend,
            candidate.device,
            str(candidate),
            out_endpoint=configuration.out_endpoint,
            in_endpoint=configuration.in_endpoint,
        )
        self.statistics.link = self._link.statistics
        try:
            self._load_stored(self._link.serial)
            state = self._await_all_motors(self._link)
            self._choose_polling(self._link)
        except BaseException:
            self.close()
            raise
        # opening again must not replace an emulated hand by a real one, or the reverse
        self._found, self._server = True, candidate.server
        log.info(
            "%s: serial number %s, endpoints %#04x and %#04x, supply %.1f V",
            self._link.name,
            self._link.serial or "none",
            self._link.endpoints.out,
            self._link.endpoints.into,
            state.supply.power_v if state.supply else np.nan,
        )

    def _await_all_motors(self, link: UsbLink) -> HandState:
        # bit 7 = 0 clears protections that tripped while no host sent commands (the Dex3-1 manual
        # RIS_Mode_t)
        frame = self._codec.encode(self._brake, False)
        problem: HandError | None = None
        answer = b""
        for _ in range(_OPENING_EXCHANGES):
            try:
                answer, state = self._transfer(link, frame)
            except HandTimeout as error:
                problem = error
                if link.statistics.timeouts >= 2:  # the first may come from the last host's traffic
                    break
                continue
            self._keep_last_values(state)
            if not np.isnan(state.q).any():
                self._last = state
                return state
        if not answer:
            assert problem is not None
            raise HandTimeout(
                problem.message,
                hint="is its power on? The manual has two sizes of the command frame: "
                f"try --set frame={_other_layout(self._effective.layout)}",
            ) from problem
        raise self._missing_motors_error(answer)

    def _choose_polling(self, link: UsbLink) -> None:
        """Address the sensors if none answers otherwise and some do then."""
        sensors = len(self._effective.bus_map.sensors)
        polled = self._effective.poll_sensors
        if polled is None and len(self._codec.missing_sensors) == sensors:
            plain, self._codec = self._codec, self._make_codec(True)
            frame = self._codec.encode(self._brake, False)
            for _ in range(_OPENING_EXCHANGES):
                try:
                    _, self._last = self._transfer(link, frame)
                except HandTimeout:
                    continue
                if len(self._codec.missing_sensors) < sensors:
                    polled = True
                    break
            else:
                self._codec = plain
        answer = sensors - len(self._codec.missing_sensors)
        how = "addressed" if polled else "not addressed"
        log.info("%s: %d of %d sensors answer, %s", link.name, answer, sensors, how)

    def _missing_motors_error(self, answer: bytes) -> HandRefused:
        motors = self._effective.bus_map.motors
        silent = ", ".join(
            f"{self._spec.joints[i].name} (bus {motors[i][0]} id {motors[i][1]})"
            for i in self._codec.missing_motors
        )
        heard = ", ".join(f"{bus}.{motor.id}" for bus, motor in parse_state(answer).motors)
        return HandRefused(
            f"no state of the motor(s) {silent}",
            hint=f"motors that answer (bus.id): {heard or 'none'}; if their places are others, "
            "say so with --set motors=..., or find them: dexkit bringup dex3-usb",
        )

    def close(self) -> None:
        """Brake the motors and release the hand. Failures are logged, not raised."""
        link, self._link = self._link, None
        if link is None:
            return
        try:
            if self._last is not None:
                self._brake_motors(link)
        except HandError as error:
            rest = (
                "its motors stop by themselves within a second"
                if self.configuration.protect
                else "its motors are without protection and may go on: cut their power"
            )
            log.warning("could not brake: %s; %s", error, rest)
        finally:
            link.close()
            # a failed opening is reported by open() at every attempt
            level = logging.DEBUG if self._last is None else logging.INFO
            log.log(level, "%s closed: %s", link.name, self.statistics)

    def _brake_motors(self, link: UsbLink) -> None:
        # bit 7 = 0: otherwise the protections would trip a second after this
        frame = self._codec.encode(self._brake, False)
        configuration = self.configuration
        for left in reversed(range(_BRAKE_ATTEMPTS)):
            try:
                link.exchange(frame, configuration.send_timeout, configuration.timeout)
                return
            except HandTimeout:  # the command may be lost, for example at a stalled endpoint
                if not left:
                    raise

    def __enter__(self) -> Dex3Usb:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    # --- exchanging

    def exchange(self, command: HandCommand) -> HandState:
        """Send one command frame and return the state frame that answers it.

        A motor whose packet is missing or damaged keeps its last state; after ten exchanges it
        reports ``MotorError.HOST_SAW_MOTOR_TIMEOUT``.

        :raises HandLost: the hand has gone away, or is not open.
        :raises HandTimeout: no intact answer in time, a stalled endpoint, or this program was
            paused before the command was sent.
        """
        deadline = WriteDeadline(self._clock)
        link = self._link
        if link is None:
            raise HandLost("the driver is not connected to the hand", hint="call open() first")
        if self._limits is not None:
            command = replace(command, q=np.clip(command.q, *self._limits))
        protect, tripped = self._protect, self._tripped
        if tripped is not None:
            # one lock packet with bit 7 = 0 clears a motor's trip
            command, protect = _brake_joints(command, tripped), protect & ~tripped
        _, state = self._transfer(link, self._codec.encode(command, protect), deadline)
        if self._codec.missing_motors or self._any_missed:
            self._keep_last_values(state)
        self._detect_trips(state)
        self._last = state
        return state

    def _transfer(
        self, link: UsbLink, frame: bytes, before: WriteDeadline | None = None
    ) -> tuple[bytes, HandState]:
        configuration = self.configuration
        answer = link.exchange(frame, configuration.send_timeout, configuration.timeout, before)
        try:
            state = self._codec.decode(answer, self._clock.now())
        except WireError as error:
            self.statistics.damaged_frames += 1
            link.resynchronise()
            raise HandTimeout(f"{link.name} gave no intact answer: {error}") from error
        if self._codec.problems:
            self.statistics.damaged_packets += len(self._codec.problems)
            log.debug("damaged packets: %s", "; ".join(map(str, self._codec.problems)))
        return answer, state

    def _keep_last_values(self, state: HandState) -> None:
        """Repeat the last state of motors missing in this frame; report long absence as a fault."""
        gone = list(self._codec.missing_motors)
        self._missed[gone] += 1
        self._missed[[i for i in range(len(self._missed)) if i not in gone]] = 0
        self._any_missed = bool(gone)
        if self._last is not None:
            for name in ("q", "dq", "tau_est", "temperature", "voltage", "mode", "fault"):
                getattr(state, name)[gone] = getattr(self._last, name)[gone]
            if state.winding_temperature is not None and (
                self._last.winding_temperature is not None
            ):
                state.winding_temperature[gone] = self._last.winding_temperature[gone]
        state.fault[self._missed >= _LOST_AFTER] |= np.uint32(MotorError.HOST_SAW_MOTOR_TIMEOUT)

    def _detect_trips(self, state: HandState) -> None:
        bits = state.fault & _TRIPPED
        if not bits.any():
            self._tripped = None
            return
        before, self._tripped = self._tripped, bits != 0
        if before is None:
            self.statistics.trips += 1
            joints = [self._spec.joints[i].name for i in np.flatnonzero(bits)]
            log.warning(
                "%s received no command for 1 s and the protection stopped them; "
                "driving them again",
                ", ".join(joints),
            )


_TRIPPED = np.uint32(MotorError.MOTOR_SAW_HOST_TIMEOUT)


def _other_layout(layout: CommandLayout) -> str:
    return next(other.name for other in COMMAND_LAYOUTS if other is not layout)


def _brake_joints(command: HandCommand, joints: NDArray[np.bool_]) -> HandCommand:
    """Return ``command`` with some joints braked."""
    keep = ~joints
    return replace(
        command,
        **{name: getattr(command, name) * keep for name in ("dq", "tau", "kp", "kd")},
        mode=command.mode * keep.astype(np.uint8),
    )


def _create_hand(options: BackendOptions) -> Dex3Usb:
    return Dex3Usb(options.side, from_options(options))


backend = Backend(
    summary="Dex3-1 on USB, or behind a USB/IP server (dexkit emulate dex3-usb)",
    model=DEX3_1.name,
    make=_create_hand,
    needs="--device serial number or usbip://HOST:PORT, if there is more than one hand",
    settings=SETTINGS,
    bringup=Lazy("dexkit.drivers.dex3_usb.bringup:bench"),
    udev_rules=Lazy("dexkit.systemd_units:usb_rules"),
    # the emulated hand is wired as the guesses say
    emulator=Emulator(
        ("dex3-usb", "--link", "usbip://127.0.0.1:0"), linked=False, settings={"guesses": "accept"}
    ),
    usb_requirements=True,
    settings_file=Lazy("dexkit.drivers.dex3_usb.settings:default_path"),
)
