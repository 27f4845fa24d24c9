"""What a web page of another origin can do to whatever listens here: nothing.

A browser connects to loopback for any page. What speaks HTTP has to look at Host and Origin; what
does not must take nothing out of a request that a page can send, whose body is the page's own.
"""

from __future__ import annotations

import importlib.util
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from dexkit import interface_filter
from dexkit.emulators.dex3_mcu import Dex3Hands
from dexkit.emulators.rh56 import Rh56TcpHand
from dexkit.errors import UsageError
from dexkit.tcp_listener import listen
from dexkit.view.guarded_server import GuardedPort
from dexkit.view.web_origins import Allowed, Refused, read_request
from tests.each import each
from tests.patience import PATIENCE
from tests.watch_helpers import closing_hands

EVIL = "http://evil.example"


def request(host: str, *origins: str, upgrade: bool = True, first: str = "GET / HTTP/1.1") -> bytes:
    lines = [first, f"Host: {host}", *(f"Origin: {o}" for o in origins)]
    if upgrade:
        lines += [
            *("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"),
            *("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol: viser-v1"),
        ]
    return "\r\n".join([*lines, "", ""]).encode()


def decision(allowed: Allowed, head: bytes) -> bool:
    try:
        allowed.check(read_request(head))
    except Refused:
        return False
    return True


# -- Host and Origin -------------------------------------------------------------------------------


@each(
    ("bound", "host", "origin", "expected"),
    [
        ("127.0.0.1", "127.0.0.1:8720", None, True),  # no browser, or a page that is opened
        ("127.0.0.1", "127.0.0.1:8720", "http://127.0.0.1:8720", True),
        ("127.0.0.1", "LocalHost:8720", "http://localhost:8720", True),
        ("127.0.0.1", "[::1]:8720", "http://[::1]:8720", True),
        ("127.0.0.1", "localhost:9000", "http://localhost:9000", True),  # forwarded by ssh
        ("127.0.0.1", "127.0.0.1:8720", EVIL, False),
        ("127.0.0.1", "127.0.0.1:8720", "null", False),
        ("127.0.0.1", "127.0.0.1:8720", "", False),
        ("127.0.0.1", "127.0.0.1:8720", "http://127.0.0.1:9999", False),  # another program's page
        ("127.0.0.1", "127.0.0.1:8720", "https://127.0.0.1:8720", False),
        ("127.0.0.1", "127.0.0.1:8720", "http://127.0.0.1:8720.evil.example", False),
        ("127.0.0.1", "evil.example", EVIL, False),  # DNS rebinding
        ("127.0.0.1", "evil.example:8720", None, False),
        ("127.0.0.1", "localhost.evil.example", None, False),
        ("127.0.0.1", "127.0.0.1@evil.example", None, False),
        ("127.0.0.1", "0.0.0.0:8720", None, False),
        ("127.0.0.1", "192.168.1.20:8720", None, False),
        ("127.0.0.1", "", None, False),
        ("192.168.1.20", "192.168.1.20:8720", "http://192.168.1.20:8720", True),
        ("192.168.1.20", "192.168.1.21:8720", None, False),
        ("robot.local", "robot.local:8720", "http://robot.local:8720", True),
        ("0.0.0.0", "192.168.1.20:8720", "http://192.168.1.20:8720", True),
        ("0.0.0.0", "192.168.1.20:8720", EVIL, False),
        ("0.0.0.0", "robot.local:8720", None, False),  # only where the user names it
        ("::", "[fe80::1]:8720", None, True),
    ],
)
def test_host_and_origin_decide(bound: str, host: str, origin: str | None, expected: bool) -> None:
    origins = () if origin is None else (origin,)
    for upgrade in (True, False):
        assert decision(Allowed(bound), request(host, *origins, upgrade=upgrade)) is expected


