"""Options of the hang perch: how the weight goes from the motors to an arm above, and back."""

from dataclasses import dataclass

from arm_companion.config.options import option


@dataclass(frozen=True)
class HangConfig:
    """[hang] The hang perch: an arm above wraps a bar, the vehicle hangs from it with its motors idle."""

    steps: int = option("steps in which the thrust goes down, and up again", 4, lower=1, upper=20)
    idle_share: float = option(
        "thrust of the hanging vehicle's motors, share of hover thrust; an autopilot whose motors stand at their lower "
        "limit may think that it has landed, and stop them",
        0.25,
        lower=0.05,
        upper=0.8,
    )
    share_per_s: float = option(
        "how fast the thrust changes, share of hover thrust", 0.25, unit="1/s", lower=0.02, upper=2.0
    )
    rest_m: float = option(
        "a vehicle that moved less within a few seconds is at rest", 0.015, unit="m", lower=0.002, upper=0.5
    )
    rest_s: float = option("time at rest that ends a step", 1.0, unit="s", lower=0.1, upper=30.0)
    slip_m: float = option(
        "a move down or along the bar within a few seconds that means slip", 0.05, unit="m", lower=0.005, upper=1.0
    )
    give_m: float = option("most that the vehicle sinks until it hangs", 0.15, unit="m", lower=0.01, upper=1.0)
    fall_m_per_s: float = option("a vehicle that sinks faster falls", 0.3, unit="m/s", lower=0.05, upper=3.0)
    carried_share: float = option(
        "share of the hover's throttle at which the motors carry the vehicle again", 0.9, lower=0.5, upper=1.0
    )
    lift_m_per_s: float = option(
        "how fast the set-point rises to take the last of the load back", 0.02, unit="m/s", lower=0.005, upper=0.2
    )
    throttle_timeout_s: float = option("an older throttle is none", 1.0, unit="s", lower=0.1, upper=10.0)
    state_timeout_s: float = option(
        "time for the transfer of the load, and for taking it back", 60.0, unit="s", lower=5.0, upper=600.0
    )
