"""A stretch of network between a driver and its server that can lose what passes."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from dataclasses import dataclass

_PIECE = 65536


@dataclass(frozen=True)
class Loss:
    """What gets lost once on its way from the server: from `begin` to `end`, or all that follows when `end` is empty.

    With nothing behind it the connection breaks. `n_kept` bytes behind `begin` still pass.
    """

    begin: bytes
    end: bytes = b""
    n_kept: int = 0


class TcpRelay:
    """Passes connections to its `port` on to another one of this computer; `port_to` may change hands meanwhile.

    Attributes
    ----------
    answer_delay_s
        By which every piece from the server comes later.
    """

    def __init__(self, port_to: int) -> None:
        self.answer_delay_s = 0.0
        self._port_to = port_to
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._sockets: list[socket.socket] = []
        self._losses: list[Loss] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def lose(self, loss: Loss) -> None:
        """Lose that, the next time it comes."""
        self._losses.append(loss)

    def break_all(self) -> None:
        """Cut all connections."""
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End it and all its connections."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.break_all()
        for thread in self._threads:
            thread.join(10.0)
        for each in self._sockets:
            each.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                far = socket.create_connection(("127.0.0.1", self._port_to))
            except OSError:
                near.close()
                continue
            for each in (near, far):
                each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets.append(each)
            for source, target, is_answer in ((near, far, False), (far, near, True)):
                self._threads.append(
                    threading.Thread(target=self._pass_on, args=(source, target, is_answer), daemon=True)
                )
                self._threads[-1].start()

    def _pass_on(self, source: socket.socket, target: socket.socket, is_answer: bool) -> None:
        with contextlib.suppress(OSError):
            if is_answer:
                self._pass_answers(source, target)
            while not is_answer and (data := source.recv(_PIECE)):
                target.sendall(data)
        for each in (source, target):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def _pass_answers(self, source: socket.socket, target: socket.socket) -> None:
        """Like others, but with losses; what could be the beginning of one waits for the next piece."""
        held = b""
        while data := source.recv(_PIECE):
            time.sleep(self.answer_delay_s)
            held += data
            loss = self._losses[0] if self._losses else Loss(b"")
            at = held.find(loss.begin) if loss.begin else -1
            if at < 0:
                n_waiting = next(n for n in range(len(loss.begin), -1, -1) if held.endswith(loss.begin[:n]))
                target.sendall(held[: len(held) - n_waiting])
                held = held[len(held) - n_waiting :]
                continue
            self._losses.pop(0)
            n_passed = at if loss.end else at + len(loss.begin) + loss.n_kept
            target.sendall(held[:n_passed])
            if not loss.end:
                return
            held = held[at:]
            while loss.end not in held and (data := source.recv(_PIECE)):
                held += data
            _, _, held = held.partition(loss.end)
            target.sendall(held)
            held = b""
