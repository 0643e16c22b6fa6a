"""The command protocol's sending side: one command, repeated until it is answered, and followed to its end.

MAVSDK's own `send_command` is not used: it tells no progress, cannot be given up, and gives up itself after two seconds
without an acknowledgement.
"""

import asyncio
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final

from arm_companion.errors import ArmError
from arm_companion.ground.channel import SILENT_S, ArmSilent, Channel
from arm_companion.ground.texts import Sentences, Text
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

RESEND_S: Final = 0.7
TRIES: Final = 5
"""Sent this often without any answer, a command counts as lost."""

LOST_ANSWER_S: Final = 3.0
"""After resting this long in a state that ends a command, its final answer counts as lost."""

_WORK_AT_REST_S: Final = 10.0
"""The same for a command that asks for no state: CLEAR_ERRORS works at rest, for up to six seconds."""

_LOOK_S: Final = 0.2
_REASON_S: Final = 0.6

Progress = Callable[[int | None], None]
"""Gets per cent, or None when it is not known; called for each report of progress."""

RESULTS: Final = {
    value: entry.name.removeprefix("MAV_RESULT_").lower().replace("_", " ")
    for value, entry in mav.enums["MAV_RESULT"].items()
}

_RESTING: Final = frozenset(
    {"STOWED", "READY", "TIP_HOLD", "PERCHED", "CARRY", "HOLDING", "HANGING", "HANG_HOLD", "FAULT"}
)
"""States that the arm does not leave by itself on the way to what a command asks for."""


class CommandFailed(ArmError):
    """A command did not do what was asked.

    Attributes:
        command: its name, such as PERCH.
        result: `denied`, `temporarily rejected`, `unsupported`, `failed`, `cancelled`, or `unknown` when the final
            answer got lost.
        reason: the arm's own words, empty when it gave none.
    """

    def __init__(self, command: str, result: str, reason: str) -> None:
        self.command = command
        self.result = result
        self.reason = reason
        super().__init__(f"{command} {result}" + (f": {reason}" if reason else ""))


class CommandUnfinished(ArmError):
    """There was no final answer in the time that was given; the arm may be carrying on."""


def name_of(command: int) -> str:
    """Short name of a command for people: PERCH for MAV_CMD_ARM_PERCH."""
    entry = mav.enums["MAV_CMD"].get(command)
    return f"command {command}" if entry is None else entry.name.removeprefix("MAV_CMD_").removeprefix("ARM_")


class Commander:
    """Sends commands to one component.

    Args:
        channel: to it.
        state: the state in words of the newest ARM_STATUS, and its age in s; what it says ends a command whose final
            answer was lost.
    """

    def __init__(self, channel: Channel, state: Callable[[], tuple[str, float]]) -> None:
        self._channel = channel
        self._state = state

    async def run(
        self,
        command: int,
        parameters: Sequence[float] = (),
        *,
        goals: Collection[str] = (),
        progress: Progress | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - its end is told apart from silence
    ) -> None:
        """Send a COMMAND_LONG, repeat it until it is answered, and wait for its end.

        Cancelling the task that waits here stops nothing on the vehicle.

        Args:
            command: MAV_CMD.
            parameters: param1 and on; the rest are 0.
            goals: states in which the command is done, to know its end even if the answer is lost.
            progress: told of each report of progress.
            timeout: s until the final answer; None waits as long as the arm is heard.

        Raises:
            ArmSilent: not heard before or during the command, or no answer at all.
            CommandFailed: refused, failed or cancelled, with the reason.
            CommandUnfinished: under way, but not finished after `timeout`.
        """
        exchange = _Exchange(self._channel, self._state, command, goals, progress)
        end = self._channel.watch(exchange.take)
        try:
            async with asyncio.timeout(timeout):
                await exchange.run([*parameters, *[0.0] * (7 - len(parameters))])
        except TimeoutError:
            raise CommandUnfinished(
                f"{name_of(command)}: no final answer within {timeout:g} s; the arm may be carrying on"
            ) from None
        finally:
            end()


class _Exchange:
    """One command from its first sending to its last answer."""

    def __init__(
        self,
        channel: Channel,
        state: Callable[[], tuple[str, float]],
        command: int,
        goals: Collection[str],
        progress: Progress | None,
    ) -> None:
        self._channel = channel
        self._state = state
        self._command = command
        self._name = name_of(command)
        self._goals = frozenset(goals)
        self._progress = progress
        self._acks: asyncio.Queue[Any] = asyncio.Queue()
        self._texts: list[Text] = []
        self._said = asyncio.Event()
        self._sentences = Sentences()

    def take(self, message: Message) -> None:
        """A message of the component while the command is under way."""
        name = message.get_type()
        if name == "COMMAND_ACK" and message.command == self._command:
            self._acks.put_nowait(message)
        elif name == "STATUSTEXT":
            self._texts += self._sentences.take(message)
            self._said.set()

    async def run(self, parameters: Sequence[float]) -> None:
        ack = await self._first_answer(parameters)
        rested = 0.0
        while ack is None or ack.result == mav.MAV_RESULT_IN_PROGRESS:
            if ack is not None:
                rested = 0.0
                if self._progress is not None:
                    self._progress(None if ack.progress > 100 else ack.progress)
            try:
                async with asyncio.timeout(_LOOK_S):
                    ack = await self._acks.get()
            except TimeoutError:
                ack = None
                if self._channel.silence > SILENT_S:
                    raise ArmSilent(
                        f"the arm has not been heard for {self._channel.silence:.0f} s; {self._name} may be going on"
                    ) from None
                rested = rested + _LOOK_S if self._rests() else 0.0
                if rested > (LOST_ANSWER_S if self._goals else _WORK_AT_REST_S):
                    self._judge_by_state()
                    return
        if ack.result != mav.MAV_RESULT_ACCEPTED:
            raise CommandFailed(self._name, RESULTS.get(ack.result, f"result {ack.result}"), await self._reason())

    async def _first_answer(self, parameters: Sequence[float]) -> Any:
        for attempt in range(TRIES):
            await self._channel.send(mav.MAVLink_command_long_message, self._command, attempt, *parameters)
            try:
                async with asyncio.timeout(RESEND_S):
                    return await self._acks.get()
            except TimeoutError:
                continue
        raise ArmSilent(
            f"component {self._channel.system}/{self._channel.component} does not answer {self._name}: sent {TRIES} "
            f"times, its last heartbeat came {self._channel.silence:.0f} s ago"
        )

    def _rests(self) -> bool:
        state, age = self._state()
        return age < LOST_ANSWER_S and (state in _RESTING or state in self._goals)

    def _judge_by_state(self) -> None:
        state, _ = self._state()
        if state not in self._goals:
            raise CommandFailed(self._name, "unknown", f"the final answer was lost; the arm is in {state}")

    async def _reason(self) -> str:
        """What the arm says of it; the sentence may come a little after the acknowledgement."""
        try:
            async with asyncio.timeout(_REASON_S):
                while not (found := self._found_reason()):
                    self._said.clear()
                    await self._said.wait()
        except TimeoutError:
            return ""
        return found

    def _found_reason(self) -> str:
        start = f"{self._name} "
        for text in reversed(self._texts):
            if text.text.startswith(start) and ": " in text.text:
                return text.text.partition(": ")[2]
        return ""
