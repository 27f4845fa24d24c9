"""The Acme G2 as a Dex1-1: what ``dexkit serve acme`` opens."""

from __future__ import annotations

import contextlib
import socket
import time

from dexkit.backends import Backend, BackendOptions
from dexkit.errors import HandLost, HandNotFound, HandRefused, UsageError
from dexkit.hand import HandCommand, HandSpec, HandState, Side
from dexkit.models import DEX1_1

STROKE = 5.4  # rad: a Dex1-1 is closed at 0 and fully open here
RADIANS = STROKE / 100  # a percent of opening
NEWTON_METRES = 0.09 / STROKE  # a newton between the fingers, which open 90 mm in a stroke


class AcmeGripper:
    """An Acme G2 on TCP: it goes to a position, pressing with at most a given force."""

    def __init__(self, side: Side, address: str, force: float = 30.0) -> None:
        self._address = address
        self._force = force
        self._socket: socket.socket | None = None
        self._spec = DEX1_1.spec(side, io_rate=500.0, exchange_timeout=0.1)

    @property
    def spec(self) -> HandSpec:
        """What this hand is."""
        return self._spec

    def open(self) -> None:
        """Connect, and make sure of what it is. Nothing moves."""
        host, _, port = self._address.rpartition(":")
        try:
            self._socket = socket.create_connection((host, int(port)), timeout=1.0)
        except (OSError, ValueError) as error:
            hint = "is it switched on, on this network?"
            raise HandNotFound(f"no gripper at {self._address}: {error}", hint=hint) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(self._spec.exchange_timeout)
        name = self._ask("WHO")
        if not name.startswith("ACME G2 "):
            self.close()
            raise HandRefused(f"{self._address} is not an Acme G2, it says {name!r}")

    def close(self) -> None:
        """Let it stop, and hang up."""
        device, self._socket = self._socket, None
        if device is not None:
            with contextlib.suppress(OSError):
                device.sendall(b"STOP\n")
            device.close()

    def exchange(self, command: HandCommand) -> HandState:
        """Send a command, get a state."""
        if command.is_brake:
            answer = self._ask("STOP")
        elif command.kp[0] == 0:  # zero gains: a client that lets go
            answer = self._ask("FREE")
        else:
            answer = self._ask(f"GO {command.q[0] / RADIANS:.3f} {self._force:.1f}")
        try:
            opening, speed, force, celsius = map(float, answer.split())
        except ValueError as error:
            raise HandLost(f"{self._address} answers {answer!r}") from error
        return HandState.from_values(
            opening * RADIANS,
            dq=speed * RADIANS,
            tau_est=force * NEWTON_METRES,
            temperature=celsius,
            mode=int(command.mode[0]),  # brake or drive, as in the command
            stamp=time.monotonic(),
        )

    def _ask(self, line: str) -> str:
        # Not HandTimeout: an answer that comes late would be taken for the next one's, so only a
        # new connection is safe.
        if self._socket is None:
            raise HandLost("not open")
        try:
            self._socket.sendall(line.encode() + b"\n")
            answer = b""
            while not answer.endswith(b"\n"):
                received = self._socket.recv(256)
                if not received:
                    raise ConnectionError("it hung up")
                answer += received
        except OSError as error:
            raise HandLost(f"{self._address}: {error}") from error
        return answer.decode("ascii", "replace").strip()


def make(options: BackendOptions) -> AcmeGripper:
    """The hand that a user asked for on the command line."""
    force = options.settings.get("force", "30")
    try:
        newtons = float(force)
    except ValueError:
        raise UsageError(f"force={force} is not a number of newtons") from None
    if not 5 <= newtons <= 40:
        raise UsageError(f"force is 5 to 40 N, not {newtons:g}")
    return AcmeGripper(options.side, options.device or "", newtons)


backend = Backend(
    summary="Acme G2 gripper on TCP",
    model="dex1-1",
    make=make,
    needs="--device HOST:PORT",
    needs_device=True,
    settings={"force": "most force on an object, N [30]"},
)
