"""The command protocol's receiving side: what is asked of us, by whom, and what became of it.

A request lives from the command that starts it to its final answer. A sender that repeats its command meanwhile
(because an answer got lost) is told that it is in progress, and nothing is done twice.
"""

import itertools
import logging
from dataclasses import dataclass
from typing import Final

from arm_companion.clock import Clock
from arm_companion.config.schema import VehicleConfig
from arm_companion.drivers.commands import (
    URGENT,
    Command,
    is_ours,
    name_of,
    order_of,
    read_parameters,
)
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.status_text import Speaker
from arm_companion.errors import CommandRejected
from arm_companion.mission.facts import Answer, Notice, Request, Result, Severity
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


@dataclass(slots=True)
class CommandCounters:
    """What came in since the start."""

    commands: int = 0  # addressed to us
    repeated: int = 0  # retries of a command that was taken before
    denied: int = 0
    unsupported: int = 0
    forbidden: int = 0  # by a sender that may not command
    stray_answers: int = 0  # answers to a request that nobody waits for


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

    key: _Key
    link: MavlinkLink  # on which it came last
    progress: int = 255


@dataclass(frozen=True, slots=True)
class _Done:
    """A final answer, kept for retries."""

    answer: Answer
    at: float


class CommandService:
    """Takes commands that are addressed to us and answers them.

    Args:
        vehicle: who may command.
        speaker: says why a command is refused.
        clock: ages final answers.
    """

    def __init__(self, vehicle: VehicleConfig, speaker: Speaker, clock: Clock) -> None:
        self.counters = CommandCounters()
        self._commanders = frozenset(vehicle.commanders)
        self._speaker = speaker
        self._clock = clock
        self._ids = itertools.count(1)
        self._waiting: list[Request] = []
        self._asks: dict[int, _Ask] = {}
        self._done: dict[_Key, _Done] = {}

    def may_command(self, system: int) -> bool:
        """Whether a system's wishes count at all."""
        return not self._commanders or system in self._commanders

    def take(self) -> list[Request]:
        """Requests that have come since the last call, in order."""
        waiting, self._waiting = self._waiting, []
        self._forget_old_answers()
        return waiting

    def handle(self, command: Command, link: MavlinkLink) -> None:
        """Take a command that is addressed to us: it becomes a request, or is answered right here."""
        self.counters.commands += 1
        if is_ours(command.command):
            self._order(command, link)
        elif command.command == mav.MAV_CMD_REQUEST_MESSAGE:
            self._reply(link, command, self._request_message(command, link))
        elif command.command == mav.MAV_CMD_SET_MESSAGE_INTERVAL:
            self._reply(link, command, self._set_interval(command, link))
        else:
            self.counters.unsupported += 1
            self._reply(link, command, mav.MAV_RESULT_UNSUPPORTED)

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
            self._done[ask.key] = _Done(answer, self._clock.now())
            if answer.result is not Result.ACCEPTED:
                self.counters.denied += answer.result is Result.DENIED
                self._explain(ask.link, ask.key.command, answer.result.value.replace("_", " "), answer.reason)
        self._acknowledge(ask.link, ask.key, _RESULTS[answer.result], answer.progress)

    def _order(self, command: Command, link: MavlinkLink) -> None:
        order = order_of(command.command)
        if not self.may_command(command.system):
            self.counters.forbidden += 1
            self._refuse(link, command, f"system {command.system} may not command the arm")
            return
        if order is None:
            self.counters.unsupported += 1
            self._reply(link, command, mav.MAV_RESULT_UNSUPPORTED)
            return
        try:
            parameters = read_parameters(order, command)
        except CommandRejected as rejected:
            self._refuse(link, command, rejected.reason)
            return
        key = _Key(command.system, command.component, command.command, parameters)
        if self._repeat(key, command.confirmation, link):
            return
        if len(self._waiting) >= _MOST_WAITING and order not in URGENT:
            self._explain(link, command.command, "rejected", "too many commands at once")
            self._reply(link, command, mav.MAV_RESULT_TEMPORARILY_REJECTED)
            return
        if len(self._asks) >= _MOST_RUNNING:
            forgotten = next(iter(self._asks))
            log.warning("request %d was never answered", forgotten)
            del self._asks[forgotten]
        request = Request(next(self._ids), order, parameters)
        self._asks[request.id] = _Ask(key, link)
        self._waiting.append(request)

    def _repeat(self, key: _Key, confirmation: int, link: MavlinkLink) -> bool:
        """Answer a retry without doing anything again; False for a new command."""
        for ask in self._asks.values():
            if ask.key == key:
                ask.link = link
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

    def _request_message(self, command: Command, link: MavlinkLink) -> int:
        id_, about = command.parameters[:2]
        if id_ == mav.MAVLINK_MSG_ID_MESSAGE_INTERVAL and 0 <= about <= 0xFFFF:
            link.send(mav.MAVLink_message_interval_message(int(about), link.streams.interval_us(about)))
        elif not link.streams.ask(id_):
            self.counters.unsupported += 1
            return int(mav.MAV_RESULT_UNSUPPORTED)
        return int(mav.MAV_RESULT_ACCEPTED)

    def _set_interval(self, command: Command, link: MavlinkLink) -> int:
        id_, interval_us = command.parameters[:2]
        if link.streams.set_interval(id_, interval_us):
            return int(mav.MAV_RESULT_ACCEPTED)
        self.counters.denied += 1
        return int(mav.MAV_RESULT_DENIED)

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
