"""Questions and answers over a line: timeouts, bounded retries, and no late answer taken for another question's.

After a failed attempt the line is left in peace until it is silent, so that drives drop half a request.
What makes a late answer harmless depends on the protocol:

- Zaber's message ids name the question; an answer with another id is passed over.
- TMCL replies name module and command only. So a module that failed to answer once, or that was never spoken to by
  this link, first has to repeat a token: the link writes a new number into a user variable and reads it back. Modules
  answer in order, so whatever was on its way has arrived before the token has.

Sums of one byte miss some pairs of wrong bits. A refusal therefore counts when a drive has given it twice: every
question may be asked again without harm.

In a hurry (`Line.hurry`), when stops have to reach every drive, a question gets one short attempt and nobody is brought
in step for it. An answer that may be another question's then counts as none; the order was heard all the same.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from firmware_protocols import tmcl, zaber_ascii
from firmware_protocols.errors import RemoteProtocolError
from namod_ctl.core.drives import ByteTransport
from namod_ctl.core.errors import CommunicationError

_READ_SIZE = 4096
_LOOK_S = 0.01  # so often a question that waits for its answer looks whether there is a hurry
_N_SILENCES = 50  # so many silences' time at most is spent on waiting for one; a line that never is silent fails anyway

TOKEN_VARIABLE = 255
"""User variable of TMCL modules that holds the link's token; from 56 on they live in RAM."""
_N_TOKENS = 2**31

Message = TypeVar("Message")
Answer = TypeVar("Answer")
MessageOut = TypeVar("MessageOut", covariant=True)


@dataclass(slots=True)
class LinkStatistics:
    """What a link went through, for the journal."""

    n_exchanges: int = 0
    n_retries: int = 0
    n_garbage_bytes: int = 0
    n_timeouts: int = 0


@dataclass(frozen=True, slots=True)
class LineSettings:
    """How to speak on a line.

    Attributes
    ----------
    timeout_s
        So long an answer may take, from the last byte of the question.
    n_retries
        So often a question is repeated.
    silence_s
        After damage the line has to be silent so long before the next question: longer than drives wait within a frame.
    has_echo
        The adapter hears itself: every question comes back before its answer.
    turnaround_s
        So long the line rests between an answer and the next question; half-duplex drives need it to let go of it.
    """

    timeout_s: float = 0.1
    n_retries: int = 3
    silence_s: float = 0.01
    has_echo: bool = False
    turnaround_s: float = 0.0


class _Parser(Protocol[MessageOut]):
    n_skipped: int

    def receive_data(self, data: bytes) -> None: ...
    def next_message(self) -> MessageOut | None: ...
    def reset(self) -> int: ...


class AttemptError(Exception):
    """One attempt came to nothing; seen by links only."""


