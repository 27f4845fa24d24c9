"""The diagnoses of the doctor: texts for the report, the page in the docs and --json.

Ids are stable and never used again for something else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

__all__ = ["DIAGNOSES", "Diagnosis", "Finding", "Severity"]


class Severity(Enum):
    """Severity of a finding."""

    ERROR = "error"
    """A client or a hand cannot work like this."""
    WARNING = "warning"
    """It works, but badly, or is about to fail."""
    NOTE = "note"
    """Information."""

    def __str__(self) -> str:
        return str(self.value)


@dataclass(frozen=True)
class Diagnosis:
    """An entry of the catalogue: a cause of failure, its symptom and its remedy.

    :param title: the cause, in a sentence without a name or number.
    :param symptom: what the user sees of it.
    :param why: why it has that effect.
    :param fix: the remedy, where the finding has no more specific one.
    """

    id: str
    severity: Severity
    title: str
    symptom: str
    why: str
    fix: str


@dataclass(frozen=True)
class Finding:
    """A diagnosis that applies to this machine or domain.

    :param seen: what was seen, with names and numbers.
    :param fix: what to do about it.
    :param where: domain, topic, path or interface, for programs.
    """

    diagnosis: Diagnosis
    seen: str
    fix: str = ""
    severity: Severity = Severity.NOTE
    where: dict[str, str | int] = field(default_factory=dict)

    @property
    def id(self) -> str:
        """Id of the diagnosis."""
        return self.diagnosis.id


_WAITS = "the client hangs at 'Waiting to subscribe dds...'"
_E, _W, _N = Severity.ERROR, Severity.WARNING, Severity.NOTE

# In the order in which they are reported: causes before their effects.
_ALL = (
    Diagnosis(
        "DDS-CYCLONE-11",
        _E,
        "a CycloneDDS 11 participant that crashes its 0.10 peers is on the domain",
        "clients, the hand's service or the robot's own programs die with a segmentation fault",
        "Unitree's stack is CycloneDDS 0.10.x; a participant of 11.x (or a nightly build since "
        "2023, which announces 0.11.0) with Unitree's types, even one that only reads, crashes "
        "0.10.x peers when they ask it for a type",
        "stop that process now and install 'cyclonedds>=0.10.2,<0.11' for it; restart what died",
    ),
    Diagnosis(
        "NET-LO-MULTICAST",
        _E,
        "loopback has no multicast, so two processes of Unitree's SDK do not find each other",
        _WAITS + ", though hand and client run on one machine",
        "Unitree's SDK finds peers by multicast; where 'lo' lacks the MULTICAST flag each process "
        "of it waits for an announcement of the other",
        "sudo ip link set lo multicast on, then restart both; or use dexkit for one of the two: on "
        "loopback it finds its peers by unicast and needs no multicast",
    ),
    Diagnosis(
        "NET-INTERFACE",
        _E,
        "hand and client are on different network interfaces",
        _WAITS + "; discovery tools on either side show only their own half",
        "a participant uses the network interface in its configuration; participants on another "
        "one are not discovered",
        "name the same interface on both sides: the robot's network is 192.168.123.x",
    ),
    Diagnosis(
        "NET-MULTICAST",
        _W,
        "the network interface has no multicast",
        "processes on that network do not find each other",
        "DDS finds peers by multicast",
        "sudo ip link set INTERFACE multicast on, or use an interface that has it",
    ),
    Diagnosis(
        "LINK-NO-ANSWER",
        _E,
        "the other machine does not answer",
        "processes on the two machines do not find each other",
        "no echo comes back: it is off, on another network, or a firewall drops what comes",
        "check its address and cable; let UDP and ICMP through its firewall",
    ),
    Diagnosis(
        "LINK-LOSS",
        _W,
        "the link loses packets",
        "the hand moves in steps; states are missing",
        "clients read states best-effort, and what is lost is not sent again",
        "use a cable; on Wi-Fi a 5 GHz channel near the access point, and less camera data",
    ),
    Diagnosis(
        "LINK-LATENCY",
        _W,
        "the link is slow",
        "the hand lags behind the operator",
        "command and state each take half of a round trip",
        "use a cable, or 5 GHz Wi-Fi without power saving: sudo iw dev INTERFACE set power_save "
        "off; let no VPN or relay be in between",
    ),
    Diagnosis(
        "LINK-JITTER",
        _W,
        "the delay of the link varies",
        "the hand stutters",
        "commands that wait in a queue arrive together",
        "send less over the link (cameras at a lower rate or resolution), or use a cable; on "
        "Wi-Fi: sudo iw dev INTERFACE set power_save off",
    ),
    Diagnosis(
        "LINK-AGE",
        _E,
        "commands are too old when they reach the hand",
        "the hand lags by seconds, or brakes again and again",
        "a command that is more than 0.25 s later than usual is not obeyed by dexkit's services",
        "find what fills the queues of the link: camera streams, a slow VPN, Wi-Fi at its limit",
    ),
    Diagnosis(
        "LINK-MULTICAST",
        _W,
        "multicast does not reach the other machine",
        _WAITS + "; ping works",
        "DDS finds peers by multicast, which many access points, VPNs and containers do not carry",
        "set DEXKIT_PEERS=HOST for dexkit's programs; for others <Peers> in CYCLONEDDS_URI",
    ),
    Diagnosis(
        "LINK-CLOCK",
        _N,
        "the clocks of the two machines differ",
        "times of recordings from both machines do not fit together",
        "each machine stamps what it writes by its own clock; dexkit's services compensate that",
        "synchronise both: chrony or systemd-timesyncd",
    ),
    Diagnosis(
        "LINK-BUFFER",
        _W,
        "receive buffers of this machine are too small",
        "samples are lost when the machine is busy",
        "what comes while a program does not run has to fit into the buffer of its socket",
        "sudo sysctl -w net.core.rmem_max=16777216; put net.core.rmem_max=16777216 into "
        "/etc/sysctl.d/60-dexkit.conf to keep it",
    ),
    Diagnosis(
        "DDS-NOBODY",
        _E,
        "no process publishes the state of a Dex hand",
        _WAITS,
        "a client waits for the first state before it sends anything",
        "start the hand: the vendor's service, or 'dexkit serve BACKEND --side both'",
    ),
    Diagnosis(
        "DDS-UNPUBLISHED",
        _E,
        "a client waits for a state that no process publishes",
        _WAITS + ", for the robot or for hands of another make",
        "xr_teleoperate, LeRobot and the SDK's examples wait for the first state of the robot and "
        "of each hand",
        "start what publishes it, on the same domain and network",
    ),
    Diagnosis(
        "DDS-OTHER-DOMAIN",
        _E,
        "the hand or robot is on another DDS domain than the client",
        _WAITS + ", though the hand runs",
        "DDS domains are separate; xr_teleoperate uses domain 0, and 1 with --sim",
        "put both on one domain: 'dexkit serve ... --domain N', xr_teleoperate with or without "
        "--sim",
    ),
    Diagnosis(
        "DDS-OTHER-STACK",
        _E,
        "the hand uses the topics of another version of Unitree's software",
        _WAITS + ", though the hand runs on the right domain",
        "xr_teleoperate v1.1 and the simulator used rt/unitree_actuator/*, later versions use "
        "rt/dex1/*; topics with different names never match, and no error is "
        "reported",
        "make both use the same: 'dexkit serve ... --dialect NAME', or another version of the "
        "client",
    ),
    Diagnosis(
        "DDS-OTHER-HAND",
        _E,
        "the client is for another model of hand than the one that is there",
        _WAITS + ", or goes on after some seconds and drives nothing",
        "each model has topics of its own, also Inspire's DFX and FTP hands; topics with different "
        "names never match, and no error is reported",
        "select the hand that is there in the client (xr_teleoperate: --ee), or serve the other "
        "one",
    ),
    Diagnosis(
        "DDS-NAME",
        _E,
        "a topic's name differs slightly from that of a hand",
        _WAITS + ", though the hand publishes something",
        "DDS matches names letter by letter; on DDS the topics begin with rt/",
        "use the exact name",
    ),
    Diagnosis(
        "DDS-PREFIX",
        _N,
        "hands are under a prefix of their topics",
        "a client without that prefix waits for ever, though the hand publishes",
        "several robots on one domain are told apart by a name behind rt/",
        "give the client the same prefix, or serve without one; dexkit serve, record, monitor and "
        "check have --prefix",
    ),
    Diagnosis(
        "DDS-OTHER-INTERFACE",
        _N,
        "a program uses an interface that is no hand's of the Dex family",
        "hand and client do not understand each other, though topics look alike or are the same",
        "drivers and simulations bring interfaces of their own beside Unitree's",
        "use the same interface on both sides",
    ),
    Diagnosis(
        "DDS-TYPE",
        _E,
        "two processes use the same topic with different types",
        _WAITS + "; no error is shown on either side",
        "a reader and a writer whose type names differ never match",
        "use the same type on both sides",
    ),
    Diagnosis(
        "DDS-LAYOUT",
        _E,
        "a process uses another layout of a type under the same name",
        _WAITS + ", or values are shifted and wrong",
        "Unitree changed the messages in December 2024 and February 2025 without renaming them",
        "install the newest unitree_sdk2, unitree_sdk2_python or unitree_ros2 (v0.3.0 or later) "
        "there, and build it anew (docs/ros2.md)",
    ),
    Diagnosis(
        "DDS-QOS",
        _E,
        "a reader requests a QoS that the writer does not offer",
        "topic and type are right and still nothing arrives",
        "DDS matches only a writer that offers at least what the reader requests",
        "let the writer be reliable and volatile, and the reader best-effort and volatile, as "
        "Unitree's SDK does",
    ),
    Diagnosis(
        "DDS-ONE-SIDE",
        _E,
        "only one of the two hands publishes",
        _WAITS + ", though one hand runs",
        "xr_teleoperate waits for the first state of both hands",
        "start the other hand too",
    ),
    Diagnosis(
        "DDS-SILENT",
        _E,
        "a state topic has a writer but no samples",
        _WAITS + ", though the topic is listed",
        "a client needs samples, not only a topic",
        "check the log of the hand's service and its device; restart it",
    ),
    Diagnosis(
        "DDS-UNREADABLE",
        _E,
        "the samples of a topic do not decode as their type",
        "the client ignores them or shows wrong values",
        "a sample that does not decode is dropped",
        "install the same version of the messages on both sides",
    ),
    Diagnosis(
        "DDS-ALL-ZERO",
        _E,
        "a hand publishes positions that are all exactly 0",
        _WAITS + ", though the state arrives",
        "clients of the Dex3-1, and xr_teleoperate v1.1 with grippers, take all zero for 'no "
        "state yet'",
        "check that the hand is powered and its motors answer; an emulator must rest a little "
        "off zero",
    ),
    Diagnosis(
        "DDS-SAYS-NOTHING",
        _W,
        "nothing in a hand's state shows that there is a hand",
        "the client starts, the hand does not move",
        "a hand that failed to start may publish valid states of zeros; a hand that measures only "
        "positions looks the same while it rests at 0",
        "check that the hand is powered; move a finger by hand or by a command, and look again",
    ),
    Diagnosis(
        "DDS-TWO-PUBLISHERS",
        _E,
        "two processes publish the same topic",
        "the hand or the displayed hand jumps between two positions",
        "a reader takes the samples of all writers",
        "stop one of them",
    ),
    Diagnosis(
        "DDS-HAND-DEAF",
        _E,
        "a hand publishes its state but does not read commands",
        "the client starts, the hand never moves",
        "no process reads the command topic",
        "restart the hand's service with commands enabled",
    ),
    Diagnosis(
        "DDS-UNHEARD",
        _E,
        "commands are published that no process reads",
        "the client runs, the hand never moves",
        "no hand has a reader of that topic and type",
        "start the hand, on the same domain and topic",
    ),
    Diagnosis(
        "DDS-LATE-JOINER",
        _W,
        "the hand was started after the client of a Dex3-1",
        "the client shows the hand, the hand never moves",
        "xr_teleoperate's Dex3-1 controller forks before it sends; the fork does not discover "
        "hands that start later",
        "restart the client, and always start the hand first",
    ),
    Diagnosis(
        "DDS-TRIPPED",
        _E,
        "the hand's time-out protection has tripped, and the client does not clear it",
        "the client runs, the hand never moves; the client's first run worked",
        "after 1 s without commands a motor with bit 7 in its mode byte brakes, and obeys no "
        "command that still has the bit; a client that always sets it cannot move the hand again "
        "after a pause or a restart (GR00T-WholeBodyControl always does)",
        "send each motor one command with bit 7 = 0 (0x10 | index), or restart the hand's service",
    ),
    Diagnosis(
        "DDS-MODE",
        _E,
        "the mode byte of a client's commands drives no motor",
        "the client runs, the hand never moves",
        "the mode byte decides whether a motor obeys or is locked; whether all hands read it as "
        "documented is disputed (docs/dex3.md)",
        "send the byte that the documents of that hand give",
    ),
    Diagnosis(
        "DDS-NOT-FOLLOWING",
        _E,
        "a hand gets commands and does not move",
        "the client runs, the hand never moves",
        "states and commands flow; what the commands ask for does not happen",
        "check the hand's power and the log of its service",
    ),
    Diagnosis(
        "DDS-FROZEN",
        _E,
        "the state does not follow commands that change",
        "the displayed hand does not move",
        "the state is published, but nothing new is measured; commands without a position gain, "
        "and locked motors, do not count",
        "check whether the hand's service has lost its device; 'dexkit doctor --device PATH' "
        "checks a serial port",
    ),
    Diagnosis(
        "DDS-REVERSED",
        _E,
        "the hand moves away from its commands",
        "the hand opens when it is to close",
        "its scale runs the other way: 1 closes a BrainCo hand and opens an Inspire hand; or one "
        "service is taken for the other",
        "compare topic and hand; a service of one vendor's hand must not be on the other's topics",
    ),
    Diagnosis(
        "DDS-SIDES-SWAPPED",
        _E,
        "each hand's state is where the other one is commanded to",
        "one hand moves with the operator's other hand, or is shown as it",
        "the adapters of two hands are swapped, or states are taken from the other hand's place",
        "exchange the serial adapters, or the ids of the hands; where both hands share a message, "
        "the right one's motors come first in Inspire's",
    ),
    Diagnosis(
        "DDS-NO-GAINS",
        _W,
        "a client changes q in commands without gains",
        "the client runs, the hand stays limp",
        "kp = kd = dq = tau = 0 is the command to be limp; a service counts it as accepted",
        "send gains with q: those of Unitree's client",
    ),
    Diagnosis(
        "DDS-RATE",
        _W,
        "the rate of states is too low",
        "the hand lags and moves slowly",
        "xr_teleoperate limits each command to a step from the last state, so at a low "
        "state rate the hand is slow",
        "stop other programs that use the processor; on a serial line set the adapter's latency "
        "timer to 1 ms",
    ),
    Diagnosis(
        "DDS-NO-CLIENT",
        _N,
        "no process reads the hand's state",
        "-",
        "no client is up, or it is on another domain or interface",
        "start the client",
    ),
    Diagnosis(
        "ENV-CYCLONEDDS-11",
        _E,
        "a CycloneDDS other than 0.10 is installed in dexkit's Python",
        "dexkit refuses to use it; other programs that use it would crash the robot's programs",
        "11.x participants with Unitree's types crash 0.10.x peers",
        "dexkit setup-dds --replace",
    ),
    Diagnosis(
        "ENV-CYCLONEDDS-MISSING",
        _W,
        "CycloneDDS is not installed in dexkit's Python",
        "dexkit serve, record and replay report that DDS is not available",
        "they need CycloneDDS 0.10; the package index has it for CPython up to 3.10 on x86-64 only "
        "(the doctor itself does without)",
        "dexkit setup-dds, which finds or builds it for this Python (docs/install.md)",
    ),
    Diagnosis(
        "ENV-CYCLONEDDS-BROKEN",
        _E,
        "CycloneDDS is installed but does not load",
        "dexkit serve, record and replay report that DDS is not available",
        "its library cannot be loaded",
        "dexkit setup-dds --replace; unset CYCLONEDDS_HOME and LD_LIBRARY_PATH",
    ),
    Diagnosis(
        "ENV-URI",
        _E,
        "CYCLONEDDS_URI is set to a configuration that cannot be used",
        "programs of the C++ SDK and ROS 2 do not start, or are on another interface",
        "CycloneDDS stops at a configuration that it cannot read",
        "unset CYCLONEDDS_URI, or repair it: file:///PATH or the XML itself",
    ),
    Diagnosis(
        "ENV-SDK",
        _N,
        "unitree_sdk2py does not import in dexkit's Python",
        "clients started with this Python stop with an ImportError",
        "the package on PyPI is incomplete",
        "install it from Unitree's repository unitree_sdk2_python; dexkit does not need it",
    ),
    Diagnosis(
        "SERIAL-MISSING",
        _E,
        "there is no such serial port",
        "the hand's service does not start",
        "the adapter is not plugged in, or has another name now",
        "plug it in; use the name under /dev/serial/by-id, which stays the same",
    ),
    Diagnosis(
        "SERIAL-PERMISSION",
        _E,
        "this user may not use the serial port",
        "the hand's service does not start",
        "only members of its group may open a serial port",
        "sudo usermod -a -G dialout $USER, then log in again",
    ),
    Diagnosis(
        "SERIAL-BUSY",
        _E,
        "another program has the serial port open",
        "the hand's service does not start, or both programs get half of the answers",
        "only one program at a time can use a serial line",
        "stop the other program",
    ),
    Diagnosis(
        "SERIAL-NOT-A-PORT",
        _E,
        "the path is not a usable serial port",
        "the hand's service does not start",
        "it does not take a baud rate, or cannot be opened",
        "give the port of the servo's adapter, e.g. /dev/ttyUSB0",
    ),
    Diagnosis(
        "SERIAL-PROTOCOL-1",
        _E,
        "the servo uses Protocol 1.0",
        "dexkit refuses to drive it",
        "its registers differ from those of Protocol 2.0",
        "upgrade it with ROBOTIS DYNAMIXEL Wizard 2 (firmware recovery, model MX-64(2.0))",
    ),
    Diagnosis(
        "SERIAL-OTHER-SERVO",
        _E,
        "the servo that answers is not an MX-64",
        "dexkit refuses to drive it",
        "other models have other registers and limits",
        "give the port of the EZGripper, e.g. its name under /dev/serial/by-id",
    ),
    Diagnosis(
        "SERIAL-NO-ANSWER",
        _E,
        "nothing answers on the serial port",
        "the hand's service finds no servo",
        "no servo answers at any baud rate, with either protocol",
        "check the 12 V supply, the cable and the port",
    ),
    Diagnosis(
        "SERIAL-BAUD",
        _W,
        "the servo is set to another baud rate than the driver's first choice",
        "at a fixed baud rate the hand is not found; below 1 Mbaud states come less often",
        "a new servo is set to 57600",
        "'dexkit serve ezgripper --set baudrate=auto' finds it; DYNAMIXEL Wizard 2 sets it to "
        "1000000",
    ),
    Diagnosis(
        "SERIAL-LATENCY",
        _W,
        "the adapter delays what it receives",
        "the hand lags: some 60 exchanges a second at best",
        "an FTDI adapter waits for its latency timer before it passes on a short answer",
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/NAME/latency_timer",
    ),
    Diagnosis(
        "USB-MISSING",
        _E,
        "no Dex3-1 is on USB",
        "the hand's service does not start",
        "the hand's board is not on the USB bus",
        "check the hand's supply (24 to 58 V) and its cable; 'lsusb' must list it",
    ),
    Diagnosis(
        "USB-PERMISSION",
        _E,
        "this user may not use the hand's USB device",
        "the hand's service does not start: access denied",
        "USB devices belong to root unless a udev rule changes it",
        "add a udev rule",
    ),
    Diagnosis(
        "USB-DRIVER",
        _W,
        "a kernel driver holds the hand's USB interface",
        "the hand's service does not start: resource busy",
        "an interface is used by the kernel or by a program, not by both",
        "unbind the driver",
    ),
    Diagnosis(
        "USB-BUSY",
        _E,
        "another program has the hand's USB device open",
        "the hand's service does not start: resource busy",
        "an interface is used by one program at a time",
        "stop the other program",
    ),
    Diagnosis(
        "USB-UNREACHABLE",
        _E,
        "the USB device cannot be reached",
        "the hand's service does not start",
        "the server of the emulated device, or the device itself, does not answer",
        "check that 'dexkit emulate dex3-usb' runs at that address",
    ),
)

DIAGNOSES: dict[str, Diagnosis] = {d.id: d for d in _ALL}
assert len(DIAGNOSES) == len(_ALL)
