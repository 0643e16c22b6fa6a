"""Foxglove's websocket, in a process of its own: `python -m arm_companion.live.server`.

It is fed (see `side_process`) with the messages of a record, each `"<Unix time in ns> <JSON>"`, and with `scene`. How
many of its channels somebody looks at goes back as `["viewers", number]`. Clients can look, and nothing else: none of
the protocol's ways to change something is offered.
"""

import asyncio
import json
from collections.abc import Awaitable, Callable
from typing import Any, Final

import foxglove
from foxglove.channels import FrameTransformsChannel, SceneUpdateChannel
from foxglove.websocket import ChannelView, Client, ServerListener

from arm_companion.drivers.side_child import Take, run, tell
from arm_companion.live.scene import scene, transforms
from arm_companion.record.topics import COMMANDS, CONFIGURATION, FACTS, LOG, SCHEMAS, STATE, TRANSITIONS

TOPICS: Final = (FACTS, STATE, COMMANDS, TRANSITIONS, LOG, CONFIGURATION)
_MOST_MEMORY: Final = 512 << 20
_BACKLOG: Final = 256
"""Messages that wait for a slow client; beyond, its oldest is dropped."""
_LOOK_S: Final = 0.2


class LiveServer:
    """Serves what it is given.

    Args:
        name: of the vehicle, for the title.
        viewers: told how many channels somebody looks at, when that changes.
    """

    def __init__(self, name: str, viewers: Callable[[int], None]) -> None:
        self._name = name
        self._viewers = viewers
        self._context = foxglove.Context()
        self._channels = {
            topic: foxglove.Channel(topic, schema=_titled(*SCHEMAS[topic]), context=self._context) for topic in TOPICS
        }
        self._scene = SceneUpdateChannel("/scene", context=self._context)
        self._transforms = FrameTransformsChannel("/tf", context=self._context)
        self._configuration: tuple[str, int] | None = None
        self._watched = 0

    def open(self, host: str, port: int) -> Any:
        """Open the port; what stops it again.

        Raises:
            RuntimeError: it cannot be had.
        """
        return foxglove.start_server(
            name=self._name,
            host=host,
            port=port,
            context=self._context,
            message_backlog_size=_BACKLOG,
            server_listener=_Newcomers(asyncio.get_running_loop(), self._repeat_configuration),
        )

    def take(self, topic: str, payload: str) -> None:
        """One message of the daemon's."""
        stamp, _, text = payload.partition(" ")
        ns = int(stamp)
        if topic == "scene":
            table = json.loads(text)
            self._transforms.log(transforms(ns, table), log_time=ns)
            self._scene.log(scene(ns, table), log_time=ns)
            return
        if topic == CONFIGURATION:
            self._configuration = (text, ns)
        self._channels[topic].log(text, log_time=ns)

    async def watch(self) -> None:
        """Tell of viewers, until cancelled."""
        while True:
            await asyncio.sleep(_LOOK_S)
            watched = sum(channel.has_sinks() for channel in self._channels.values())
            watched += self._scene.has_sinks() + self._transforms.has_sinks()
            if watched != self._watched:
                self._watched = watched
                self._viewers(watched)

    def _repeat_configuration(self) -> None:
        """It is said once and seldom again, so who comes later would not know it."""
        if self._configuration is not None:
            text, ns = self._configuration
            self._channels[CONFIGURATION].log(text, log_time=ns)


class _Newcomers(ServerListener):
    """Told by the server's own thread who begins to look at what."""

    def __init__(self, loop: asyncio.AbstractEventLoop, repeat: Callable[[], None]) -> None:
        self._loop = loop
        self._repeat = repeat

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # noqa: ARG002 - as the library calls it
        """See `ServerListener`."""
        if channel.topic == CONFIGURATION:
            self._loop.call_soon_threadsafe(self._repeat)


def _titled(name: str, schema: dict[str, Any]) -> dict[str, Any]:
    """Foxglove takes a JSON schema's title for its name."""
    return schema | {"title": name}


def main(settings: dict[str, Any]) -> tuple[Take, Awaitable[None]]:
    """The live view of what the daemon sends."""
    server = LiveServer(settings["name"], lambda number: tell("viewers", str(number)))

    async def serve() -> None:
        try:
            listening = server.open(settings["host"], settings["port"])
        except (RuntimeError, OSError) as error:
            tell("log", f"{settings['host']}:{settings['port']} cannot be opened: {error}")
            return
        tell("log", f"Foxglove: ws://{settings['host']}:{listening.port}")
        try:
            await server.watch()
        finally:
            listening.stop()

    return server.take, serve()


if __name__ == "__main__":
    run(main, _MOST_MEMORY)
