"""What the mission sees in one cycle, and what it may ask for. Plain immutable values, ready to be recorded.

Frames: w world (NED), b body (FRD), a arm base. Quaternions are (w, x, y, z) and turn body into world axes.
"""

import enum
import math
from dataclasses import dataclass, field
from typing import TypeAlias

from arm_companion.arm.tension import LoadCurve
from arm_companion.mission.gripper_facts import GripperOrder, GripperState
from arm_companion.procedures.tendon_zeros import Zero
from arm_companion.record_codec import UNRECORDED

Vec3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]


class Control(enum.Enum):
    """Who flies the vehicle, read from the autopilot's own heartbeat."""

    UNKNOWN = "unknown"
    EXTERNAL = "external"  # OFFBOARD on PX4, GUIDED on ArduPilot: our set-points count
    PILOT = "pilot"  # any other mode: a person or the autopilot itself flies
    FAILSAFE = "failsafe"  # the autopilot says it is in an emergency


@dataclass(frozen=True)
class VehicleState:
    """Newest state of the vehicle and the age of each part (inf: never received)."""

    position_w: Vec3 = (0.0, 0.0, 0.0)
    velocity_w: Vec3 = (0.0, 0.0, 0.0)
    attitude_wb: Quaternion = (1.0, 0.0, 0.0, 0.0)
    rate_b: Vec3 = (0.0, 0.0, 0.0)
    armed: bool = False
    landed: bool = True
    control: Control = Control.UNKNOWN
    mode: str = ""
    heartbeat_age_s: float = float("inf")
    position_age_s: float = float("inf")
    attitude_age_s: float = float("inf")
    throttle: float = 0.0  # share of full throttle that the motors are asked for together
    throttle_age_s: float = float("inf")
    thrust: float = math.nan  # share asked of the rotors, 0 to 1 along -z of the body; nan: not told lately
    clock_error_s: float = float("inf")  # greatest error of the ages, by TIMESYNC; inf: they count from the arrival


@dataclass(frozen=True)
class TendonState:
    """One tendon as its servo reports it."""

    pull: float  # m taken in, zero for the straight arm at its pretension
    speed: float  # m/s
    tension: float  # N, estimated from the servo's load
    tension_sigma: float  # N
    load: float  # share of full load, signed, positive when pulling
    temperature: float  # degC
    voltage: float  # V
    error_bits: int  # hardware-error bits of the servo
    silent: bool  # has not answered for several cycles
    age_s: float  # since the last good reply
    torque: bool  # torque is on
    ready: bool = True  # it follows goals: set up, watchdog quiet, no fault, turns known
    tension_bias: float = 0.0  # N, the part of the sigma that averaging does not take away
    homed: bool = True  # its turns are known: `pull` says where the tendon is


class CalibrationState(enum.IntEnum):
    """What is known of the tendons' zeros, ARM_CALIBRATION of the dialect."""

    UNKNOWN = 0  # the servos have not been heard yet
    MISSING = 1  # the zeros are the configuration's
    STALE = 2  # there is one, and it does not fit this arm any more
    RUNNING = 3
    VALID = 4


@dataclass(frozen=True)
class Calibration:
    """The tendons' calibration as far as the mission cares."""

    state: CalibrationState = CalibrationState.UNKNOWN
    refusal: str = ""  # why the arm must not fly on it; empty: it may
    zero_sigma: float = 0.0005  # m of tendon


@dataclass(frozen=True)
class Workshop:
    """What a calibration needs to know, there only while one is ordered or under way.

    Attributes:
        curves: from load to tension, of each servo.
        m_per_tick: m of tendon that one tick of a servo winds up.
        kept: what became of the last result: None, it is being stored; empty: stored and in use; else why not.
    """

    curves: tuple[LoadCurve, ...]
    m_per_tick: float
    kept: str | None = None


class Order(enum.Enum):
    """What a person can ask of the arm."""

    READY = "ready"
    STOW = "stow"
    PERCH = "perch"
    GRASP = "grasp"
    RELEASE = "release"
    ABORT = "abort"
    JOG = "jog"
    REACH = "reach"
    CLEAR_ERRORS = "clear_errors"
    FEEDFORWARD = "feedforward"
    CALIBRATE = "calibrate"


