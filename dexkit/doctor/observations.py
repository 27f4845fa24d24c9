"""Observations as plain data: input of the rules, and output of ``--json``."""

from __future__ import annotations

from dataclasses import dataclass, field

__all__ = [
    "DdsSocket",
    "DomainView",
    "Endpoint",
    "Environment",
    "Interface",
    "Link",
    "Observations",
    "Participant",
    "Policies",
    "SerialPort",
    "Servo",
    "Stream",
    "UsbDevice",
]

from dexkit.doctor.rtps import Policies


@dataclass(frozen=True)
class Participant:
    """A process on a domain.

    :param key: GUID prefix, hex.
    :param vendor: name of the DDS implementation.
    :param version: of CycloneDDS, or empty where it is not announced.
    :param process: name that it announces, or empty.
    :param pid: process id that it announces, or 0.
    :param host: machine that it announces, or empty.
    :param addresses: where it takes messages.
    :param places: address and UDP port of each place where it takes messages.
    :param multicast: it listens to multicast.
    :param interface: the interface on which it was found.
    :param command: its command line, if it runs on this machine and may be read.
    :param started: when it began, seconds since the epoch, if it runs on this machine.
    :param dds_config: its CYCLONEDDS_URI, if it runs on this machine and has one; of XML the names
        of the elements alone.
    """

    key: str
    vendor: str = "CycloneDDS"
    version: str = ""
    process: str = ""
    pid: int = 0
    host: str = ""
    addresses: tuple[str, ...] = ()
    places: tuple[tuple[str, int], ...] = ()
    multicast: bool = False
    interface: str = "lo"
    command: str = ""
    started: float | None = None
    dds_config: str = ""

    @property
    def name(self) -> str:
        """Its name in messages."""
        who = self.command or self.process or self.vendor
        if len(who) > 60:
            who = who[:57] + "..."
        where = f" on {self.host}" if self.host and not self.command else ""
        return f"{who} (pid {self.pid}{where})" if self.pid else f"{who}{where}"


@dataclass(frozen=True)
class Endpoint:
    """A reader or writer.

    :param kind: ``"reader"`` or ``"writer"``.
    :param key: GUID, hex.
    :param participant: key of its participant.
    :param type_hash: of the complete type as it describes it, or empty.
    """

    topic: str
    type_name: str
    kind: str
    key: str
    participant: str
    qos: Policies = field(default_factory=Policies)
    type_hash: str = ""


@dataclass(frozen=True)
class Stream:
    """Statistics of what one writer sent while it was observed.

    :param writer: key of the endpoint.
    :param seconds: how long was looked.
    :param samples: how many samples came.
    :param rate: samples a second that it writes, by its own count.
    :param identical: all samples were the same bytes.
    :param q: positions of the last sample, rad; empty when none could be decoded.
    :param began: the same of the first sample.
    :param q_span: the furthest that any joint moved, rad.
    :param driven_span: of commands: the furthest that the target of any joint moved, rad, over
        the commands that drive it (with a position gain, and a mode that obeys).
    :param limp_span: of commands: the same over the commands without gains, which leave it limp.
    :param asked_span: of commands: the same over those with a position gain, whatever their mode
        byte.
    :param drives: of commands: some command drives some joint.
    :param asks: of commands: some command has a position gain for some joint.
    :param limp: of commands: some command leaves some joint limp.
    :param modes: mode bytes of the last sample; empty where the type has none.
    :param tau: largest abs(tau_est) in the last sample of states.
    :param nonzero: some position of some sample was not exactly 0.
    :param blank: every number in every sample of states was 0.
    :param undecodable: samples that do not decode as their type.
    :param earlier: month of the earlier layout that the last of these has, or empty.
    :param lost: sequence numbers that are missing between the first and the last sample.
    :param two_fingers: of commands: all drive two fingers in metres, as LeRobot's simulation does.
    :param delay_min: least reception time minus time of writing, seconds, each by its own
        machine's clock; NaN when it is not known.
    :param delay_95: the same, that 95 % of the samples are below.
    """

    topic: str
    writer: str
    seconds: float
    samples: int
    rate: float = 0.0
    identical: bool = False
    q: tuple[float, ...] = ()
    began: tuple[float, ...] = ()
    q_span: float = 0.0
    driven_span: float = 0.0
    limp_span: float = 0.0
    asked_span: float = 0.0
    drives: bool = False
    asks: bool = False
    limp: bool = False
    modes: tuple[int, ...] = ()
    tau: float = 0.0
    nonzero: bool = False
    blank: bool = False
    undecodable: int = 0
    earlier: str = ""
    lost: int = 0
    two_fingers: bool = False
    delay_min: float = float("nan")
    delay_95: float = float("nan")


@dataclass(frozen=True)
class DomainView:
    """A domain as it was seen."""

    number: int
    participants: tuple[Participant, ...] = ()
    endpoints: tuple[Endpoint, ...] = ()
    streams: tuple[Stream, ...] = ()

    def participant(self, key: str) -> Participant | None:
        """The participant with a key."""
        return next((p for p in self.participants if p.key == key), None)

    def stream(self, endpoint: Endpoint) -> Stream | None:
        """Statistics of a writer, if it was observed."""
        return next((s for s in self.streams if s.writer == endpoint.key), None)

    def owner(self, endpoint: Endpoint) -> str:
        """Name of the process that an endpoint lives in."""
        participant = self.participant(endpoint.participant)
        return participant.name if participant else "an unknown process"