class Line(Generic[Message]):
    """One transport, its settings and its statistics; what the links of all protocols share."""

    def __init__(self, transport: ByteTransport, settings: LineSettings, parser: _Parser[Message]) -> None:
        self._transport = transport
        self._parser = parser
        self._settings = settings
        self._is_broken = False
        self._hurried_timeout_s: float | None = None
        self.statistics = LinkStatistics()

    @property
    def name(self) -> str:
        """The transport's name."""
        return self._transport.name

    def close(self) -> None:
        """Let go of the line."""
        self._transport.close()

    def hurry(self, timeout_s: float | None) -> None:
        """Give questions one attempt of so long from now on, the one under way included; None: as set. Thread-safe."""
        self._hurried_timeout_s = timeout_s

    @property
    def is_hurried(self) -> bool:
        """Is there a hurry?"""
        return self._hurried_timeout_s is not None

    def persist(self, who: str, attempt: Callable[[], Answer]) -> Answer:
        """What `attempt` gives, tried a bounded number of times; once in a hurry.

        Raises
        ------
        CommunicationError
            Every attempt failed; names `who`, the line, and what came.
        """
        n_attempts = 0
        problem = ""
        while n_attempts == 0 or (n_attempts <= self._settings.n_retries and not self.is_hurried):
            self._mend(who)
            n_attempts += 1
            try:
                if n_attempts > 1:
                    self.statistics.n_retries += 1
                    self._wait_for_silence()
                answer = attempt()
            except AttemptError as error:
                problem = str(error)
            except CommunicationError as error:
                self._is_broken = True
                problem = str(error)
            else:
                self.statistics.n_exchanges += 1
                return answer
        tries = "one attempt" if n_attempts == 1 else f"{n_attempts} attempts"
        raise CommunicationError(
            f"{who} on {self.name}: no usable answer in {tries}; the last: {problem}. "
            "Check its power, its address and the cable"
        )

    def _mend(self, who: str) -> None:
        """Open the line again where it was lost; once per attempt to speak, for a host that is off takes its time."""
        if not self._is_broken:
            return
        try:
            self._transport.reopen()
        except CommunicationError as error:
            raise CommunicationError(f"{who} on {self.name}: the line is gone: {error}") from error
        self._is_broken = False

    def twice_if_refused(self, exchange: Callable[[], Answer], refusal: Callable[[Answer], object]) -> Answer:
        """An answer without `refusal`, or one whose refusal is the same as the one before it."""
        answer = exchange()
        for _ in range(self._settings.n_retries):
            told = refusal(answer)
            if told is None:
                break
            self.statistics.n_retries += 1
            answer = exchange()
            if refusal(answer) == told:
                break
        return answer

    def ask(self, question: bytes, answer_in: Callable[[Message], Answer | None]) -> Answer:
        """What `answer_in` finds in the first message that is an answer to `question`; others are passed over.

        Raises
        ------
        AttemptError
            None in time, or damage without an answer behind it.
        CommunicationError
            The line is gone.
        """
        self._rest()
        self._parser.reset()
        n_skipped = self._parser.n_skipped
        try:
            return self._ask_once(question, answer_in)
        finally:
            self._parser.reset()
            self.statistics.n_garbage_bytes += self._parser.n_skipped - n_skipped

    def _ask_once(self, question: bytes, answer_in: Callable[[Message], Answer | None]) -> Answer:
        self._transport.write(question)
        echo_left = question if self._settings.has_echo else b""
        heard = b""
        damage = ""
        waited_s = 0.0
        began_s = time.monotonic()
        deadline_s = math.inf
        while (left_s := min(self._patience_s() - waited_s, deadline_s - time.monotonic())) > 0.0:
            look_s = min(left_s, _LOOK_S)
            data = self._transport.read(_READ_SIZE, look_s)
            waited_s = max(waited_s + (0.0 if data else look_s), time.monotonic() - began_s)
            heard += data
            if echo_left and data:
                n_echo = min(len(echo_left), len(data))
                if data[:n_echo] != echo_left[:n_echo]:
                    raise AttemptError(f"another echo than what was sent: {heard[:40].hex(' ')}")
                data, echo_left = data[n_echo:], echo_left[n_echo:]
            self._parser.receive_data(data)
            for message in self._messages():
                if isinstance(message, RemoteProtocolError):
                    damage = str(message)
                    # an answer may follow the damage, but not long after it
                    deadline_s = min(deadline_s, time.monotonic() + self._settings.silence_s)
                elif (answer := answer_in(message)) is not None:
                    return answer
        self.statistics.n_timeouts += not damage
        raise AttemptError(damage or self._silence(heard))

    def _patience_s(self) -> float:
        hurried_timeout_s = self._hurried_timeout_s  # another thread may change it
        return (
            self._settings.timeout_s if hurried_timeout_s is None else min(hurried_timeout_s, self._settings.timeout_s)
        )

    def _messages(self) -> Iterator[Message | RemoteProtocolError]:
        """Whole messages and damage among what has arrived, in order."""
        while True:
            try:
                message = self._parser.next_message()
            except RemoteProtocolError as error:
                yield error
                continue
            if message is None:
                return
            yield message

    def _silence(self, heard: bytes) -> str:
        came = f"only {heard[:40].hex(' ')}" if heard else "nothing"
        return f"{came} within {self._patience_s():g} s"

    def _rest(self) -> None:
        """Throw away what arrived since, and keep the line's turnaround."""
        deadline_s = time.monotonic() + self._settings.turnaround_s
        for _ in range(_N_SILENCES):
            data = self._transport.read(_READ_SIZE, max(deadline_s - time.monotonic(), 0.0))
            self.statistics.n_garbage_bytes += len(data)
            if not data:
                return

    def _wait_for_silence(self) -> None:
        deadline_s = time.monotonic() + _N_SILENCES * self._settings.silence_s
        while data := self._transport.read(_READ_SIZE, self._settings.silence_s):
            self.statistics.n_garbage_bytes += len(data)
            if time.monotonic() > deadline_s or self.is_hurried:
                raise AttemptError(f"the line is never silent, last came {data[:40].hex(' ')}")