@dataclass(frozen=True)
class Request:
    """One accepted-for-consideration command; `id` ties the answer to whoever asked."""

    id: int
    order: Order
    parameters: tuple[float, ...] = ()


class Result(enum.Enum):
    """Fate of a request, in MAVLink's terms."""

    ACCEPTED = "accepted"
    IN_PROGRESS = "in_progress"
    TEMPORARILY_REJECTED = "temporarily_rejected"
    DENIED = "denied"
    FAILED = "failed"
    CANCELLED = "cancelled"


@dataclass(frozen=True)
class Answer:
    """What becomes of a request, with the reason in words for everything but success."""

    request: int
    result: Result
    reason: str = ""
    progress: int = 255  # per cent, 255: unknown


class Severity(enum.IntEnum):
    """Severity of a notice, MAV_SEVERITY."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


@dataclass(frozen=True)
class Notice:
    """One sentence for people, sent as STATUSTEXT and logged."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class Bar:
    """A bar in the world: a point on its axis, the axis' direction (unit) and its radius."""

    point_w: Vec3
    axis_w: Vec3
    radius: float
    covariance_w: tuple[float, ...] | None = None  # m^2, of the point: xx, xy, xz, yy, yz, zz; None: not told
    direction_sigma: float | None = None  # rad, one sigma of the axis' direction; None: not told


@dataclass(frozen=True)
class GraspTarget:
    """An object in the world: where its grasp frame is, and how wide to wrap."""

    position_w: Vec3
    attitude_wo: Quaternion | None  # turns object into world axes; None: not told
    radius: float
    covariance_w: tuple[float, ...] | None = None  # as a Bar's
    direction_sigma: float | None = None  # rad, one sigma of the attitude; None: not told


class SetpointKind(enum.IntEnum):
    """What an ArmSetpoint asks for, ARM_SETPOINT_KIND."""

    BEND = 0
    TIP = 1


@dataclass(frozen=True)
class ArmSetpoint:
    """Where a person or program streams the arm to; there is none any more once its time-out has passed."""

    kind: SetpointKind
    theta: float  # rad; BEND alone
    delta: float  # rad; BEND alone
    tip_a: Vec3  # m, base axes; TIP alone
    age_s: float
    timeout_s: float


class ArmAction(enum.Enum):
    """What the servos do in this cycle."""

    DRIVE = "drive"  # go to the goals given
    HOLD = "hold"  # keep the last goals
    WIND = "wind"  # the same, with slack allowed and limits counted from where the winding began
    LIMP = "limp"  # torque off


@dataclass(frozen=True)
class Setpoint:
    """Vehicle set-point in world axes (NED), always complete: both autopilots misread partial ones."""

    position_w: Vec3
    velocity_w: Vec3
    acceleration_w: Vec3
    yaw: float  # rad
    # the part of the acceleration that belongs to position and velocity; the rest is for a force
    path_w: Vec3 = field(default=(0.0, 0.0, 0.0), compare=False, metadata=UNRECORDED)


class ArmFlag(enum.IntFlag):
    """Facts that hold, bit for bit ARM_FLAG of the dialect."""

    NONE = 0
    SERVOS_CONNECTED = 1
    TORQUE_ON = 2
    CALIBRATED = 4
    VEHICLE_CONNECTED = 8
    VEHICLE_STATE_FRESH = 16
    EXTERNAL_CONTROL = 32
    SETPOINTS_SENT = 64
    FEEDFORWARD = 128
    TARGET_KNOWN = 256
    CONTACT = 512
    ANCHORED = 1024
    GRIPPER_CLOSED = 16384


class ArmFault(enum.IntFlag):
    """Causes of failure, bit for bit ARM_ERROR of the dialect."""

    NONE = 0
    VEHICLE_LOST = 1
    VEHICLE_STATE_STALE = 2
    ESTIMATOR_JUMP = 4
    PILOT_TOOK_OVER = 8
    AUTOPILOT_FAILSAFE = 16
    DISARMED = 32
    SETPOINT_REJECTED = 64
    GROUND_LOST = 128
    OPERATOR_ABORT = 256
    SERVO_SILENT = 512
    SERVO_FAULT = 1024
    OVERHEAT = 2048
    OVERLOAD = 4096
    LOW_VOLTAGE = 8192
    TENDON_SLACK = 16384
    TENDON_OVER_TENSION = 32768
    TENDON_BROKEN = 65536
    TENSION_DISAGREES = 131072
    NO_CONTACT = 262144
    CONTACT_LOST = 524288
    SLIP = 1048576
    GRIP_TEST_FAILED = 2097152
    WRENCH_LIMIT = 4194304
    MODEL = 8388608
    TIMEOUT = 16777216
    NOT_CALIBRATED = 33554432
    CYCLE_OVERRUN = 67108864
    RESTARTED = 536870912
    CALIBRATION_FAILED = 1073741824


