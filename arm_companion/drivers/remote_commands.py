"""Commands over MQTT and from the field page: nonce and age first, then exactly the way of a command over MAVLink."""

import logging
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Final, cast

from arm_companion.clock import Clock
from arm_companion.drivers.access import Sender
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.commands import Command, is_ours
from arm_companion.drivers.mavlink_link import MavlinkLink
from arm_companion.drivers.mqtt_payloads import progress
from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message
from arm_companion.protocol.mqtt import Order, Packet, packet, read_order

log = logging.getLogger(__name__)

_COMPONENT: Final = mav.MAV_COMP_ID_MISSIONPLANNER
_PREFIX: Final = "MAV_CMD_ARM_"
_NUMBERS: Final = {
    entry.name.removeprefix(_PREFIX): number
    for number, entry in mav.enums["MAV_CMD"].items()
    if entry.name.startswith(_PREFIX) and is_ours(number)
}
_URGENT: Final = frozenset({"STOW", "ABORT"})
_RESULTS: Final = {
    number: entry.name.removeprefix("MAV_RESULT_").lower() for number, entry in mav.enums["MAV_RESULT"].items()
}
_MOST_NONCES: Final = 1024
_MOST_WAITING: Final = 8
"""Only STOW and ABORT may come again while they are under way; of more than so many the first get no answer."""


class RemoteCommands:
    """Takes commands from a side process.

    A nonce is good once: the same message again (QoS 1 repeats) gets the newest answer again and does nothing.
    Nonces are kept for as long as age alone would not refuse the command.

    Args:
        name: of the way that they come, for the log.
        system: MAVLink system id that they count as.
        service: the command service that MAVLink's commands go to.
        clock: Unix time.
        answer: takes the answers.
        age_s: how old a command may be.
    """

    def __init__(
        self,
        name: str,
        system: int,
        service: CommandService,
        clock: Clock,
        answer: Callable[[Packet], None],
        *,
        age_s: float,
    ) -> None:
        self.name = name
        self._system = system
        self._age_s = age_s
        self._service = service
        self._clock = clock
        self._answer = answer
        self._started = self._now()
        self._seen: OrderedDict[str, Order] = OrderedDict()
        self._answers: dict[str, Packet] = {}
        self._under_way: dict[int, deque[str]] = {}  # by MAV_CMD: nonces of the orders that wait for its outcome
        self._reason = ""

    def take(self, payload: bytes) -> None:
        """One command as it came, unread."""
        try:
            order = read_order(payload)
        except ProtocolError as error:
            log.warning("%s: a command is not understood: %s", self.name, error)
            self._tell("", "", "denied", reason=f"not understood: {error}")
            return
        self.give(order)

    def give(self, order: Order) -> None:
        """One well-formed command."""
        if self._repeated(order):
            return
        if (reason := self._refusal(order)) is not None:
            log.info("%s: %s denied: %s", self.name, order.command[:32], reason)
            self._tell(order.nonce, order.command, "denied", reason=reason)
            return
        self._carry_out(order)

    def _now(self) -> float:
        return self._clock.unix(self._clock.now())

    def _repeated(self, order: Order) -> bool:
        """Whether the nonce is known; whoever repeats himself gets his answer again."""
        before = self._seen.get(order.nonce)
        if before is None:
            return False
        if before != order:
            self._tell(order.nonce, order.command, "denied", reason="the nonce was used before", keep=False)
        elif order.nonce in self._answers:
            self._answer(self._answers[order.nonce])
        return True

    def _refusal(self, order: Order) -> str | None:
        """Why the order is not even looked at; None: it is, and its nonce is used up."""
        now, limit = self._now(), self._age_s
        if order.time < self._started:
            return "it was given before this daemon started"
        if abs(age := now - order.time) > limit:
            return f"it is {age:.1f} s old, {limit:g} are allowed" if age > 0 else "its time lies in the future"
        if order.command not in _NUMBERS:
            return f"there is no such command; known: {', '.join(sorted(_NUMBERS))}"
        self._forget(now - 2.0 * limit)
        if len(self._seen) >= _MOST_NONCES and order.command not in _URGENT:
            return "too many commands at once"
        self._seen[order.nonce] = order
        if _NUMBERS[order.command] in self._under_way and order.command not in _URGENT:
            return "the same command is under way"
        return None

    def _forget(self, before: float) -> None:
        """A nonce whose order is too old in any case need not be known."""
        under_way = {nonce for nonces in self._under_way.values() for nonce in nonces}
        for nonce in [n for n, order in self._seen.items() if order.time < before and n not in under_way]:
            del self._seen[nonce]
            self._answers.pop(nonce, None)

    def _carry_out(self, order: Order) -> None:
        number = _NUMBERS[order.command]
        parameters = (*order.parameters, *(0.0,) * (7 - len(order.parameters)))
        # whoever lets orders in here has seen to who sends them, which stands for a signature
        sender = Sender(self._system, _COMPONENT, "ground", ours=False, trusted=True)
        log.info("%s: %s %s", self.name, order.command, list(order.parameters))
        self._under_way.setdefault(number, deque(maxlen=_MOST_WAITING)).append(order.nonce)
        self._service.handle(Command(number, parameters, 0, sender), cast("MavlinkLink", self))

    def send(self, message: Message) -> None:
        """What the command service says, as it says it on a link: reasons as STATUSTEXT, then COMMAND_ACK."""
        match message.get_type():
            case "STATUSTEXT":
                self._reason = (self._reason if message.chunk_seq else "") + message.text
            case "COMMAND_ACK" if (nonces := self._under_way.get(message.command)) is not None:
                done = message.result != mav.MAV_RESULT_IN_PROGRESS
                if done:
                    del self._under_way[message.command]
                for nonce in nonces:
                    self._tell(
                        nonce,
                        self._seen[nonce].command,
                        _RESULTS.get(message.result, "failed"),
                        percent=None if done else progress(message.progress),
                        reason=self._reason,
                    )
                self._reason = ""

    def _tell(
        self,
        nonce: str,
        command: str,
        result: str,
        *,
        percent: int | None = None,
        reason: str = "",
        keep: bool = True,
    ) -> None:
        values = {"nonce": nonce, "command": command[:32], "result": result, "progress": percent, "reason": reason}
        answer = packet("answer", self._now(), values)
        if keep and nonce in self._seen:
            self._answers[nonce] = answer
        self._answer(answer)
