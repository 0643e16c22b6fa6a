"""Which options a ground station may read and change as MAVLink parameters, under which names, and when.

Type, unit, bounds and meaning come from the schema. The table is what MAVLink demands: fixed names of at most 16
characters, in one order, while the daemon runs.
"""

import ctypes
import dataclasses
import enum
import functools
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from arm_companion.config.options import Option, describe
from arm_companion.config.schema import Config
from arm_companion.errors import ConfigError

NAME_LENGTH: Final = 16


class When(enum.Enum):
    """When a new value takes effect."""

    NOW = "at once"
    STOWED = "at once, and only while the arm is stowed"
    RESTART = "at the next start of the daemon"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One option, or one entry of a list."""

    name: str
    section: str
    key: str
    when: When
    entry: int | None = None
    """Which entry of a list; None where the option is no list."""

    @property
    def path(self) -> str:
        """How the option is called in the configuration file."""
        return f"{self.section}.{self.key}" + ("" if self.entry is None else f"[{self.entry}]")

    @property
    def option(self) -> Option:
        """What the schema knows of it."""
        fields = {f.name: f for f in dataclasses.fields(_section(self.section))}
        return describe(fields[self.key]) or Option("")

    @property
    def whole(self) -> bool:
        """Whether its values are whole numbers."""
        hint = _hints(_section(self.section))[self.key]
        return int in (hint, *typing.get_args(hint))

    def read(self, config: Config) -> float:
        """Its value in a configuration."""
        value = getattr(getattr(config, self.section), self.key)
        return float(value if self.entry is None else value[self.entry])

    def write(self, config: Config, value: float) -> Config:
        """The configuration with another value of this option.

        Raises:
            ConfigError: the value is not finite, out of bounds or not whole, or does not go with other options.
        """
        option = self.option
        number: float = round(value) if self.whole and abs(value) < 2**31 else _decimal(value)
        if not option.lower <= number <= option.upper or (self.whole and number != value):
            kind = "a whole number, " if self.whole else ""
            raise ConfigError(f"{self.name} = {value:g} is not allowed: {kind}{option.allowed()}")
        section = getattr(config, self.section)
        new: Any = number
        if self.entry is not None:
            entries = list(getattr(section, self.key))
            entries[self.entry] = number
            new = tuple(entries)
        return dataclasses.replace(config, **{self.section: dataclasses.replace(section, **{self.key: new})})


def _decimal(value: float) -> float:
    """The shortest decimal that is the same float of 32 bits, as which it travels: 0.1 comes as 0.10000000149."""
    same = ctypes.c_float(value).value
    shorter = (float(f"{value:.{digits}g}") for digits in (7, 8))
    return next((number for number in shorter if ctypes.c_float(number).value == same), value)


@functools.cache
def _section(name: str) -> Any:
    return typing.get_type_hints(Config)[name]


@functools.cache
def _hints(section: Any) -> dict[str, Any]:
    return typing.get_type_hints(section)


def _table() -> tuple[Parameter, ...]:
    now, stowed, restart = When.NOW, When.STOWED, When.RESTART
    bar = tuple(Parameter(f"PERCH_BAR_{axis}", "perch", "bar_position_m", stowed, i) for i, axis in enumerate("XYZ"))
    rows = {
        ("perch", stowed): {
            "PERCH_BAR_HDG": "bar_axis_deg",
            "PERCH_BAR_R": "bar_radius_m",
            "PERCH_CONT_ARC": "contact_arc_m",
            "PERCH_STANDOFF": "standoff_m",
            "PERCH_APPR_SPD": "approach_speed_m_per_s",
            "PERCH_REACH_SPD": "reach_speed_m_per_s",
            "PERCH_OVERREACH": "overreach_m",
            "PERCH_CONT_F": "contact_force_n",
            "PERCH_WRAP_BEND": "wrap_bend_rad",
            "PERCH_WRAP_CLR": "wrap_clearance_m",
            "PERCH_FREE_ARC": "free_arc_m",
            "PERCH_BEND_SPD": "bend_speed_rad_per_s",
            "PERCH_GRIP_TEN": "grip_tension_n",
            "PERCH_PULL": "verify_pull_m",
            "PERCH_GIVE": "verify_give_share",
            "PERCH_JOG_MAX": "jog_max_m",
            "PERCH_CONT_TO": "contact_timeout_s",
            "PERCH_STATE_TO": "state_timeout_s",
        },
        ("limits", stowed): {
            "LIM_TEN_MIN": "tension_min_n",
            "LIM_TEN_MAX": "tension_max_n",
            "LIM_PULL": "pull_max_m",
            "LIM_PULL_SPD": "pull_speed_m_per_s",
            "LIM_BEND": "bend_max_rad",
            "LIM_FORCE": "wrench_force_n",
            "LIM_MOMENT": "wrench_moment_nm",
            "LIM_VEH_SPD": "vehicle_speed_m_per_s",
            "LIM_FF": "feedforward_m_per_s2",
        },
        ("vehicle", stowed): {"VEH_MASS": "mass_kg", "VEH_STATE_TO": "state_timeout_s"},
        ("vehicle", restart): {
            "VEH_SYSID": "system_id",
            "VEH_COMPID": "component_id",
            "VEH_STATE_HZ": "state_rate_hz",
            "VEH_BEAT_TO": "heartbeat_timeout_s",
        },
        ("rates", now): {
            "RATE_STATUS": "status_hz",
            "RATE_TENDONS": "tendons_hz",
            "RATE_WRENCH": "wrench_hz",
            "RATE_STIFFNESS": "stiffness_hz",
            "RATE_PAYLOAD": "payload_hz",
            "RATE_MIRRORS": "mirrors_hz",
        },
        ("rates", restart): {"RATE_CYCLE": "cycle_hz"},
        ("mavlink", restart): {
            "MAV_ACTUATOR": "actuator",
            "MAV_CONTROL_TO": "control_timeout_s",
            "MAV_TARGET_AGE": "target_age_s",
            "MAV_INSTANCE": "vehicle_instance",
        },
    }
    plain = (
        Parameter(name, section, key, when) for (section, when), keys in rows.items() for name, key in keys.items()
    )
    return tuple(sorted((*bar, *plain), key=lambda parameter: parameter.name))


PARAMETERS: Final[tuple[Parameter, ...]] = _table()
"""All of them, by name."""


def overlay(config: Config, values: Mapping[str, float]) -> tuple[Config, list[str]]:
    """A configuration with values that a ground station has set in an earlier run.

    Args:
        config: as the files say.
        values: by path of the option.

    Returns:
        The configuration, and in words what no longer fits and was left as the files say.
    """
    known = {parameter.path: parameter for parameter in PARAMETERS}
    complaints = [f"{path} is no parameter" for path in values if path not in known]
    left = {path: value for path, value in values.items() if path in known}
    # A value may fit only after another of them, as a lower limit does after what it limits: try until nothing moves.
    while left:
        refused = {}
        for path, value in left.items():
            try:
                config = known[path].write(config, value)
            except ConfigError as error:
                refused[path] = str(error)
        if len(refused) == len(left):
            return config, [*complaints, *refused.values()]
        left = {path: left[path] for path in refused}
    return config, complaints
