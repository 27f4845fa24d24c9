"""Bring up a Dex3-1: motors, measurements and stored settings of ``dexkit bringup dex3-usb``."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from dexkit.backends import BackendOptions
from dexkit.bringup.bench import Drive, JointChoice, Plan, Reading, Snapshot
from dexkit.bringup.findings import Findings
from dexkit.drivers.dex3_usb.discovery import Server, find_hand
from dexkit.drivers.dex3_usb.link import UsbLink
from dexkit.drivers.dex3_usb.probe import Found, Wire, lock, probe
from dexkit.drivers.dex3_usb.settings import Dex3Settings, format_places, from_options
from dexkit.drivers.dex3_usb.stored import Store, record_key
from dexkit.errors import HandError, HandLost, HandRefused, HandTimeout, WireError
from dexkit.hand import JointMode, JointSpec, MotorError, Side
from dexkit.models import DEX3_1
from dexkit.wire.dex3_usb import MotorCmd, parse_state, units

__all__ = ["Dex3Bench", "bench", "plan_of"]

log = logging.getLogger(__name__)

_REFERENCE = 108.0
"""Gear ratio assumed for a motor until its own is known."""
_RATIOS = (108.0, 189.0, 214.0)
"""The actuators' 108 and 214, and 108 x 1.75, which torque and speed of thumb_0 allow
(docs/sources/unitree-dex.md#b4)."""
_ORDER = ("index_1", "index_0", "middle_1", "middle_0", "thumb_2", "thumb_1", "thumb_0")
"""Outer joints first, fingers before the thumb: each finger is straight before its next joint
moves, and the thumb has room."""
_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_TRIPPED = int(MotorError.MOTOR_SAW_HOST_TIMEOUT)


def plan_of(side: Side) -> Plan:
    """Plan the bring-up of a Dex3-1."""
    specs = {spec.name: spec for spec in DEX3_1.joints[side]}
    return Plan(
        tuple(_choice(specs[name]) for name in _ORDER),
        _REFERENCE,
        tuple(sensor.place for sensor in DEX3_1.sensors),
    )


def _choice(spec: JointSpec) -> JointChoice:
    closing = spec.closing or 1
    # thumb_0 neither opens nor closes: by Unitree's URDF it turns the thumb towards the middle
    # finger as q rises, on both sides
    words = ("closed", "opened") if spec.closing else ("to-middle", "to-index")
    rising, falling = words if closing > 0 else words[::-1]
    zero = "straight" if spec.closing else "in the middle between index and middle finger"
    return JointChoice(spec.name, spec.q_min, spec.q_max, rising, falling, _RATIOS, zero, -closing)


class Dex3Bench:
    """A Dex3-1 that is being brought up.

    :param configuration: place and time-outs; what describes the hand is found.
    :param wire: exchanges frames with a hand that is not on USB, for tests.
    """

    def __init__(self, side: Side, configuration: Dex3Settings, wire: Wire | None = None) -> None:
        self.side = side
        self.plan = plan_of(side)
        self.configuration = configuration
        self._store = Store(configuration.config)
        self._wire = wire
        self._link: UsbLink | None = None
        self._found: Found | None = None
        self._facts: dict[str, Any] = {}
        self._server: Server | None = None

    @property
    def motors(self) -> tuple[str, ...]:
        """Addresses of the motors that answer."""
        return () if self._found is None else tuple(f"{b}.{n}" for b, n in self._found.motors)

    @property
    def facts(self) -> Mapping[str, Any]:
        """Serial number, versions, and what answered."""
        return self._facts

    @property
    def where(self) -> str:
        """Path of the settings file."""
        return str(self._store.path)

    @property
    def emulated(self) -> bool:
        """Whether the open hand is behind a USB/IP server of this machine."""
        return self._server is not None and self._server.host in _LOOPBACK

    # --- opening and closing

    def open(self) -> None:
        """Find the hand, claim it, and find out which frames it obeys. No motion.

        :raises HandError: as :func:`~dexkit.drivers.dex3_usb.discovery.find_hand`, ``UsbLink`` and
            :func:`~dexkit.drivers.dex3_usb.probe.probe`; or the hand has not seven motors.
        """
        if self._wire is None:
            self._wire = self._connect()
        try:
            found = probe(self._wire)
        except BaseException:
            self.close()
            raise
        self._found = found
        self._facts |= {
            "side": str(self.side),
            "model_code": found.model_code,
            "frame": found.layout.name,
            "head": found.head.hex(),
            "frames_tried": list(found.tried),
            "motors": list(self.motors),
            "sensors": [f"{bus}.{number}" for bus, number in found.sensors],
            "sensors_answer": {
                None: "not at all",
                False: "by themselves",
                True: "only where they are addressed",
            }[found.poll_sensors],
        }
        wanted = len(self.plan.joints)
        if len(found.motors) != wanted:
            self.close()
            raise HandRefused(
                f"{len(found.motors)} motors answer, a Dex3-1 has {wanted}: "
                f"{', '.join(self.motors)}",
                hint="is every motor powered and connected? docs/first-contact.md",
            )

    def _connect(self) -> Wire:
        configuration = self.configuration
        candidate = find_hand(
            self.side,
            serial=configuration.serial,
            server=configuration.server,
            local=configuration.local,
        )
        link = UsbLink(
            candidate.backend,
            candidate.device,
            str(candidate),
            out_endpoint=configuration.out_endpoint,
            in_endpoint=configuration.in_endpoint,
        )
        self._link, self._server = link, candidate.server
        descriptor = candidate.backend.get_device_descriptor(candidate.device)
        version = int(getattr(descriptor, "bcdDevice", 0))
        self._facts = {
            "serial": link.serial,
            "device_version": f"{version >> 8:x}.{version & 0xFF:02x}",
            "place": candidate.where,
            "endpoints": [f"{link.endpoints.out:#04x}", f"{link.endpoints.into:#04x}"],
        }
        return lambda frame: link.exchange(frame, configuration.send_timeout, configuration.timeout)

    def close(self) -> None:
        """Lock every motor and release the hand. Failures are logged, not raised."""
        try:
            if self._found is not None:
                self.exchange(None)
        except HandError as error:
            log.warning("could not lock the motors: %s; they stop within a second", error)
        finally:
            self._found = None
            if self._link is not None:
                self._link.close()
                self._link = self._wire = None

    # --- exchanging

    def exchange(self, drive: Drive | None) -> Snapshot:
        """Drive one motor, with its own protection, and lock all others.

        :raises HandLost: the hand has gone away, or is not open.
        :raises HandTimeout: no intact answer in time.
        """
        if self._found is None or self._wire is None:
            raise HandLost("the driver is not connected to the hand", hint="call open() first")
        packets = {(bus, number): lock(number) for bus, number in self._found.motors}
        if drive is not None:
            place = next(p for p in packets if f"{p[0]}.{p[1]}" == drive.motor)
            packets[place] = _encode(place[1], drive)
        answer = self._wire(self._found.frame(packets))
        try:
            state = parse_state(answer)
        except WireError as error:
            if self._link is not None:
                self._link.resynchronise()
            raise HandTimeout(f"no intact answer: {error}") from error
        return Snapshot(
            {
                f"{bus}.{motor.id}": Reading(
                    units.POSITION.decode(motor.pos, _REFERENCE),
                    # a protection that tripped between two questions is cleared by the lock
                    motor.merror & ~_TRIPPED if drive is None else motor.merror,
                    float(max(motor.temp, motor.sensor)),
                )
                for bus, motor in state.motors
            },
            {
                f"{bus}.{sensor.id}": tuple(map(units.PRESSURE.decode, sensor.pressure))
                for bus, sensor in state.sensors
            },
        )

    # --- results

    def settings(self, findings: Findings) -> dict[str, str]:
        """Settings that follow from the findings; lists over joints only once every joint is
        known.
        """
        found = self._found
        texts: dict[str, str] = {}
        if found is not None:
            texts = {"frame": found.layout.name, "head": found.head.hex()}
            if found.poll_sensors is not None:
                texts["poll_sensors"] = "on" if found.poll_sensors else "off"
        names = [spec.name for spec in DEX3_1.joints[self.side]]
        motors = {m.joint: (address, m.sign) for address, m in findings.motors.items()}
        if all(name in motors for name in names):
            texts["motors"] = ",".join(motors[name][0] for name in names)
            texts["signs"] = ",".join("+" if motors[name][1] > 0 else "-" for name in names)
        if all(name in findings.travel for name in names):
            travel = [findings.travel[name] for name in names]
            texts["ratios"] = ",".join(f"{t.ratio:g}" for t in travel)
            texts["offsets"] = ",".join(f"{t.offset:.4f}" for t in travel)
            texts["limits"] = ",".join(f"{t.low:.4f}:{t.high:.4f}" for t in travel)
        sensors = [findings.sensors.get(place) for place in self.plan.places]
        known = [address for address in sensors if address is not None]
        if len(known) == len(sensors):
            places = [tuple(map(int, address.split("."))) for address in known]
            texts["sensors"] = format_places(tuple((bus, number) for bus, number in places))
        return texts

    def load(self) -> Findings:
        """Load the stored findings of this hand."""
        return self._store.load(self._key)

    def store(self, findings: Findings) -> None:
        """Write settings, findings and answers under the hand's serial number."""
        self._store.store(self._key, self.settings(findings), self._facts, findings)

    @property
    def _key(self) -> str:
        return record_key(str(self._facts.get("serial", "")), self.side)


def _encode(number: int, drive: Drive) -> MotorCmd:
    return MotorCmd(
        number,
        int(JointMode.FOC),
        True,  # it stops by itself a second after the last command
        0,
        0,
        units.POSITION.encode(drive.q, _REFERENCE),
        units.STIFFNESS.encode(drive.kp, _REFERENCE),
        units.DAMPING.encode(drive.kd, _REFERENCE),
    )


def bench(options: BackendOptions) -> Dex3Bench:
    """The bench of ``dexkit bringup dex3-usb``."""
    return Dex3Bench(options.side, from_options(options))
