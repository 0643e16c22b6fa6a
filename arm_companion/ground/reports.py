"""What the arm tells, as values: SI units, the frames of the dialect, NaN where something is not known."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Final, TypeAlias

from arm_companion.protocol.dialect import mav
from arm_companion.protocol.mavlink import Message

Vector: TypeAlias = tuple[float, float, float]

_NO_PROGRESS: Final = 255
_INT16_MAX: Final = 32_767
_UINT16_MAX: Final = 65_535


def names_of(enum: str, bits: int) -> tuple[str, ...]:
    """Names of the bits that are set in a bitmask of the dialect, in lower case and without the enum's name."""
    named = {value: entry.name for value, entry in mav.enums[enum].items() if value & bits == value != 0}
    unknown = bits & ~sum(mav_value for mav_value in named if mav_value.bit_count() == 1)
    short = [name.removeprefix(f"{enum}_").lower() for value, name in sorted(named.items()) if value.bit_count() == 1]
    return (*short, *([f"0x{unknown:x}"] if unknown else []))


def name_of(enum: str, value: int) -> str:
    """Name of an enum's entry, in lower case and without the enum's name; the number where it has none."""
    entry = mav.enums[enum].get(value)
    return str(value) if entry is None else entry.name.removeprefix(f"{enum}_").lower()


@dataclass(frozen=True, slots=True)
class Status:
    """ARM_STATUS: what the arm is doing."""

    MESSAGE: ClassVar[str] = "ARM_STATUS"

    time: float  # Unix time, s
    behaviour: str
    state: str  # such as PERCHED
    progress: int | None  # per cent
    flags: tuple[str, ...]
    errors: tuple[str, ...]
    calibration: str
    theta: float  # rad, bend
    delta: float  # rad, bending plane about base z
    goal_theta: float
    goal_delta: float
    tip_position: Vector  # m, base axes
    control: tuple[int, int] = (0, 0)  # system and component that hold primary control; 0: nobody

    @classmethod
    def of(cls, message: Message) -> "Status":
        """From the message."""
        return cls(
            message.time_usec * 1e-6,
            name_of("ARM_BEHAVIOUR", message.behaviour),
            message.state_name or name_of("ARM_STATE", message.state).upper(),
            None if message.progress == _NO_PROGRESS else message.progress,
            names_of("ARM_FLAG", message.flags),
            names_of("ARM_ERROR", message.errors),
            name_of("ARM_CALIBRATION", message.calibration),
            message.theta,
            message.delta,
            message.goal_theta,
            message.goal_delta,
            _vector(message.tip_position),
            (message.control_system, message.control_component),
        )


@dataclass(frozen=True, slots=True)
class Wrench:
    """ARM_REACTION_WRENCH: what the arm is predicted to put on the airframe, about its centre of mass, body FRD."""

    MESSAGE: ClassVar[str] = "ARM_REACTION_WRENCH"

    time: float  # Unix time, s
    force: Vector  # N
    torque: Vector  # N m
    force_sigma: Vector  # N, one sigma
    torque_sigma: Vector  # N m
    taut_margin: float  # m
    residual: float
    source: str  # free, contact, anchored, payload
    validity: tuple[str, ...]  # of force, torque

    @classmethod
    def of(cls, message: Message) -> "Wrench":
        """From the message."""
        return cls(
            message.time_usec * 1e-6,
            _vector(message.force),
            _vector(message.torque),
            _vector(message.force_sigma),
            _vector(message.torque_sigma),
            message.taut_margin,
            message.residual,
            name_of("ARM_WRENCH_SOURCE", message.source),
            names_of("ARM_VALIDITY", message.validity),
        )


@dataclass(frozen=True, slots=True)
class Tendon:
    """One tendon and its servo."""

    index: int
    displacement: float  # m, taken in
    goal: float  # m
    tension: float  # N
    tension_sigma: float  # N
    load: float  # share of the servo's full load, -1 to 1
    temperature: float  # deg C
    voltage: float  # V
    hardware_error: int  # bits of the servo
    silent: bool
    torque_on: bool


@dataclass(frozen=True, slots=True)
class Tendons:
    """ARM_TENDONS: up to four tendons; an arm with more sends one message for each four."""

    MESSAGE: ClassVar[str] = "ARM_TENDONS"

    time: float  # Unix time, s
    tendons: tuple[Tendon, ...]

    @classmethod
    def of(cls, message: Message) -> "Tendons":
        """From the message."""
        return cls(message.time_usec * 1e-6, tuple(_tendon(message, i) for i in range(min(message.count, 4))))


@dataclass(frozen=True, slots=True)
class Payload:
    """ARM_PAYLOAD: what the arm carries, sent while it carries something."""

    MESSAGE: ClassVar[str] = "ARM_PAYLOAD"

    time: float  # Unix time, s
    mass: float  # kg
    mass_sigma: float  # kg, one sigma
    centre_of_mass: Vector  # m, body axes
    centre_of_mass_sigma: Vector  # m
    valid: bool  # it may be used

    @classmethod
    def of(cls, message: Message) -> "Payload":
        """From the message."""
        return cls(
            message.time_usec * 1e-6,
            message.mass,
            message.mass_sigma,
            _vector(message.centre_of_mass),
            _vector(message.centre_of_mass_sigma),
            bool(message.valid),
        )


Report: TypeAlias = Status | Wrench | Tendons | Payload
Kind: TypeAlias = type[Status] | type[Wrench] | type[Tendons] | type[Payload]

REPORTS: Final[dict[str, Kind]] = {cls.MESSAGE: cls for cls in (Status, Wrench, Tendons, Payload)}


def as_json(report: Report) -> dict[str, Any]:
    """A report as one JSON object: its message's name, then its fields; what is not known is null."""
    return {"message": report.MESSAGE, **{name: _plain(value) for name, value in dataclasses.asdict(report).items()}}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(entry) for entry in value]
    return value


def _vector(values: Any) -> Vector:
    x, y, z = values
    return (x, y, z)


def _tendon(message: Message, i: int) -> Tendon:
    load, temperature, voltage = message.load[i], message.temperature[i], message.voltage[i]
    return Tendon(
        message.first + i,
        message.displacement[i],
        message.goal[i],
        message.tension[i],
        message.tension_sigma[i],
        math.nan if load == _INT16_MAX else load * 1e-3,
        math.nan if temperature == _INT16_MAX else temperature * 1e-2,
        math.nan if voltage == _UINT16_MAX else voltage * 1e-3,
        message.errors[i],
        bool(message.silent >> i & 1),
        bool(message.torque >> i & 1),
    )
