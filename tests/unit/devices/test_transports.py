"""Transports: the same bytes over memory, a pseudo terminal, TCP and RFC 2217, and what goes wrong on them."""

from __future__ import annotations

import os
import socket
import socketserver
import threading
import time
import tty
from collections.abc import Iterator

import pytest
import serial
from serial import rfc2217

from namod_ctl.core.errors import CommunicationError, ConfigError
from namod_ctl.devices.transports import LoopbackTransport, open_transport


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The near end of a serial line, and the name of its far end."""
    near, far = os.openpty()
    tty.setraw(near)
    tty.setraw(far)
    ends = [near, far]
    try:
        yield near, os.ttyname(far)
    finally:
        for end in ends:
            try:
                os.close(end)
            except OSError:
                continue


class Mirror(socketserver.BaseRequestHandler):
    """Sends back what comes, in capitals."""

    def handle(self) -> None:
        while data := self.request.recv(4096):
            self.request.sendall(data.upper())


@pytest.fixture
def server() -> Iterator[socketserver.ThreadingTCPServer]:
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Mirror) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def url_of(server: socketserver.ThreadingTCPServer) -> str:
    return f"socket://127.0.0.1:{server.server_address[1]}"


def read_all(transport, n_bytes: int) -> bytes:
    data = b""
    while len(data) < n_bytes:
        more = transport.read(n_bytes - len(data), 5.0)
        assert more, f"only {data!r} came"
        data += more
    return data


def test_loopback():
    line = open_transport("loopback://east", 9600, {"east": bytes.upper})
    line.write(b"abc")
    line.write(b"def")
    assert line.read(4, 0.1) == b"ABCD"
    assert line.read(4, 0.1) == b"EF"
    assert line.read(4, 60.0) == b""
    line.write(b"late")
    line.discard_input()
    assert line.read(4, 0.0) == b""
    line.close()
    with pytest.raises(CommunicationError, match="closed"):
        line.write(b"x")
    with pytest.raises(CommunicationError, match="closed"):
        line.read(1, 0.0)
    line.reopen()
    line.write(b"again")
    assert line.read(9, 0.0) == b"AGAIN"


def test_unknown_loopback():
    with pytest.raises(ConfigError, match=r"loopback://west.*known: east"):
        open_transport("loopback://west", 9600, {"east": bytes.upper})


def test_terminal_both_ways(terminal):
    near, port = terminal
    line = open_transport(port, 115200)
    assert line.name == port
    line.write(bytes(range(256)))
    assert os.read(near, 300) == bytes(range(256))
    os.write(near, bytes(range(256)))
    assert read_all(line, 256) == bytes(range(256))
    line.close()


def test_terminal_reads_what_is_there_and_waits_no_longer_than_asked(terminal):
    near, port = terminal
    line = open_transport(port, 115200)
    os.write(near, b"abc")
    assert line.read(100, 30.0) == b"abc"
    start_s = time.monotonic()
    assert line.read(100, 0.05) == b""
    assert 0.04 < time.monotonic() - start_s < 5.0
    os.write(near, b"old news")
    line.discard_input()
    assert line.read(100, 0.0) == b""
    line.close()


def test_unplugged(terminal):
    near, port = terminal
    line = open_transport(port, 115200)
    os.close(near)
    with pytest.raises(CommunicationError, match=r"line is gone.*plug"):
        line.read(10, 5.0)
    with pytest.raises(CommunicationError, match="line is gone"):
        line.write(b"hello")
    line.close()
    line.close()


def test_closed_and_opened_again(terminal):
    near, port = terminal
    line = open_transport(port, 115200)
    line.close()
    with pytest.raises(CommunicationError):
        line.read(1, 0.0)
    with pytest.raises(CommunicationError):
        line.write(b"x")
    line.reopen()
    line.write(b"back")
    assert os.read(near, 10) == b"back"
    line.close()


def test_a_port_in_use(terminal):
    _, port = terminal
    line = open_transport(port, 115200)
    with pytest.raises(ConfigError, match="in use: end the other program"):
        open_transport(port, 115200)
    line.close()
    open_transport(port, 115200).close()


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("/dev/no_such_port", "no such port: plug the adapter in"),
        ("gopher://1.2.3.4:5", "Expected a port such as /dev/ttyUSB0"),
        ("socket://nonsense", "socket://host:port"),
        ("/dev/null", "no serial port"),
    ],
)
def test_bad_urls_name_the_remedy(url, text):
    with pytest.raises(ConfigError, match=text) as refused:
        open_transport(url, 9600)
    assert url in str(refused.value)


def test_bad_baud_rate(terminal):
    with pytest.raises(ConfigError, match="baud"):
        open_transport(terminal[1], -5)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to this user")
def test_no_permission(tmp_path):
    path = tmp_path / "port"
    path.touch(mode=0)
    with pytest.raises(ConfigError, match="add the user to the group"):
        open_transport(str(path), 9600)


def test_tcp(server):
    line = open_transport(url_of(server), 9600)
    line.write(b"abc")
    assert read_all(line, 3) == b"ABC"
    assert line.read(10, 0.01) == b""
    line.reopen()
    line.write(b"x" * 5000)
    assert read_all(line, 5000) == b"X" * 5000
    line.close()


def test_a_host_that_does_not_listen():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(CommunicationError, match="Is the serial server on"):
        open_transport(f"socket://127.0.0.1:{port}", 9600)


def test_a_tcp_line_that_is_cut_and_can_not_be_opened_again():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        line = open_transport(f"socket://127.0.0.1:{listener.getsockname()[1]}", 9600)
        listener.accept()[0].close()
        with pytest.raises(CommunicationError, match="line is gone"):
            line.read(10, 5.0)
    with pytest.raises(CommunicationError, match="can not be opened again"):
        line.reopen()
    line.close()


def test_reads_where_the_system_can_not_wait_on_the_port():
    """pyserial's `loop://` has no file number, like serial ports on Windows and RFC 2217: there pyserial waits."""
    line = open_transport("loop://", 9600)
    line.write(b"abcdef")
    assert read_all(line, 4) == b"abcd"
    assert read_all(line, 2) == b"ef"
    assert line.read(10, 0.01) == b""
    line.write(b"old")
    line.discard_input()
    assert line.read(10, 0.0) == b""
    line.close()


def test_a_peer_in_memory_can_unplug():
    def gone(data: bytes) -> bytes:
        raise CommunicationError(f"unplugged at {data!r}")

    with pytest.raises(CommunicationError, match="unplugged"):
        LoopbackTransport("loopback://x", gone).write(b"x")


class Rfc2217Server(socketserver.BaseRequestHandler):
    """pyserial's server half of RFC 2217, in front of a serial port that hears itself."""

    def handle(self) -> None:
        with serial.serial_for_url("loop://", timeout=0) as port:
            manager = rfc2217.PortManager(port, self)
            while data := self.request.recv(4096):
                port.write(b"".join(manager.filter(data)))
                heard = port.read(port.in_waiting)
                self.write(b"".join(manager.escape(heard)))

    def write(self, data: bytes) -> None:
        """What the manager sends by itself."""
        self.request.sendall(data)


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial 3.5 calls them
def test_rfc2217():
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Rfc2217Server) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            line = open_transport(f"rfc2217://127.0.0.1:{server.server_address[1]}", 19200)
            everything = bytes(range(256))
            line.write(everything)
            assert read_all(line, 256) == everything
            assert line.read(10, 0.01) == b""
            line.close()
        finally:
            server.shutdown()
            thread.join()
