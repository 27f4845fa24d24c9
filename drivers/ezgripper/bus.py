"""The serial line to the servo: dynamixel-sdk on pyserial, made bounded and typed.

What is different from the plain SDK, and why (docs/sources/mx64-ezgripper.md#a3,
docs/sources/mx64-ezgripper.md#c3):

- The SDK polls the port without pause while it waits. :class:`DevicePort` blocks in ``select``
  until bytes or the deadline come, so that a waiting gripper costs no processor time (and does
  not hold Python's interpreter lock against the thread that publishes state).
- The SDK's timeout is bytes plus 34 ms on the wall clock, whatever the adapter. Here it is a
  setting, on the monotonic clock.
- The SDK sends packets that need byte stuffing unstuffed, and damages some received ones.
  :class:`PacketHandler` replaces both functions by those of :mod:`dexkit.wire.dynamixel`.
- A short error status reads as data (its CRC bytes) in the SDK. Here the length is checked.
- pyserial reports a vanished device as SerialException, OSError or termios.error; all become
  :class:`~dexkit.errors.HandLost`.
"""

from __future__ import annotations

import os
import select
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import serial
from dynamixel_sdk import (
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    PortHandler,
    Protocol1PacketHandler,
    Protocol2PacketHandler,
)

from dexkit.command_age import Promptly
from dexkit.drivers.serial_port import open_failed, port_errors
from dexkit.errors import (
    HandLost,
    HandRefused,
    HandTimeout,
    UsageError,
)
from dexkit.wire import dynamixel, mx64
from dexkit.wire.dynamixel import Instruction

__all__ = ["BITS_PER_BYTE", "BusStatistics", "DevicePort", "Ping", "ServoBus", "ServoError"]

BITS_PER_BYTE = 10
"""8N1: start bit, eight data bits, stop bit."""

_BUFFERED = 0.1
"""Seconds that a USB adapter may hold bytes that the system has handed over."""
_HEADER = 8
"""Bytes of a frame before the first parameter (of an instruction) or the error (of a status)."""


@dataclass
class BusStatistics:
    """What happened on the line since it was opened.

    :ivar transactions: instructions sent that expect an answer, retries included.
    :ivar timeouts: of these, how many got none.
    :ivar corrupt: of these, how many got a damaged or wrong one.
    :ivar retries: how many were sent again because of that.
    """

    transactions: int = 0
    timeouts: int = 0
    corrupt: int = 0
    retries: int = 0


@dataclass(frozen=True)
class Ping:
    """What a servo says of itself."""

    id: int
    model: int
    firmware: int