def test_other_origins_are_allowed_by_name() -> None:
    allowed = Allowed("127.0.0.1", ["https://View.Example:8443", "file://", "http://robot.local"])
    assert decision(allowed, request("127.0.0.1:1", "https://view.example:8443"))
    assert decision(allowed, request("127.0.0.1:1", "file://"))
    assert decision(allowed, request("robot.local:8720", "http://robot.local:8720"))
    assert decision(allowed, request("view.example", "https://view.example:8443"))  # a proxy there
    assert not decision(allowed, request("127.0.0.1:1", "https://view.example"))
    assert not decision(allowed, request("127.0.0.1:1", "http://view.example:8443"))


@each(
    "head",
    [
        request("127.0.0.1", first="POST / HTTP/1.1"),
        request("127.0.0.1", first="OPTIONS / HTTP/1.1"),
        request("127.0.0.1", first="GET http://evil.example/ HTTP/1.1"),
        request("127.0.0.1", first="GET / HTTP/2.0"),
        request("127.0.0.1", first="GET /"),
        request("127.0.0.1", "http://127.0.0.1", EVIL),
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n",
        # what another reader may read in another way
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nx\r\nOrigin: http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin : http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n Origin: http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\nOrigin: http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\rOrigin: http://evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nA: \0\r\n\r\n",
        b"\r\n\r\n",
    ],
)
def test_other_requests_are_refused(head: bytes) -> None:
    assert not decision(Allowed("127.0.0.1"), head)


# -- the port in front of a server ---------------------------------------------------------------


@contextmanager
def behind(port: GuardedPort) -> Iterator[list[bytes]]:
    """A server behind it that answers each head, and echoes; the heads that it has received."""
    heads: list[bytes] = []

    def serve(client: socket.socket) -> None:
        with client, client.makefile("rb") as lines:
            head = b"".join(iter(lines.readline, b"\r\n"))
            heads.append(head)
            client.sendall(b"HTTP/1.1 200 OK\r\n\r\n")
            if b"Upgrade" not in head:
                return
            while data := lines.read1(100):
                client.sendall(data)

    def accept() -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(client,), daemon=True).start()

    listener = listen(port.hidden.host, port.hidden.port)
    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    try:
        yield heads
    finally:
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        thread.join(PATIENCE)


@pytest.fixture
def guarded() -> Iterator[tuple[GuardedPort, list[bytes]]]:
    allowed = Allowed("127.0.0.1")
    with GuardedPort("127.0.0.1", range(1), allowed) as port, behind(port) as heads:
        port.open()
        yield port, heads


def ask(port: int, data: bytes, *, count: int = 1 << 20) -> bytes:
    """What is answered, to the end or up to so many bytes."""
    found = b""
    with socket.create_connection(("127.0.0.1", port), PATIENCE) as sock:
        sock.sendall(data)
        try:
            while len(found) < count and (piece := sock.recv(count)):
                found += piece
        except ConnectionResetError:
            pass
    return found


def status(port: int, data: bytes) -> int:
    return int(ask(port, data, count=12)[9:12])


def test_refused_requests_do_not_reach_the_server_behind(
    guarded: tuple[GuardedPort, list[bytes]], caplog: pytest.LogCaptureFixture
) -> None:
    port, heads = guarded
    own = f"127.0.0.1:{port.port}"
    for _ in range(2):
        for host, origin in ((own, EVIL), ("evil.example", EVIL), (own, "null")):
            for upgrade in (True, False):
                assert status(port.port, request(host, origin, upgrade=upgrade)) == 403
    assert heads == []
    assert b"--allow-origin http://evil.example" in ask(port.port, request(own, EVIL))
    assert caplog.text.count("web pages of http://evil.example may not read this") == 1


def test_other_requests_are_passed_on_as_they_are(
    guarded: tuple[GuardedPort, list[bytes]],
) -> None:
    port, heads = guarded
    own = f"127.0.0.1:{port.port}"
    with socket.create_connection(("127.0.0.1", port.port), PATIENCE) as sock:
        head = request(own, f"http://{own}")
        sock.sendall(head[:30])
        sock.sendall(head[30:] + b"first")
        with sock.makefile("rb") as lines:
            assert lines.read(19 + 5) == b"HTTP/1.1 200 OK\r\n\r\nfirst"
            data = bytes(range(256)) * 1000
            sock.sendall(data)
            assert lines.read(len(data)) == data
    assert heads == [head[:-2]]
    # a second request on the connection of a plain one would be one without a check
    plain = request(own, upgrade=False)
    answer = ask(port.port, plain + request("evil.example", EVIL))
    assert answer == b"HTTP/1.1 200 OK\r\n\r\n"
    assert heads[1:] == [plain[:-2]]


