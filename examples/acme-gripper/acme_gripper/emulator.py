"""An emulated Acme G2, so that the example runs without one: ``acme-emulator --port 7001``.

The protocol, invented for this example: lines of ASCII on TCP, one answer to each::

    WHO          ACME G2 1.4        model and firmware
    GO 62.5 20   61.9 3.5 0.0 31.2  go to 62.5 % open, pressing with at most 20 N
    STOP         61.9 0.0 0.0 31.2  stop and stay, without pressing
    FREE         61.9 0.0 0.0 31.2  motor off

The answers are opening (%), its speed (%/s), force (N, negative while it presses inwards) and
motor temperature (°C). Emulated: a top speed, an approach that slows down near the goal, an object
that cannot be closed through. Not emulated: inertia, friction, give of the fingers, a motor that
warms up, and the time that a real line takes.
"""

from __future__ import annotations

import argparse
import contextlib
import socketserver
import threading
import time

TOP_SPEED = 140.0  # % of the opening a second
APPROACH = 30.0  # 1/s; the speed near the goal is this times the way to go
SILENCE = 0.5  # s without a line after which it stops by itself
STEP = 0.001  # s


class Gripper:
    """The mechanics and the firmware.

    :param object_at: opening at which the fingers touch an object, %, or None.
    """

    def __init__(self, object_at: float | None = None) -> None:
        self.opening, self.speed, self.force = 20.0, 0.0, 0.0
        self._object = 0.0 if object_at is None else object_at
        self._goal: float | None = None
        self._limit = 0.0
        self._heard = self._lived = time.monotonic()
        self._lock = threading.Lock()

    def answer(self, line: str) -> str:
        """Obey one line."""
        with self._lock:
            now = time.monotonic()
            self._live(now)
            self._heard = now
            word, *numbers = line.split() or [""]
            if word == "WHO":
                return "ACME G2 1.4"
            if word == "GO" and len(numbers) == 2:
                self._goal = min(max(float(numbers[0]), 0.0), 100.0)
                self._limit = float(numbers[1])
            elif word in ("STOP", "FREE"):
                self._goal = None
            else:
                return "WHAT"
            return f"{self.opening:.3f} {self.speed:.2f} {self.force:.2f} 31.2"

    def _live(self, now: float) -> None:
        self._lived = max(self._lived, now - 1.0)
        while self._lived + STEP <= now:
            self._lived += STEP
            if self._lived - self._heard > SILENCE:
                self._goal = None
            self.speed = self.force = 0.0
            if self._goal is None:
                continue
            self.speed = APPROACH * (self._goal - self.opening)
            self.speed = min(max(self.speed, -TOP_SPEED), TOP_SPEED)
            touching = self.opening + self.speed * STEP < self._object
            if touching and self.opening >= self._object:
                self.opening, self.speed, self.force = self._object, 0.0, -self._limit
            self.opening += self.speed * STEP


class _Line(socketserver.StreamRequestHandler):
    disable_nagle_algorithm = True

    def handle(self) -> None:
        assert isinstance(self.server, _Server)
        with contextlib.suppress(ConnectionError):  # the other side hung up
            for line in self.rfile:
                answer = self.server.gripper.answer(line.decode("ascii", "replace"))
                self.wfile.write(f"{answer}\n".encode())


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, address: tuple[str, int], gripper: Gripper) -> None:
        super().__init__(address, _Line)
        self.gripper = gripper


def serve(port: int = 0, *, object_at: float | None = None) -> socketserver.TCPServer:
    """An emulated gripper on 127.0.0.1; call ``serve_forever`` of what comes back.

    :param port: 0 for a free one; ``server_address`` tells which.
    """
    return _Server(("127.0.0.1", port), Gripper(object_at))


def main() -> None:
    """The command ``acme-emulator``."""
    parser = argparse.ArgumentParser(description="An emulated Acme G2 gripper on TCP.")
    parser.add_argument("--port", type=int, default=7001)
    parser.add_argument("--object", type=float, metavar="PCT", help="something between the fingers")
    options = parser.parse_args()
    with serve(options.port, object_at=options.object) as server:
        print(f"ready: 127.0.0.1:{server.server_address[1]}", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    main()