class WrenchSource(enum.IntEnum):
    """Which situation the prediction of the reaction wrench assumes."""

    FREE = 0
    CONTACT = 1
    ANCHORED = 2
    PAYLOAD = 3


@dataclass(frozen=True)
class WrenchReport:
    """Predicted reaction wrench of the arm on the airframe, about its centre of mass, body axes (FRD)."""

    force_b: Vec3  # N
    torque_b: Vec3  # N m
    force_sigma: Vec3  # N, one sigma
    torque_sigma: Vec3  # N m, one sigma
    source: WrenchSource
    valid: bool
    taut_margin: float  # m the base may still move away before the arm goes taut; nan: does not apply
    residual: float  # of the model's equilibrium, relative; nan: none was solved


@dataclass(frozen=True)
class StatusReport:
    """What the arm is doing, for ARM_STATUS."""

    behaviour: str  # "stowed", "ready", "perch", ...
    state: str  # name of the machine's state
    state_number: int
    progress: int  # per cent, 255: unknown
    flags: ArmFlag
    error_bits: ArmFault
    theta: float  # rad
    delta: float  # rad
    tip_position_a: Vec3  # m, base axes
    goal_theta: float  # rad
    goal_delta: float  # rad
    calibration: CalibrationState = CalibrationState.UNKNOWN


@dataclass(frozen=True)
class StiffnessReport:
    """Tip compliance of the arm in its present pose: twist [linear; angular] per wrench [force; torque], body axes."""

    compliance_b: tuple[float, ...]  # upper triangle of the symmetric 6x6 matrix, row by row


@dataclass(frozen=True)
class PayloadReport:
    """Estimate of what the arm carries."""

    mass: float  # kg
    mass_sigma: float  # kg
    centre_of_mass_b: Vec3  # m, body axes
    centre_of_mass_sigma: Vec3  # m
    valid: bool


@dataclass(frozen=True)
class Facts:
    """Everything that one step sees: the world as known at this cycle, with the age of each part."""

    vehicle: VehicleState
    tendons: tuple[TendonState, ...]
    requests: tuple[Request, ...] = ()
    bar: Bar | None = None  # newest target
    bar_age_s: float = float("inf")
    grasp_target: GraspTarget | None = None  # newest target of that kind
    grasp_target_age_s: float = float("inf")
    arm_setpoint: ArmSetpoint | None = None  # newest that has not timed out
    ground_age_s: float = float("inf")  # since the newest heartbeat of a station that may command
    calibration: Calibration = Calibration()
    workshop: Workshop | None = None
    gripper: GripperState | None = None  # None: the arm has none


@dataclass(frozen=True)
class TensionEstimate:
    """Tension of one tendon from load and statics together."""

    tension: float  # N
    sigma: float  # N


@dataclass(frozen=True)
class Commands:
    """Everything that one step asks for."""

    arm: ArmAction
    pulls: tuple[float, ...] | None  # m, goal of each tendon with DRIVE and WIND
    setpoint: Setpoint | None  # None: send none, the pilot has the vehicle
    answers: tuple[Answer, ...]
    notices: tuple[Notice, ...]
    status: StatusReport
    wrench: WrenchReport
    recover: bool = False  # reboot and home the servos that need it: a person sees the arm hang straight
    tensions: tuple[TensionEstimate, ...] = ()  # of each tendon by load and statics, for people to see
    # follows from what is recorded, and is large
    stiffness: StiffnessReport | None = field(default=None, compare=False, metadata=UNRECORDED)
    payload: PayloadReport | None = None
    # store them and take them into use; the notices of this cycle have them for the record
    zeros: tuple[Zero, ...] = field(default=(), compare=False, metadata=UNRECORDED)
    gripper: GripperOrder | None = None  # where its jaws are to be; None: they stay as they are