def test_server_behind_takes_connections_of_the_guard_only(
    guarded: tuple[GuardedPort, list[bytes]],
) -> None:
    hidden = guarded[0].hidden
    for own in ("", "127.0.0.1", hidden.host):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
            sock.settimeout(0.2)
            sock.bind((own, 0))
            with pytest.raises(socket.timeout):
                sock.connect((hidden.host, hidden.port))
    with socket.create_connection(
        (hidden.host, hidden.port), PATIENCE, source_address=(hidden.sender, 0)
    ):
        pass


def test_without_a_filter_the_view_does_not_start(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(92, "Protocol not available")

    monkeypatch.setattr(interface_filter, "accept_only", refuse)
    monkeypatch.delenv(interface_filter.ALL_INTERFACES, raising=False)
    allowed = Allowed("127.0.0.1")
    with GuardedPort("127.0.0.1", range(1), allowed) as port, behind(port):
        with pytest.raises(UsageError, match="cannot be kept from the view: Protocol not"):
            port.open()
        monkeypatch.setenv(interface_filter.ALL_INTERFACES, "1")
        port.open()
        assert status(port.port, request(f"127.0.0.1:{port.port}", EVIL)) == 403
    assert "cannot be kept from the view" in caplog.text


# -- dexkit's page -------------------------------------------------------------------------------


@pytest.fixture
def page_port() -> Iterator[int]:
    if importlib.util.find_spec("viser") is None:
        pytest.skip("needs viser")
    from dexkit.view.browser_page import Page
    from dexkit.view.sources import Recorded

    with Page([Recorded("one", closing_hands(0.2))], port=0, origins=["https://a.example"]) as page:
        yield page.port


def test_page_is_read_by_itself_and_by_allowed_pages_only(page_port: int) -> None:
    own = f"127.0.0.1:{page_port}"
    for origin, expected in ((f"http://{own}", 101), ("https://a.example", 101), (EVIL, 403)):
        assert status(page_port, request(own, origin)) == expected
    assert status(page_port, request("evil.example", EVIL)) == 403
    assert status(page_port, request(own, upgrade=False)) == 200
    assert status(page_port, request("evil.example", upgrade=False)) == 403
    assert b"access-control" not in ask(page_port, request(own, upgrade=False))[:500].lower()


# -- ports of other protocols --------------------------------------------------------------------


def post(body: bytes) -> bytes:
    """What a page makes a browser send without asking."""
    lines = (
        *("POST / HTTP/1.1", "Host: 127.0.0.1", f"Origin: {EVIL}", "Content-Type: text/plain"),
        *(f"Content-Length: {len(body)}", "", ""),
    )
    return "\r\n".join(lines).encode() + body


def test_page_cannot_command_a_hand_on_modbus() -> None:
    # transaction, protocol, bytes that follow, unit; write registers, from where, count, bytes
    write = struct.pack(">HHHBBHHB6H", 1, 0, 19, 255, 16, 1486, 6, 12, *[500] * 6)
    with Rh56TcpHand() as hand:
        port = int(hand.path.rsplit(":", 1)[1])
        assert ask(port, write, count=12)[7:] == write[7:12]  # obeyed
        assert ask(port, post(write)) == b""


def test_page_cannot_command_a_hand_on_usbip() -> None:
    with Dex3Hands() as hands:
        listing = bytes.fromhex("01118005 00000000")  # OP_REQ_DEVLIST
        assert ask(hands.port, listing, count=8)[:4] == b"\x01\x11\x00\x05"
        assert ask(hands.port, post(listing)) == b""
