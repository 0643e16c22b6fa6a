"""Who looks at the arm from outside of MAVLink: the broker, the field page, the live view. None costs a cycle."""

from collections.abc import Awaitable, Callable

from arm_companion.clock import Clock
from arm_companion.config.schema import Config
from arm_companion.drivers.command_service import CommandService
from arm_companion.drivers.field_page import FieldPage
from arm_companion.drivers.mqtt_payloads import Health
from arm_companion.drivers.mqtt_publisher import MqttPublisher
from arm_companion.live.feed import Address, LiveView
from arm_companion.mission.facts import Notice
from arm_companion.mission.situation import Situation
from arm_companion.record.recorder import Record


class Onlookers:
    """Those that the configuration and the command line ask for.

    Args:
        config: of the daemon.
        clock: Unix time of what they are told.
        commands: where their orders go, as those of MAVLink do.
        live: where the live view is served; None: nowhere.

    Raises:
        ConfigError: what one of them needs is not there.
    """

    def __init__(self, config: Config, clock: Clock, commands: CommandService, live: Address | None) -> None:
        self._mqtt = MqttPublisher(config.mqtt, clock, commands) if config.mqtt.host else None
        self._page = FieldPage(config, clock, commands) if config.page.host else None
        self._live = None if live is None else LiveView(config, clock, live)

    @property
    def runs(self) -> list[Callable[[], Awaitable[None]]]:
        """What has to run for them."""
        return [part.run for part in (self._mqtt, self._page, self._live) if part is not None]

    def notice(self, notice: Notice) -> None:
        """Tell a sentence for people."""
        for part in (self._mqtt, self._page, self._live):
            if part is not None:
                part.event(notice)

    def configure(self, config: Config) -> None:
        """This configuration is in force from now on."""
        for part in (self._page, self._live):
            if part is not None:
                part.configure(config)

    def publish(self, record: Record, cycle: Situation, health: Callable[[], Health]) -> None:
        """Tell of a cycle; called in every one, and never raises.

        Args:
            record: the cycle, as it is recorded.
            cycle: the same with the memory after its step.
            health: how the daemon does, when that is due.
        """
        if self._mqtt is not None:
            self._mqtt.publish(record.t, record.facts, record.commands, health)
        if self._page is not None:
            self._page.publish(record.t, cycle, record.commands, health)
        if self._live is not None:
            self._live.publish(record, cycle)
