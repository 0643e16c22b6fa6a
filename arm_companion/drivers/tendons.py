"""Tendons from servos and back: displacement, speed, tension with its uncertainty, and limits on what leaves.

Each servo winds up tendon on a pulley. `pull` is the length of a tendon taken in, zero where the servos' zero
positions hold the straight arm at its pretension. Where tendons are coupled, what one servo winds up moves others
too: `pull = C wound`, and by virtual work the pulleys feel `C^T tension`.
"""

import math
from collections.abc import Sequence

import numpy as np

from arm_companion.arm.tension import LoadCurve, Tension
from arm_companion.config.schema import LimitsConfig, ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.mission.facts import TendonState
from arm_companion.protocol.control_table import TICK_RAD

STANDSTILL_RAD_PER_S = 0.06
"""Below this a servo counts as standing: two and a half units of its speed register."""

_LONGEST_STEP_S = 0.1  # a pause in the commands is no licence to jump
_EASING_SHARE = 0.5  # of the speed limit, at which a tendon that is too tight is let out

Rows = tuple[tuple[float, ...], ...]


class Tendons:
    """Converts between servos and tendons, and limits goals.

    Attributes:
        latest: tendon states of the last `states`.
        limited: for each tendon whether the last goal had to be limited.
        curves: from load to force at the pulley, for each servo.
    """

    def __init__(
        self,
        servos: ServosConfig,
        limits: LimitsConfig,
        pulley_radius_m: float,
        curves: Sequence[LoadCurve] | None = None,
    ) -> None:
        """Tendons in the order of the servos, each on a pulley of `pulley_radius_m`; without `curves` as configured."""
        self._servos = servos
        self._limits = limits
        self._radius = pulley_radius_m
        self._m_per_tick = TICK_RAD * pulley_radius_m
        self._coupling: Rows | None = None
        if servos.coupling:
            self._coupling = servos.coupling
            inverse = np.linalg.inv(np.array(servos.coupling))
            self._uncoupling, self._to_tension = _rows(inverse), _rows(inverse.T)
        self._last: tuple[float, ...] | None = None
        self._last_at = -math.inf
        self.curves = (
            tuple(curves) if curves is not None else (nominal_curve(servos, pulley_radius_m),) * len(servos.ids)
        )
        self.latest: tuple[TendonState, ...] = ()
        self.limited: tuple[bool, ...] = (False,) * len(servos.ids)

    # Servo to tendon.

    def wound(self, i: int, ticks: float) -> float:
        """Length in m that servo `i` has wound up at a position, from its zero."""
        return self._servos.directions[i] * (ticks - self._servos.zero_ticks[i]) * self._m_per_tick

    def ticks(self, i: int, wound: float) -> int:
        """Position at which servo `i` has wound up a length (m)."""
        return self._servos.zero_ticks[i] + round(self._servos.directions[i] * wound / self._m_per_tick)

    def states(self, servos: Sequence[ServoState]) -> tuple[TendonState, ...]:
        """State of each tendon; one whose servo was never heard has sigma inf and zeros.

        The tension of one that fell silent is what it said last, and its sigma inf: nobody knows what it is now.
        """
        heard = [math.isfinite(servo.age_s) for servo in servos]
        pulls = [self.wound(i, servo.position) if heard[i] else 0.0 for i, servo in enumerate(servos)]
        speeds = [d * s.speed * self._m_per_tick for d, s in zip(self._servos.directions, servos, strict=True)]
        forces = [
            self.force(i, self._servos.directions[i] * servo.load, speeds[i], servo.voltage)
            if heard[i]
            else Tension(0.0, math.inf, math.inf)
            for i, servo in enumerate(servos)
        ]
        for i, servo in enumerate(servos):
            if servo.silent:
                forces[i] = Tension(forces[i].value, math.inf, math.inf)
        if self._coupling is not None:
            pulls, speeds = _times(self._coupling, pulls), _times(self._coupling, speeds)
            forces = _mixed(self._to_tension, forces)
        self.latest = tuple(self._state(i, servo, pulls[i], speeds[i], forces[i]) for i, servo in enumerate(servos))
        return self.latest

    def force(self, i: int, pulling_load: float, speed: float, voltage: float) -> Tension:
        """Force on the pulley of servo `i`, which without coupling is its tendon's tension.

        Args:
            i: which.
            pulling_load: share of full load, positive when pulling.
            speed: at which it winds up, m/s.
            voltage: of the supply, V.
        """
        moving = abs(speed) > STANDSTILL_RAD_PER_S * self._radius
        direction = (1 if speed > 0.0 else -1) if moving else 0
        return self.curves[i].tension(pulling_load, direction, voltage)

    def _state(self, i: int, servo: ServoState, pull: float, speed: float, tension: Tension) -> TendonState:
        return TendonState(
            pull=pull,
            speed=speed,
            tension=tension.value,
            tension_sigma=tension.sigma,
            tension_bias=tension.bias,
            load=self._servos.directions[i] * servo.load,
            temperature=servo.temperature,
            voltage=servo.voltage,
            error_bits=servo.error_bits,
            silent=servo.silent,
            age_s=servo.age_s,
            torque=servo.torque,
            ready=servo.ready,
            homed=not servo.turns_lost,
        )

    # Tendon to servo.

    def goals(self, pulls: Sequence[float], now: float) -> tuple[int, ...]:
        """Servo positions for wanted displacements, within all limits.

        Limited are the displacement, the speed since the last goals, and what the tensions of `latest` allow:
        a tendon above its greatest tension is let out and never taken in; one that is surely below its least
        is never let out. The first goals, and the first after `rest`, are where the tendons are.

        Args:
            pulls: m for each tendon. One that is not finite keeps the tendon where it was.
            now: loop time, s.
        """
        if self._last is None:
            self._last, self._last_at = tuple(state.pull for state in self.latest) or (0.0,) * len(pulls), now
        before = self._last
        step = self._limits.pull_speed_m_per_s * min(max(now - self._last_at, 0.0), _LONGEST_STEP_S)
        allowed = tuple(self._allow(i, wanted, before[i], step) for i, wanted in enumerate(pulls))
        self.limited = tuple(a != w for a, w in zip(allowed, pulls, strict=True))
        self._last, self._last_at = allowed, now
        wound = allowed if self._coupling is None else _times(self._uncoupling, allowed)
        return tuple(self.ticks(i, length) for i, length in enumerate(wound))

    def rest(self) -> None:
        """No goals are being sent: the next ones start from where the tendons are then."""
        self._last = None

    def _allow(self, i: int, wanted: float, before: float, step: float) -> float:
        limits = self._limits
        reach = limits.pull_max_m
        wanted = min(max(wanted, -reach), reach) if math.isfinite(wanted) else before
        lower, upper = before - step, before + step
        if i < len(self.latest):
            state = self.latest[i]
            # what a servo said before it fell silent is no reason to let out, cycle after cycle
            if state.tension > limits.tension_max_n and math.isfinite(state.tension_sigma):
                upper = max(before - _EASING_SHARE * step, min(before, -reach))  # as far as any goal may go
            elif state.tension + 2.0 * state.tension_sigma < limits.tension_min_n:
                lower = before
        return min(max(wanted, lower), upper)


def nominal_curve(servos: ServosConfig, radius: float) -> LoadCurve:
    """From load to tension as the configuration has it, for a pulley of `radius` m."""
    return LoadCurve.nominal(
        servos.load_torque_nm,
        servos.load_voltage_v,
        servos.load_torque_sigma,
        servos.friction_torque_nm,
        servos.load_sigma,
        radius,
    )


def _rows(matrix: np.ndarray) -> Rows:
    return tuple(tuple(row) for row in matrix.tolist())


def _times(rows: Rows, values: Sequence[float]) -> list[float]:
    return [math.fsum(a * x for a, x in zip(row, values, strict=True)) for row in rows]


def _mixed(rows: Rows, forces: Sequence[Tension]) -> list[Tension]:
    """Linear combinations of independent forces; a tendon never pushes."""
    return [
        Tension(
            max(math.fsum(a * f.value for a, f in zip(row, forces, strict=True) if a), 0.0),
            math.hypot(*(a * f.sigma for a, f in zip(row, forces, strict=True) if a)),
            math.hypot(*(a * f.bias for a, f in zip(row, forces, strict=True) if a)),
        )
        for row in rows
    ]
