"""Tendons from servos and back: displacement, speed, tension with its uncertainty, and limits on what leaves.

Each servo winds its tendon on a pulley. `pull` is the length taken in, zero where the servo's zero position
holds the straight arm at its pretension. Tension is inferred from the servo's load, which the servo itself
infers from its duty: gear friction stands between the two, against the motion while the servo moves, and
anywhere between -f and +f while it stands.
"""

import math
from collections.abc import Sequence

from arm_companion.config.schema import LimitsConfig, ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.mission.facts import TendonState
from arm_companion.protocol.control_table import TICK_RAD

STANDSTILL_RAD_PER_S = 0.06
"""Below this a servo counts as standing: two and a half units of its speed register."""

_MOVING_FRICTION_SIGMA = 0.3  # of the friction, which direction alone does not settle
_LONGEST_STEP_S = 0.1  # a pause in the commands is no licence to jump
_EASING_SHARE = 0.5  # of the speed limit, at which a tendon that is too tight is let out


class Tendons:
    """Converts between servos and tendons, and limits goals.

    Attributes:
        latest: tendon states of the last `states`.
        limited: for each tendon whether the last goal had to be limited.
    """

    def __init__(self, servos: ServosConfig, limits: LimitsConfig, pulley_radius_m: float) -> None:
        """Tendons in the order of the servos, each on a pulley of `pulley_radius_m`."""
        self._servos = servos
        self._limits = limits
        self._radius = pulley_radius_m
        self._m_per_tick = TICK_RAD * pulley_radius_m
        self._last: tuple[float, ...] | None = None
        self._last_at = -math.inf
        self.latest: tuple[TendonState, ...] = ()
        self.limited: tuple[bool, ...] = (False,) * len(servos.ids)

    # Servo to tendon.

    def pull(self, i: int, ticks: float) -> float:
        """Displacement of tendon `i` in m at a servo position."""
        return self._servos.directions[i] * (ticks - self._servos.zero_ticks[i]) * self._m_per_tick

    def ticks(self, i: int, pull: float) -> int:
        """Servo position at which tendon `i` is displaced by `pull` (m)."""
        return self._servos.zero_ticks[i] + round(self._servos.directions[i] * pull / self._m_per_tick)

    def states(self, servos: Sequence[ServoState]) -> tuple[TendonState, ...]:
        """State of each tendon; one whose servo was never heard has sigma inf and zeros."""
        self.latest = tuple(self._state(i, servo) for i, servo in enumerate(servos))
        return self.latest

    def tension(self, pulling_load: float, speed: float) -> tuple[float, float]:
        """Tension and its sigma, N.

        With motor torque M (load times the torque of full load), friction f and pulley radius r: `(M - f)/r`
        while the servo takes tendon in, `(M + f)/r` while it lets out, and `M/r` while it stands, where
        friction may hold anything between -f and +f (uniform: sigma f / sqrt 3).

        Args:
            pulling_load: share of full load, positive when pulling.
            speed: of the tendon, m/s, positive when taken in.
        """
        c = self._servos
        friction = c.friction_torque_nm
        torque = pulling_load * c.load_torque_nm
        if abs(speed) > STANDSTILL_RAD_PER_S * self._radius:
            torque -= math.copysign(friction, speed)
            spread = _MOVING_FRICTION_SIGMA * friction
        else:
            spread = friction / math.sqrt(3.0)
        sigma = math.hypot(c.load_sigma * c.load_torque_nm, spread)
        return max(torque, 0.0) / self._radius, sigma / self._radius

    def _state(self, i: int, servo: ServoState) -> TendonState:
        heard = math.isfinite(servo.age_s)
        direction = self._servos.directions[i]
        speed = direction * servo.speed * self._m_per_tick
        load = direction * servo.load
        tension, sigma = self.tension(load, speed) if heard else (0.0, math.inf)
        return TendonState(
            pull=self.pull(i, servo.position) if heard else 0.0,
            speed=speed,
            tension=tension,
            tension_sigma=sigma,
            load=load,
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
        return tuple(self.ticks(i, pull) for i, pull in enumerate(allowed))

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
            if state.tension > limits.tension_max_n:
                upper = max(before - _EASING_SHARE * step, lower)
            elif state.tension + 2.0 * state.tension_sigma < limits.tension_min_n:
                lower = before
        return min(max(wanted, lower), upper)