class TmclLink(Line[tmcl.Reply]):
    """Requests to TMCL modules and their replies.

    Parameters
    ----------
    host
        Address of the controller, to which modules send their replies; 2 is what Trinamic ships.
    """

    def __init__(self, transport: ByteTransport, settings: LineSettings, host: int = 2) -> None:
        super().__init__(transport, settings, tmcl.ReplyParser(host))
        self._host = host
        self._in_step: set[int] = set()
        # begins where the clock stands, so that a token of an earlier run of the program is not met again
        self._token = time.time_ns() // 1000 % _N_TOKENS

    def exchange(self, request: tmcl.Request) -> tmcl.Reply:
        """The module's reply; a damaged request (WRONG_CHECKSUM) is repeated, any other refusal was given twice.

        Raises
        ------
        CommunicationError
            No usable answer.
        """

        def attempt() -> tmcl.Reply:
            if request.module not in self._in_step and not self.is_hurried:
                self._get_in_step(request.module)
                self._in_step.add(request.module)
            is_in_step = request.module in self._in_step
            # whatever ends the question before its answer (Ctrl-C too) leaves the module out of step
            self._in_step.discard(request.module)
            reply = self._ask(request, None)
            if not is_in_step:
                raise AttemptError("told in a hurry; what came may answer an earlier question")
            self._in_step.add(request.module)
            return reply

        def exchange() -> tmcl.Reply:
            return self.persist(f"TMCL module {request.module}", attempt)

        return self.twice_if_refused(exchange, lambda reply: None if reply.status == tmcl.Status.OK else reply.status)

    def _ask(self, request: tmcl.Request, value: int | None) -> tmcl.Reply:
        def answer_in(reply: tmcl.Reply) -> tmcl.Reply | None:
            if (reply.host, reply.module) != (self._host, request.module):
                return None
            if reply.status == tmcl.Status.WRONG_CHECKSUM:
                raise AttemptError("the module received a damaged request")
            if reply.status not in tmcl.STATUS_WORDS:
                raise AttemptError(f"a reply with {tmcl.status_words(reply.status)}")
            is_answer = reply.command == request.command and value in (None, reply.value)
            return reply if is_answer else None

        return self.ask(request.encode(), answer_in)

    def _get_in_step(self, module: int) -> None:
        self._token = (self._token + 1) % _N_TOKENS
        variable = {"type": TOKEN_VARIABLE, "motor": tmcl.USER_BANK}
        self._ask(tmcl.Request(module, tmcl.Command.SGP, value=self._token, **variable), None)
        self._ask(tmcl.Request(module, tmcl.Command.GGP, **variable), self._token)


class ZaberLink(Line[zaber_ascii.Answer]):
    """Commands to Zaber devices and their replies."""

    def __init__(self, transport: ByteTransport, settings: LineSettings) -> None:
        super().__init__(transport, settings, zaber_ascii.AnswerParser())
        self._message_id = 0
        self._summing: set[int] = set()

    def exchange(self, device: int, axis: int, words: str) -> zaber_ascii.Reply:
        """The device's reply, accepted or rejected twice. Infos, alerts and answers to earlier commands do not count.

        A device that once sent a checksum is believed only with one from then on. Devices answer without one to a
        command whose checksum they did not see, and a single wrong bit makes a digit of the colon in front of it.

        Raises
        ------
        CommunicationError
            No usable answer.
        """

        def attempt() -> zaber_ascii.Reply:
            message_id = self._message_id
            self._message_id = (message_id + 1) % (zaber_ascii.MESSAGE_ID_MAX + 1)

            def answer_in(message: zaber_ascii.Answer) -> zaber_ascii.Reply | None:
                if not isinstance(message, zaber_ascii.Reply):
                    return None
                if (message.device, message.axis, message.message_id) != (device, axis, message_id):
                    return None
                if not message.has_checksum and device in self._summing:
                    # the command has lost its own, too: what the device did may not be what it was told
                    raise AttemptError("a reply without checksum from a device that sends one")
                return message

            question = zaber_ascii.Command(device, axis, words, message_id).encode()
            reply = self.ask(question, answer_in)
            if reply.has_checksum:
                self._summing.add(device)
            return reply

        def exchange() -> zaber_ascii.Reply:
            return self.persist(f"Zaber device {device} axis {axis}", attempt)

        return self.twice_if_refused(exchange, lambda reply: None if reply.is_ok else reply.data)