class ServoError(HandRefused):
    """The servo answers that it will not do what it was told.

    :param number: error number of the status packet (docs/sources/mx64-ezgripper.md#a4).
    """

    def __init__(self, message: str, number: int, *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.number = number


class DevicePort(PortHandler):  # type: ignore[misc]  # the SDK has no types
    """The SDK's port with a receive that sleeps, and a deadline on the monotonic clock.

    :param path: device path.
    :param baudrate: bits a second.
    :param timeout: seconds to wait for a reply beyond the time of its bytes on the line.
    """

    is_open: bool

    def __init__(self, path: str, baudrate: int, timeout: float) -> None:
        super().__init__(path)
        self.baudrate = baudrate
        self.timeout = timeout
        self._deadline = 0.0
        self._received = bytearray()
        self._held = b""
        self.hold_next = False
        self.before: Promptly | None = None

    # names are the SDK's
    def setupPort(self, cflag_baud: int) -> bool:  # noqa: N802
        """Open at ``cflag_baud``, for this process alone."""
        if self.is_open:
            self.closePort()
        self._received.clear()
        self._held = b""
        self.ser = serial.Serial(self.port_name, cflag_baud, timeout=0, exclusive=True)
        self.is_open = True
        self.tx_time_per_byte = BITS_PER_BYTE * 1000.0 / cflag_baud
        return True

    def closePort(self) -> None:  # noqa: N802
        """Close; a port that has gone away is closed as well."""
        self.is_open = False
        if self.ser is not None:
            try:
                self.ser.close()
            except (OSError, termios.error):
                pass

    def clearPort(self) -> None:  # noqa: N802
        """Forget what has been received: the SDK calls this before each instruction."""
        self._received.clear()
        if not self.hold_next:  # what is held is sent with the next one, which clears
            self.ser.reset_input_buffer()

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """At most ``length`` bytes; fewer only when the deadline has come."""
        received = self._received
        fd = self.ser.fileno()
        while len(received) < length:
            remaining = self._deadline - time.monotonic()
            if remaining <= 0:
                break
            if not select.select([fd], [], [], remaining)[0]:
                break
            try:
                data = os.read(fd, 4096)
            except BlockingIOError:
                continue
            if not data:
                raise serial.SerialException("the device reports data but has none")
            received += data
        taken = bytes(received[: max(length, 0)])
        del received[: len(taken)]
        return taken

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        """Write a whole packet, or as much as goes within the timeout.

        With ``hold_next`` set the packet is kept and leaves together with the next one: one
        system call and, on a USB adapter, one transfer instead of two. ``before`` is asked right
        before they do.

        :raises HandTimeout: ``before`` refuses; nothing was written.
        """
        data = bytes(packet)
        if self.hold_next:
            self.hold_next = False
            self._held = data
            return len(data)
        held = len(self._held)
        data, self._held = self._held + data, b""
        before, self.before = self.before, None
        sent = 0
        if before is not None:
            before.check()
        deadline = time.monotonic() + self.timeout
        while sent < len(data):
            try:
                sent += os.write(self.ser.fileno(), data[sent:])
            except BlockingIOError:
                remaining = deadline - time.monotonic()
                if remaining <= 0 or not select.select([], [self.ser.fileno()], [], remaining)[1]:
                    break
        return sent - held

    def abandon(self) -> None:
        """Forget a transaction that was cut short: the SDK would call the port busy for ever."""
        self.is_using = False
        self.hold_next = False
        self._held = b""
        self.before = None

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Start the clock for a reply of ``packet_length`` bytes."""
        # what was written may still be leaving: allow the longest instruction as well
        line = (packet_length + 64) * self.tx_time_per_byte / 1000.0
        self._deadline = time.monotonic() + line + self.timeout

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        """Start the clock for a wait of ``msec`` milliseconds."""
        self._deadline = time.monotonic() + msec / 1000.0

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Whether the deadline has passed."""
        return time.monotonic() >= self._deadline


class PacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's Protocol 2.0 with correct byte stuffing both ways, and the fast CRC."""

    def updateCRC(self, crc_accum: int, data_blk_ptr: list[int], data_blk_size: int) -> int:  # noqa: N802
        """CRC-16 of the first ``data_blk_size`` bytes."""
        return dynamixel.crc16(bytes(data_blk_ptr[:data_blk_size]))

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Stuff in place, as the SDK's caller expects."""
        body = bytes(packet[_HEADER - 1 : -2])
        stuffed = dynamixel.stuff(body)
        if len(stuffed) != len(body):
            packet[_HEADER - 1 :] = [*stuffed, 0, 0]
            _set_length(packet, len(stuffed) + 2)
        return packet

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Remove the stuffing of a whole received packet."""
        length = packet[5] | packet[6] << 8
        end = _HEADER - 1 + length
        body = bytes(packet[_HEADER - 1 : end - 2])
        plain = dynamixel.unstuff(body)
        packet[_HEADER - 1 :] = [*plain, *packet[end - 2 : end]]
        _set_length(packet, len(plain) + 2)
        return packet


def _set_length(packet: list[int], length: int) -> None:
    packet[5] = length & 0xFF
    packet[6] = length >> 8


class ServoBus:
    """Transactions with servos on one line.

    :param path: device path.
    :param baudrate: bits a second.
    :param timeout: seconds to wait for a reply beyond the time of its bytes.
    :param retries: how often an unanswered or damaged transaction is sent again. All
        transactions here may be repeated: they set absolute values or read.
    """

    def __init__(
        self, path: str, baudrate: int, *, timeout: float = 0.05, retries: int = 2
    ) -> None:
        if timeout <= 0 or retries < 0:
            raise UsageError(f"timeout {timeout} and retries {retries} must not be negative")
        self.path = path
        self.timeout = timeout
        self.retries = retries
        self.statistics = BusStatistics()
        self._packets = PacketHandler()
        self._port = DevicePort(path, baudrate, timeout)

    @property
    def baudrate(self) -> int:
        """Bits a second."""
        return int(self._port.baudrate)

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._port.is_open

    def open(self) -> None:
        """Open the port.

        :raises HandNotFound: no such device, no permission, or not a serial port.
        :raises HandRefused: another program has it.
        :raises HandLost: it cannot be opened for another reason.
        :raises UsageError: the SDK does not know the baud rate.
        """
        self.set_baudrate(self.baudrate)

    def set_baudrate(self, baudrate: int) -> None:
        """Open, or open again, at another baud rate. Raises as :meth:`open`."""
        try:
            known = self._port.setBaudRate(baudrate)
        except (serial.SerialException, OSError, termios.error, ValueError) as error:
            self.close()
            raise open_failed(self.path, error) from error
        if not known:
            raise UsageError(
                f"baud rate {baudrate} is not supported by dynamixel-sdk",
                hint="use " + ", ".join(str(b) for b in mx64.BAUD_RATES.values() if b != baudrate),
            )

    @contextmanager
    def _line(self) -> Iterator[None]:
        """A transaction; whatever cuts it short (Ctrl-C, too), the next one can be made."""
        try:
            with port_errors(self.path):
                yield
        except BaseException:
            self._port.abandon()
            raise

    def drain(self) -> None:
        """Wait until what was written has left the adapter, whatever it buffers.

        :raises HandLost: the port has gone away.
        """
        with port_errors(self.path):
            self._port.ser.flush()
        time.sleep(_BUFFERED)

    def close(self) -> None:
        """Close the port; may be called twice."""
        self._port.closePort()

    def wire_time(self, n_bytes: int) -> float:
        """Seconds that ``n_bytes`` take on the line."""
        return n_bytes * BITS_PER_BYTE / self.baudrate

    def ping(self, servo_id: int, *, retries: int | None = None) -> Ping:
        """Model and firmware of a servo.

        :raises HandTimeout: nobody with that id answers at this baud rate.
        :raises HandLost: the port has gone away.
        """
        _, data = self._transact(servo_id, Instruction.PING, b"", 3, retries=retries)
        return Ping(servo_id, int.from_bytes(data[:2], "little"), data[2])

    def ping_all(self) -> list[Ping]:
        """Every servo that answers a broadcast; takes about a second
        (docs/sources/mx64-ezgripper.md#c3).
        """
        with self._line():
            found, _ = self._packets.broadcastPing(self._port)
        return [Ping(i, model, firmware) for i, (model, firmware) in sorted(found.items())]

    def ping_protocol_1(self, servo_id: int) -> int | None:
        """Model number of a servo that still speaks Protocol 1.0, or None."""
        with self._line():
            model, result, _ = Protocol1PacketHandler().ping(self._port, servo_id)
        return int(model) if result == COMM_SUCCESS else None

    def read(self, servo_id: int, address: int, length: int) -> tuple[bytes, bool]:
        """``length`` bytes from ``address``, and whether the servo signals a hardware error.

        :raises HandTimeout: no (intact) answer.
        :raises HandLost: the port has gone away.
        :raises ServoError: the servo refuses.
        """
        params = address.to_bytes(2, "little") + length.to_bytes(2, "little")
        alert, data = self._transact(servo_id, Instruction.READ, params, length)
        return data, alert

    def read_item(self, servo_id: int, item: mx64.Item) -> int:
        """Value of one item. Raises as :meth:`read`."""
        return item.decode(self.read(servo_id, item.address, item.size)[0])

    def write(self, servo_id: int, address: int, data: bytes) -> bool:
        """Write and wait for the acknowledgement; returns the alert bit. Raises as :meth:`read`."""
        params = address.to_bytes(2, "little") + data
        return self._transact(servo_id, Instruction.WRITE, params, 0)[0]

    def write_item(self, servo_id: int, item: mx64.Item, value: int) -> None:
        """Set one item. Raises as :meth:`read`."""
        self.write(servo_id, item.address, item.encode(value))

    def write_unacknowledged(
        self,
        servo_id: int,
        address: int,
        data: bytes,
        *,
        with_next: bool = False,
        before: Promptly | None = None,
    ) -> None:
        """Write without a status packet (a Sync Write to one servo): half the time, no reply.

        :param with_next: let it leave together with the next transaction.
        :param before: asked right before it leaves. What it raises comes from here, or from the
            next transaction.
        :raises HandLost: the port has gone away or takes no more bytes.
        """
        self._port.hold_next = with_next
        self._port.before = before
        with self._line():
            result = self._packets.syncWriteTxOnly(
                self._port, address, len(data), [servo_id, *data], 1 + len(data)
            )
        if result != COMM_SUCCESS:
            raise HandLost(f"the port {self.path} takes no more bytes")

    def reboot(self, servo_id: int) -> None:
        """Restart the servo; it stays silent until it has booted.

        :raises HandTimeout: it did not acknowledge.
        :raises HandLost: the port has gone away.
        """
        self._transact(servo_id, Instruction.REBOOT, b"", 0, retries=0)

    def _transact(
        self,
        servo_id: int,
        instruction: Instruction,
        params: bytes,
        answer: int,
        *,
        retries: int | None = None,
    ) -> tuple[bool, bytes]:
        attempts = 1 + (self.retries if retries is None else retries)
        statistics = self.statistics
        packet = [0, 0, 0, 0, servo_id, 0, 0, int(instruction), *params, 0, 0]
        _set_length(packet, len(params) + 3)
        problem = ""
        for attempt in range(attempts):
            statistics.transactions += 1
            statistics.retries += attempt > 0
            with self._line():
                # the SDK changes the list that it is given
                reply, result, error = self._packets.txRxPacket(self._port, list(packet))
            if result == COMM_RX_TIMEOUT:
                statistics.timeouts += 1
                problem = "does not answer"
                continue
            if result == COMM_RX_CORRUPT:
                statistics.corrupt += 1
                problem = "answers with damaged packets"
                continue
            if result != COMM_SUCCESS:
                raise HandLost(f"the port {self.path} takes no more bytes ({result})")
            number = error & 0x7F
            if number == dynamixel.ErrorNumber.CRC:
                statistics.corrupt += 1
                problem = "receives damaged packets"
                continue
            data = bytes(reply[_HEADER + 1 : _HEADER + (reply[5] | reply[6] << 8) - 3])
            if number:
                raise ServoError(_refusal(servo_id, instruction, params, number), number)
            if len(data) == answer:
                return bool(error & 0x80), data
            # the late answer to something else, for example
            statistics.corrupt += 1
            problem = "answers with packets of the wrong length"
        raise HandTimeout(
            f"servo {servo_id} on {self.path} {problem} "
            f"({attempts} attempt(s) at {self.baudrate} baud)",
            hint="check power, cable, id and baud rate",
        )


def _refusal(servo_id: int, instruction: Instruction, params: bytes, number: int) -> str:
    try:
        name = dynamixel.ErrorNumber(number).name.replace("_", " ").lower()
    except ValueError:
        name = f"error {number}"
    what = instruction.name.lower()
    if instruction in (Instruction.READ, Instruction.WRITE):
        address = int.from_bytes(params[:2], "little")
        item = mx64.TABLE.get(address)
        what += f" of {item.name}({address})" if item else f" of address {address}"
    return f"servo {servo_id} refuses {what}: {name} (0x{number:02X})"
