"""Several simulated vehicles on one broker, and one screen that shows them all.

    python fleet.py fly --vehicles 2      # in one terminal: each flies a perch and lands
    python fleet.py watch                 # in another: a line for each vehicle, as it changes

A broker is needed, such as `mosquitto` from Debian, which listens on 127.0.0.1:1883 by itself.
"""

import argparse
import asyncio
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt

FIRST_PORT = 15_000
PORTS = 10  # that each vehicle has for itself


@dataclass
class Vehicle:
    """What the broker has told of one vehicle."""

    name: str
    available: bool = False
    topics: dict[str, dict[str, Any]] = field(default_factory=dict)

    def hear(self, topic: str, payload: bytes) -> None:
        """Take in one message; what is no JSON object is passed over, for any client may publish here."""
        if topic == "availability":
            self.available = payload == b"online"
            return
        try:
            value = json.loads(payload)
        except ValueError:
            return
        if isinstance(value, dict):
            self.topics[topic] = value

    def line(self) -> str:
        """All of it in one line."""
        state, wrench, tendons = (self.topics.get(topic, {}) for topic in ("state", "wrench", "tendons"))
        force = wrench.get("force")
        pushed = f"{sum(f * f for f in force) ** 0.5:5.2f} N" if wrench.get("valid") and force else "    ? N"
        tight = [tension for tension in tendons.get("tension") or [] if tension is not None]
        text = self.topics.get("events", {}).get("text", "")
        here = "online " if self.available else "offline"
        return (
            f"{self.name:>4}  {here}  {state.get('state', '?'):<13}  arm pushes {pushed}  "
            f"tightest tendon {max(tight, default=float('nan')):5.1f} N  {text}"
        )


async def watch(host: str, port: int) -> None:
    """Print a vehicle's line whenever its state or its newest event changes."""
    fleet: dict[str, Vehicle] = {}
    shown: dict[str, tuple[object, ...]] = {}
    async with aiomqtt.Client(host, port) as client:
        await client.subscribe("arm/+/#")
        async for message in client.messages:
            parts = str(message.topic).split("/")
            if len(parts) != 3 or not isinstance(message.payload, bytes):
                continue
            _, name, topic = parts
            vehicle = fleet.setdefault(name, Vehicle(name))
            vehicle.hear(topic, message.payload)
            now = (
                vehicle.available,
                vehicle.topics.get("state", {}).get("state"),
                vehicle.topics.get("events", {}).get("text"),
            )
            if shown.get(name) != now:
                shown[name] = now
                print(vehicle.line(), flush=True)


def settings(number: int, folder: Path, host: str, port: int) -> Iterator[str]:
    """What differs between the vehicles: ports, servo bus, and the name at the broker."""
    first = FIRST_PORT + PORTS * number
    yield f"mqtt.host={host}"
    yield f"mqtt.port={port}"
    yield f'mqtt.vehicle="{number}"'
    yield f"links.autopilot.url=udpin:127.0.0.1:{first}"
    yield f"sim.autopilot_url=udpout:127.0.0.1:{first}"
    yield f"links.ground.url=udpout:127.0.0.1:{first + 1}"
    yield f"sim.operator_arm_url=udpin:127.0.0.1:{first + 1}"
    yield f"sim.operator_autopilot_url=udpin:127.0.0.1:{first + 2}"
    yield f"servos.port={folder / f'servo-bus-{number}'}"
    yield f"sim.seed={number}"


def fly(vehicles: int, host: str, port: int, output: Path) -> int:
    """Fly all at once in real time; returns how many failed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flights = []
        for number in range(1, vehicles + 1):
            words = [sys.executable, "-m", "arm_companion", "sim", "perch", "--output", str(output / str(number))]
            for setting in settings(number, folder, host, port):
                words += ["--set", setting]
            flights.append(subprocess.Popen(words, stdout=subprocess.DEVNULL))
        print(f"vehicles that fly: {vehicles}; their logs and records: {output}", flush=True)
        ends = [flight.wait() for flight in flights]
    for number, end in enumerate(ends, 1):
        where = output / str(number) / "daemon.log"
        print(f"vehicle {number}: {'perched and landed' if end == 0 else f'exit code {end}, see {where}'}")
    return sum(end != 0 for end in ends)


def main() -> int:
    """Fly, or watch."""
    parser = argparse.ArgumentParser(description="Several simulated vehicles on one MQTT broker.")
    parser.add_argument("what", choices=("fly", "watch"))
    parser.add_argument(
        "--vehicles", type=int, default=2, help="how many fly (default: 2; each wants half a core to itself)"
    )
    parser.add_argument("--output", type=Path, default=Path("build/fleet"), help="folder (default: build/fleet)")
    parser.add_argument("--host", default="127.0.0.1", help="of the broker (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=1883, help="of the broker (default: 1883)")
    arguments = parser.parse_args()
    try:
        if arguments.what == "fly":
            return 1 if fly(arguments.vehicles, arguments.host, arguments.port, arguments.output) else 0
        asyncio.run(watch(arguments.host, arguments.port))
    except KeyboardInterrupt:  # the flights have had it too, and end by themselves
        return 130
    except aiomqtt.MqttError as error:
        print(f"broker at {arguments.host}:{arguments.port}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
