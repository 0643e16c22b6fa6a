"""What happens to real servos and their bus, on demand.

| fault | how |
| --- | --- |
| bytes lost or changed | `EmulatedBus.to_servos`, `.to_master` = `ByteNoise` |
| bytes late | `EmulatedBus.delays` = `ByteDelay`; every answer: `EmulatedBus.latency_s` |
| a servo is silent | `EmulatedServo.silenced` |
| its supply fails | `EmulatedServo.set_power`; of all: `ServoEmulator.set_power` |
| brown-out, over-voltage | `brown_out`, `ServoEmulator.supply_v` |
| its horn is stuck | `seize`, `set_free`; in time it shuts down with an overload |
| it is hot | `EmulatedServo.warm`; over its limit it shuts down |
| a hardware error | `EmulatedServo.trip` |
| it restarts | `EmulatedServo.reboot` |
| the cable is out | `EmulatedBus.unplug` |
| the master dies | write nothing: the bus watchdog trips |
| two servos with one id | `EmulatedServo.poke(ct.ID, ...)`: their answers collide |
"""

import asyncio
import itertools
import random

from arm_companion.sim.servo_device import EmulatedServo
from arm_companion.sim.servo_emulator import ServoEmulator
from arm_companion.sim.servo_motion import Motor


class ByteDelay:
    """Bytes that hang on their way to the master, as in a bridge or a busy USB hub.

    Attributes:
        share: probability that the line pauses before a byte.
        pause_s: for how long.
    """

    def __init__(self, share: float, pause_s: float, seed: int = 0) -> None:
        self.share = share
        self.pause_s = pause_s
        self._rng = random.Random(seed)  # noqa: S311 - reproducible faults, not a secret

    def __call__(self, data: bytes) -> list[tuple[float, bytes]]:
        """The pieces in which `data` arrives, each with the pause before it, s."""
        cuts = [i for i in range(len(data)) if self._rng.random() < self.share]
        edges = [0, *(i for i in cuts if i), len(data)]
        first = self.pause_s if 0 in cuts else 0.0
        return [(self.pause_s if start else first, data[start:end]) for start, end in itertools.pairwise(edges)]


class SeizedMotor(Motor):
    """A gear train that is stuck: it strains and does not turn."""

    def step(self, voltage: float, load_torque: float, dt: float, *, on: bool) -> None:
        """Let the motor strain for `dt`, and stay where it is."""
        before = self.position
        self.speed = 0.0
        super().step(voltage, load_torque, dt, on=on)
        self.position, self.speed = before, 0.0


def seize(servo: EmulatedServo) -> None:
    """Jam a servo's horn where it is."""
    stuck = SeizedMotor(servo.motor.position)
    stuck.duty, stuck.torque = servo.motor.duty, servo.motor.torque
    servo.motor = stuck


def set_free(servo: EmulatedServo) -> None:
    """Let a seized horn turn again."""
    free = Motor(servo.motor.position)
    free.duty, free.torque = servo.motor.duty, servo.motor.torque
    servo.motor = free


async def brown_out(emulator: ServoEmulator, volts: float, seconds: float) -> None:
    """Let the supply of all servos sag for a while."""
    before, emulator.supply_v = emulator.supply_v, volts
    try:
        await asyncio.sleep(seconds)
    finally:
        emulator.supply_v = before