@dataclass(frozen=True)
class Interface:
    """A network interface.

    :param addresses: its IPv4 addresses.
    :param discovery: some process of this machine listens there to the multicast of discovery.
    """

    name: str
    up: bool
    loopback: bool
    multicast: bool
    addresses: tuple[str, ...] = ()
    discovery: bool = False


@dataclass(frozen=True)
class DdsSocket:
    """A process of this machine listens on ports that belong to a domain.

    :param port: the lowest of them.
    :param pid: 0 when the process belongs to another user.
    :param ports: all of them.
    """

    domain: int
    port: int
    pid: int = 0
    command: str = ""
    ports: tuple[int, ...] = ()


@dataclass(frozen=True)
class Environment:
    """The Python that dexkit runs in.

    :param cyclonedds: version that is installed, or empty.
    :param cyclonedds_error: why it does not import, or empty.
    :param sdk: version of unitree_sdk2py or unitree-sdk2 that is installed, or empty.
    :param sdk_error: why it does not import, or empty.
    :param uri: CYCLONEDDS_URI, or empty.
    :param uri_error: why it cannot be used, or empty.
    """

    python: str = "3.10.0"
    machine: str = "x86_64"
    cyclonedds: str = ""
    cyclonedds_error: str = ""
    sdk: str = ""
    sdk_error: str = ""
    uri: str = ""
    uri_error: str = ""


@dataclass(frozen=True)
class Servo:
    """A servo that answers.

    :param protocol: 1 or 2.
    """

    id: int
    model: int
    baudrate: int
    protocol: int = 2


@dataclass(frozen=True)
class SerialPort:
    """A serial port.

    :param exists: something has that name.
    :param readable: this user may read and write it.
    :param group: group that it belongs to.
    :param latency_timer: ms, or None where there is none.
    :param holders: names of the processes of this machine that have it open.
    :param asked: servos were looked for on it.
    :param servos: what answered.
    :param error: why it could not be opened although it exists, or empty.
    :param named: the user has asked about this one.
    """

    path: str
    exists: bool = True
    readable: bool = True
    group: str = ""
    latency_timer: int | None = None
    holders: tuple[str, ...] = ()
    asked: bool = False
    servos: tuple[Servo, ...] = ()
    error: str = ""
    named: bool = False


@dataclass(frozen=True)
class UsbDevice:
    """A Dex3-1 on this machine's USB, or the one that was asked for.

    :param where: ``bus-port`` as the system names it, or the address that was asked for.
    :param node: device file, or empty.
    :param writable: this user may use it.
    :param drivers: kernel drivers bound to its interfaces.
    :param holders: names of the processes of this machine that have it open.
    :param error: why it could not be reached, or empty.
    """

    where: str
    side: str = ""
    serial: str = ""
    node: str = ""
    writable: bool = True
    drivers: tuple[str, ...] = ()
    holders: tuple[str, ...] = ()
    error: str = ""


@dataclass(frozen=True)
class Link:
    """The link to another machine. Times are in seconds; NaN where they are not known.

    :param method: how round trips were measured.
    :param sent: echoes.
    :param received: answers.
    :param participants: DDS participants that were found there.
    :param multicast: they answer to multicast; None when there is none.
    :param clock_offset: that machine's clock minus this one's.
    :param samples: of its writers that came.
    :param lost: of them that did not, by sequence number.
    :param state_age_95: age on arrival that 95 % of its states are below.
    :param command_age_95: the same of its commands.
    :param rmem_max: bytes of receive buffer that a program may ask for; 0 when it is not known.
    :param dropped: datagrams that found a receive buffer of this machine full meanwhile.
    """

    host: str
    address: str = ""
    interface: str = ""
    method: str = ""
    sent: int = 0
    received: int = 0
    rtt_min: float = float("nan")
    rtt_median: float = float("nan")
    rtt_95: float = float("nan")
    participants: int = 0
    multicast: bool | None = None
    clock_offset: float = float("nan")
    samples: int = 0
    lost: int = 0
    state_age_95: float = float("nan")
    command_age_95: float = float("nan")
    rmem_max: int = 0
    dropped: int = 0

    @property
    def loss(self) -> float:
        """Share of echoes or of samples that is lost, whichever is larger."""
        echoes = 1 - self.received / self.sent if self.sent else 0.0
        total = self.samples + self.lost
        return max(echoes, self.lost / total if total else 0.0)


@dataclass(frozen=True)
class Observations:
    """All that was seen.

    :param examined: interfaces on which it was looked.
    :param seconds: how long the samples were watched.
    :param usb_wanted: the user has asked about a hand on USB.
    :param link: the link to a machine that the user has asked about.
    """

    domains: tuple[DomainView, ...] = ()
    examined: tuple[str, ...] = ("lo",)
    seconds: float = 0.0
    interfaces: tuple[Interface, ...] = ()
    sockets: tuple[DdsSocket, ...] = ()
    environment: Environment | None = None
    serial: tuple[SerialPort, ...] = ()
    usb: tuple[UsbDevice, ...] = ()
    usb_wanted: bool = False
    link: Link | None = None
