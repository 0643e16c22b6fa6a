"""The command protocol's receiving side: what is asked of us, by whom, and what became of it.

A request lives from the command that starts it to its final answer. A sender that repeats its command meanwhile
(because an answer got lost) is told that it is in progress, and nothing is done twice.
"""

import itertools
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock
from arm_companion.drivers.access import Access, Sender
from arm_companion.drivers.commands import URGENT, Command, Translation, name_of
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.status_text import Speaker
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Answer, Notice, Order, Request, Result, Severity
from arm_companion.protocol.dialect import mav

log = logging.getLogger(__name__)

REPEAT_S: Final = 3.0
"""How long a final answer is kept for a sender that did not get it and asks again."""

_MOST_WAITING: Final = 16
_MOST_RUNNING: Final = 64

_RESULTS: Final = {
    Result.ACCEPTED: mav.MAV_RESULT_ACCEPTED,
    Result.IN_PROGRESS: mav.MAV_RESULT_IN_PROGRESS,
    Result.TEMPORARILY_REJECTED: mav.MAV_RESULT_TEMPORARILY_REJECTED,
    Result.DENIED: mav.MAV_RESULT_DENIED,
    Result.FAILED: mav.MAV_RESULT_FAILED,
    Result.CANCELLED: mav.MAV_RESULT_CANCELLED,
}


_URGENT_COMMANDS: Final = frozenset(getattr(mav, f"MAV_CMD_ARM_{order.name}") for order in URGENT)


@dataclass(slots=True)
class CommandCounters:
    """What came in since the start."""

    commands: int = 0  # addressed to us
    repeated: int = 0  # retries of a command that was taken before
    denied: int = 0
    unsupported: int = 0
    forbidden: int = 0  # by a sender that may not command
    cancelled: int = 0  # by COMMAND_CANCEL
    stray_answers: int = 0  # answers to a request that nobody waits for


Immediate = Callable[[Command, MavlinkLink], int]
"""Carries out a command at once: MAV_RESULT, or `CommandRejected` with the reason."""


@dataclass(frozen=True, slots=True)
class _Key:
    """What makes two commands the same one, sent twice."""

    system: int
    component: int
    command: int
    parameters: tuple[float, ...]


@dataclass(slots=True)
class _Ask:
    """A request under way and who waits for its outcome."""

    key: _Key | None  # None: nobody waits
    links: list[MavlinkLink]  # on which it came; two stations may have the same ids
    progress: int = 255


@dataclass(frozen=True, slots=True)
class _Done:
    """A final answer, kept for retries."""

    answer: Answer
    at: float


