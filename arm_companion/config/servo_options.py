"""Options of the servos and of their calibration."""

from dataclasses import dataclass

import numpy as np

from arm_companion.config.options import option
from arm_companion.errors import ConfigError

_WORST_COUPLING = 1e4  # condition number


@dataclass(frozen=True)
class ServosConfig:
    """[servos] The Dynamixel bus and what each servo pulls."""

    port: str = option("serial device of the bus, or tcp:HOST:PORT of a bridge to it", "/dev/ttyUSB0")
    baud: int = option("bits per second", 1_000_000, lower=9600, upper=4_500_000)
    ids: tuple[int, ...] = option("servo id of each tendon, in the tendons' order", (1, 2, 3, 4), lower=0, upper=252)
    directions: tuple[int, ...] = option(
        "+1 where a growing position takes tendon in, -1 where it lets out", (1, 1, 1, 1), lower=-1, upper=1
    )
    zero_ticks: tuple[int, ...] = option(
        "position at which each tendon holds the straight arm at its pretension",
        (2048, 2048, 2048, 2048),
        lower=-1_048_575,
        upper=1_048_575,
    )
    home_window_ticks: int = option(
        "a servo that was without power is taken to hold its zero when it stands this near to it, whole turns aside",
        512,
        lower=0,
        upper=2048,
    )
    reply_timeout_s: float = option("deadline of one bus transaction", 0.008, unit="s", lower=0.001, upper=0.5)
    watchdog_s: float = option("servos stop when the bus is silent for", 0.2, unit="s", lower=0.02, upper=2.54)
    silent_after: int = option("missed replies in a row until a servo counts as silent", 10, lower=1, upper=1000)
    temperature_limit_c: int = option("a servo that is hotter lets go", 72, unit="degC", lower=40, upper=100)
    voltage_min_v: float = option("a servo reports a supply below", 9.5, unit="V", lower=6.0, upper=14.0)
    voltage_max_v: float = option("a servo reports a supply above", 14.0, unit="V", lower=6.0, upper=14.0)
    pwm_limit: float = option("most of the full duty that a servo puts out", 1.0, lower=0.1, upper=1.0)
    zero_sigma_m: float = option(
        "one sigma of zero_ticks, as length of tendon; a calibration brings its own",
        0.0005,
        unit="m",
        lower=0.0,
        upper=0.1,
    )
    coupling: tuple[tuple[float, ...], ...] = option(
        "row i: tendon i taken in for what each servo winds up; empty: each servo moves its own tendon alone",
        (),
        lower=-10.0,
        upper=10.0,
    )
    load_torque_nm: float = option("torque at 100 % load", 1.4, unit="N m", lower=0.05, upper=50.0)
    load_voltage_v: float = option("supply at which load_torque_nm holds", 12.0, unit="V", lower=5.0, upper=15.0)
    load_torque_sigma: float = option(
        "one sigma of load_torque_nm, share of it, until `calibrate tension` has measured it",
        0.1,
        lower=0.0,
        upper=1.0,
    )
    load_sigma: float = option("one sigma of the load reading, share of full load", 0.02, lower=0.0, upper=1.0)
    friction_torque_nm: float = option("torque lost in the gear train", 0.05, unit="N m", lower=0.0, upper=5.0)

    def __post_init__(self) -> None:
        n = len(self.ids)
        if len(set(self.ids)) != n:
            raise ConfigError(f"ids = {list(self.ids)} names a servo twice")
        for name in ("directions", "zero_ticks"):
            if len(getattr(self, name)) != n:
                raise ConfigError(f"{name} has {len(getattr(self, name))} entries for {n} ids")
        if any(d == 0 for d in self.directions):
            raise ConfigError("directions must be +1 or -1")
        if self.voltage_min_v >= self.voltage_max_v:
            raise ConfigError(f"voltage_min_v = {self.voltage_min_v:g} is not below {self.voltage_max_v:g}")
        if self.coupling:
            if len(self.coupling) != n or any(len(row) != n for row in self.coupling):
                raise ConfigError(f"coupling must have {n} rows of {n} numbers for {n} ids")
            if np.linalg.cond(np.array(self.coupling)) > _WORST_COUPLING:
                raise ConfigError("coupling cannot be inverted: some tendons can only move together")


@dataclass(frozen=True)
class CalibrationConfig:
    """[calibration] Where calibrations of the tendons are kept, and what the daemon makes of them."""

    directory: str = option("state directory; empty: no calibration is looked for", "")
    tendons: str = option(
        "whether the arm flies without a calibration of its tendons; one that does not fit is refused in any case",
        "optional",
        choices=("optional", "required"),
    )
    turned_ticks: int = option(
        "a servo that was without power counts as turned when it comes back farther than this from where it was",
        128,
        lower=1,
        upper=2048,
    )
    take_up_m_per_s: float = option(
        "of the tendons in a calibration that the ground station orders",
        0.003,
        unit="m/s",
        lower=0.001,
        upper=0.04,
    )
    max_age_days: float = option("an older calibration is used with a warning", 90.0, unit="d", lower=0.1, upper=3650.0)