class CommandService:
    """Takes commands that are addressed to us and answers them.

    Args:
        access: who may command.
        translation: what is meant by a command.
        speaker: says why a command is refused.
        clock: ages final answers.
    """

    def __init__(self, access: Access, translation: Translation, speaker: Speaker, clock: Clock) -> None:
        self.counters = CommandCounters()
        self._access = access
        self._translation = translation
        self._speaker = speaker
        self._clock = clock
        self._ids = itertools.count(1)
        self._waiting: list[Request] = []
        self._asks: dict[int, _Ask] = {}
        self._done: dict[_Key, _Done] = {}
        self._immediate: dict[int, Immediate] = {}

    def serve(self, command: int, immediate: Immediate) -> None:
        """Carry out a MAV_CMD at once by `immediate`, which says itself who may ask for it."""
        self._immediate[command] = immediate

    def take(self) -> list[Request]:
        """Requests that have come since the last call, in order."""
        waiting, self._waiting = self._waiting, []
        self._forget_old_answers()
        return waiting

    def handle(self, command: Command, link: MavlinkLink) -> None:
        """Take a command that is addressed to us: it becomes a request, or is answered right here."""
        self.counters.commands += 1
        try:
            immediate = self._immediate.get(command.command)
            if immediate is None:
                self._order(command, link)
                return
            result = immediate(command, link)
        except CommandRejected as rejected:
            self._refuse(link, command, rejected.reason)
            return
        self.counters.unsupported += result == mav.MAV_RESULT_UNSUPPORTED
        self.counters.denied += result == mav.MAV_RESULT_DENIED
        self._reply(link, command, result)

    def reject_for_now(self, command: Command, link: MavlinkLink, reason: str) -> int:
        """Say why a command cannot be carried out at the moment; what an `Immediate` then returns."""
        self._explain(link, command.command, "temporarily rejected", reason)
        return int(mav.MAV_RESULT_TEMPORARILY_REJECTED)

    def cancel(self, command: int, sender: Sender, link: MavlinkLink) -> None:
        """COMMAND_CANCEL: give up a command of anybody's that is under way; it is answered with CANCELLED.

        What waits is taken back. What the mission carries out ends by an ABORT. A cancel that is repeated because
        the answer got lost gets the answer again, and one that comes too late is ignored.
        """
        try:
            self._access.require(sender, urgent=True)
        except CommandRejected as rejected:
            self.counters.forbidden += 1
            self._explain(link, command, "goes on: cancel denied", rejected.reason)
            return
        running = {i: ask.key for i, ask in self._asks.items() if ask.key is not None and ask.key.command == command}
        if not running:
            for key, done in self._done.items():
                if key.command == command and done.answer.result is Result.CANCELLED:
                    self._acknowledge(link, key, mav.MAV_RESULT_CANCELLED)
            return
        self.counters.cancelled += 1
        taken_back = {request.id for request in self._waiting} & running.keys()
        self._waiting = [request for request in self._waiting if request.id not in taken_back]
        for request in taken_back:
            self.answer(Answer(request, Result.CANCELLED, "asked to"))
        if running.keys() - taken_back:
            self._submit(Order.ABORT, (), _Ask(None, [link]))

    def answer(self, answer: Answer) -> None:
        """Tell whoever asked. Progress may be told often; the first other result ends the request."""
        ask = self._asks.get(answer.request)
        if ask is None:
            self.counters.stray_answers += 1
            return
        if answer.result is Result.IN_PROGRESS:
            ask.progress = answer.progress
        else:
            del self._asks[answer.request]
            if ask.key is not None:
                self._done[ask.key] = _Done(answer, self._clock.now())
            if answer.result is not Result.ACCEPTED:
                self.counters.denied += answer.result is Result.DENIED
                command = mav.MAV_CMD_ARM_ABORT if ask.key is None else ask.key.command
                for link in ask.links:
                    self._explain(link, command, answer.result.value.replace("_", " "), answer.reason)
        if ask.key is not None:
            for link in ask.links:
                self._acknowledge(link, ask.key, _RESULTS[answer.result], answer.progress)

    def _order(self, command: Command, link: MavlinkLink) -> None:
        """Make a request of a command.

        Raises:
            CommandRejected: it is wrong, or its sender may not give it.
        """
        translated = None
        if self._translation.knows(command.command):
            self._require(command, urgent=command.command in _URGENT_COMMANDS)
            translated = self._translation.order(command)
        if translated is None:
            self.counters.unsupported += 1
            self._reply(link, command, mav.MAV_RESULT_UNSUPPORTED)
            return
        order, parameters = translated
        key = _Key(command.system, command.component, command.command, parameters)
        if self._repeat(key, command.confirmation, link):
            return
        if len(self._waiting) >= _MOST_WAITING and order not in URGENT:
            self._explain(link, command.command, "rejected", "too many commands at once")
            self._reply(link, command, mav.MAV_RESULT_TEMPORARILY_REJECTED)
            return
        self._submit(order, parameters, _Ask(key, [link]))

    def _require(self, command: Command, *, urgent: bool) -> None:
        try:
            self._access.require(command.sender, urgent=urgent)
        except CommandRejected:
            self.counters.forbidden += 1
            raise

    def _submit(self, order: Order, parameters: tuple[float, ...], ask: _Ask) -> None:
        if len(self._asks) >= _MOST_RUNNING:
            forgotten = next(iter(self._asks))
            log.warning("request %d was never answered", forgotten)
            del self._asks[forgotten]
        request = Request(next(self._ids), order, parameters)
        self._asks[request.id] = ask
        self._waiting.append(request)

    def _repeat(self, key: _Key, confirmation: int, link: MavlinkLink) -> bool:
        """Answer a retry without doing anything again; False for a new command."""
        for ask in self._asks.values():
            if ask.key == key:
                if link not in ask.links:
                    ask.links.append(link)
                self.counters.repeated += 1
                self._acknowledge(link, key, mav.MAV_RESULT_IN_PROGRESS, ask.progress)
                return True
        done = self._done.get(key)
        if confirmation and done is not None and self._clock.now() - done.at <= REPEAT_S:
            self.counters.repeated += 1
            self._acknowledge(link, key, _RESULTS[done.answer.result], done.answer.progress)
            return True
        return False

    def _forget_old_answers(self) -> None:
        oldest = self._clock.now() - REPEAT_S
        self._done = {key: done for key, done in self._done.items() if done.at > oldest}

    def _reply(self, link: MavlinkLink, command: Command, result: int) -> None:
        self._acknowledge(link, _Key(command.system, command.component, command.command, ()), result)

    def _acknowledge(self, link: MavlinkLink, key: _Key, result: int, progress: int = 255) -> None:
        shown = progress if result == mav.MAV_RESULT_IN_PROGRESS else 0
        link.send(mav.MAVLink_command_ack_message(key.command, result, shown, 0, key.system, key.component))

    def _refuse(self, link: MavlinkLink, command: Command, reason: str) -> None:
        self.counters.denied += 1
        self._explain(link, command.command, "denied", reason)
        self._reply(link, command, mav.MAV_RESULT_DENIED)

    def _explain(self, link: MavlinkLink, command: int, fate: str, reason: str) -> None:
        text = f"{name_of(command)} {fate}: {reason or 'no reason given'}"
        log.info("link %s: %s", link.name, text)
        self._speaker.say(Notice(Severity.WARNING, text), link)
