"""What the 3-D panel shows, as Foxglove's scene: vehicle, arm, bar, and the predicted wrench as arrows.

Frames: `map` is east-north-up as Foxglove likes it, `world` our north-east-down, `body` the airframe (FRD), `arm_base`
the arm's. `vehicle` is where the airframe is, but upright as the map: a camera that follows `body` itself keeps its
orientation, and shows everything upside down. All that is drawn stands in `body`, and goes away a second after the
last message.
"""

import math
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    SpherePrimitive,
    Timestamp,
    Vector3,
)

Vector: TypeAlias = Sequence[float]

_LIFETIME: Final = Duration(sec=1, nsec=0)
_METRES_PER_N: Final = 0.06
_METRES_PER_NM: Final = 0.3
_ROTORS: Final = ((0.17, 0.17), (0.17, -0.17), (-0.17, 0.17), (-0.17, -0.17))
_BAR_LENGTH: Final = 1.5
_GREY: Final = Color(r=0.45, g=0.48, b=0.52, a=1.0)
_PALE: Final = Color(r=0.45, g=0.48, b=0.52, a=0.35)
_BLUE: Final = Color(r=0.18, g=0.45, b=0.85, a=1.0)
_DISK: Final = Color(r=0.18, g=0.45, b=0.85, a=0.3)
_CONE_HEIGHT: Final = 0.25
_CONE_RADIUS: Final = 0.4
_FORBIDDEN: Final = Color(r=0.85, g=0.15, b=0.12, a=0.12)
_BROWN: Final = Color(r=0.65, g=0.42, b=0.15, a=1.0)
_RED: Final = Color(r=0.85, g=0.15, b=0.12, a=1.0)
_VIOLET: Final = Color(r=0.6, g=0.25, b=0.8, a=1.0)
# 180 degrees about north-east: swaps north and east, and turns down up
_MAP_WORLD: Final = Quaternion(w=0.0, x=math.sqrt(0.5), y=math.sqrt(0.5), z=0.0)
_UPRIGHT: Final = Quaternion(w=1.0, x=0.0, y=0.0, z=0.0)


def turn_to(axis: Vector, direction: Vector) -> tuple[float, float, float, float]:
    """The quaternion (w, x, y, z) of the shortest turn from `axis` to `direction`, both unit vectors (3,)."""
    dot = sum(a * b for a, b in zip(axis, direction, strict=True))
    x = axis[1] * direction[2] - axis[2] * direction[1]
    y = axis[2] * direction[0] - axis[0] * direction[2]
    z = axis[0] * direction[1] - axis[1] * direction[0]
    w = 1.0 + dot
    if w < 1e-9:  # opposite: half a turn about anything across
        x, y, z = (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0)
        w = 0.0
    length = math.sqrt(w * w + x * x + y * y + z * z)
    return w / length, x / length, y / length, z / length


def transforms(ns: int, table: dict[str, Any]) -> FrameTransforms:
    """Where the frames stand; the vehicle's only while its state is fresh."""
    frames = [("map", "world", (0.0, 0.0, 0.0), _MAP_WORLD)]
    if table["fresh"]:
        north, east, down = table["position_w"]
        frames.append(("world", "body", (north, east, down), _quaternion(table["attitude_wb"])))
        frames.append(("map", "vehicle", (east, north, -down), _UPRIGHT))
    frames.append(("body", "arm_base", table["mount"], _quaternion(table["mount_attitude"])))
    return FrameTransforms(
        transforms=[
            FrameTransform(
                timestamp=_stamp(ns),
                parent_frame_id=parent,
                child_frame_id=child,
                translation=_vector(place),
                rotation=turn,
            )
            for parent, child, place, turn in frames
        ]
    )


def scene(ns: int, table: dict[str, Any]) -> SceneUpdate:
    """What is drawn, of the table that `live.feed` makes."""
    entities = [_vehicle(ns, table["mount"]), _arm(ns, table["backbone"], table["disk_radius"])]
    if table["bar"] is not None:
        entities.append(_bar(ns, table["bar"]))
    if table["keep_out"] is not None:
        entities.append(_keep_out(ns, table["keep_out"]))
    if table["force"] is not None:
        entities.append(_wrench(ns, table["force"], table["torque"]))
    return SceneUpdate(entities=entities)


def _vehicle(ns: int, mount: Vector) -> SceneEntity:
    ends = [(x, y, 0.0) for x, y in _ROTORS] + [mount]
    spokes = [Point3(x=s * x, y=s * y, z=s * z) for x, y, z in ends for s in (0.0, 1.0)]
    line = LinePrimitive(type=LinePrimitiveLineType.LineList, thickness=0.015, points=spokes, color=_GREY)
    rotors = [
        CylinderPrimitive(
            pose=_pose((x, y, -0.03)), size=Vector3(x=0.2, y=0.2, z=0.005), bottom_scale=1.0, top_scale=1.0, color=_PALE
        )
        for x, y in _ROTORS
    ]
    hull = CubePrimitive(pose=_pose((0.0, 0.0, 0.0)), size=Vector3(x=0.12, y=0.08, z=0.05), color=_PALE)
    return _entity(ns, "vehicle", lines=[line], cylinders=rotors, cubes=[hull])


def _arm(ns: int, backbone: Sequence[Vector], disk_radius: float) -> SceneEntity:
    points = [Point3(x=x, y=y, z=z) for x, y, z in backbone]
    line = LinePrimitive(type=LinePrimitiveLineType.LineStrip, thickness=0.012, points=points, color=_BLUE)
    width = 2 * disk_radius
    disks = [
        SpherePrimitive(pose=_pose(point), size=Vector3(x=width, y=width, z=width), color=_DISK) for point in backbone
    ]
    return _entity(ns, "arm", lines=[line], spheres=disks)


def _bar(ns: int, bar: dict[str, Any]) -> SceneEntity:
    width = 2 * bar["radius"]
    cylinder = CylinderPrimitive(
        pose=_pose(bar["point_b"], turn_to((0.0, 0.0, 1.0), bar["axis_b"])),
        size=Vector3(x=width, y=width, z=_BAR_LENGTH),
        bottom_scale=1.0,
        top_scale=1.0,
        color=_BROWN,
    )
    return _entity(ns, "bar", cylinders=[cylinder])


def _keep_out(ns: int, cone: dict[str, Any]) -> SceneEntity:
    """The cone as far as it hides the airframe; it has no end."""
    slope = math.tan(cone["half_angle"])
    height = min(_CONE_HEIGHT, _CONE_RADIUS / slope)
    radius = height * slope
    middle = [p + 0.5 * height * a for p, a in zip(cone["apex"], cone["axis"], strict=True)]
    cylinder = CylinderPrimitive(
        pose=_pose(middle, turn_to((0.0, 0.0, 1.0), cone["axis"])),
        size=Vector3(x=2 * radius, y=2 * radius, z=height),
        bottom_scale=0.0,
        top_scale=1.0,
        color=_FORBIDDEN,
    )
    return _entity(ns, "keep-out", cylinders=[cylinder])


def _wrench(ns: int, force: Vector, torque: Vector) -> SceneEntity:
    arrows = [
        _arrow(vector, scale, colour)
        for vector, scale, colour in ((force, _METRES_PER_N, _RED), (torque, _METRES_PER_NM, _VIOLET))
        if math.hypot(*vector) * scale > 1e-3
    ]
    return _entity(ns, "wrench", arrows=arrows)


def _arrow(vector: Vector, scale: float, colour: Color) -> ArrowPrimitive:
    length = math.hypot(*vector)
    direction = [x / length for x in vector]
    reach = scale * length
    head = min(0.04, 0.4 * reach)
    return ArrowPrimitive(
        pose=_pose((0.0, 0.0, 0.0), turn_to((1.0, 0.0, 0.0), direction)),
        shaft_length=reach - head,
        shaft_diameter=0.012,
        head_length=head,
        head_diameter=0.028,
        color=colour,
    )


def _entity(ns: int, name: str, **parts: Any) -> SceneEntity:
    return SceneEntity(timestamp=_stamp(ns), frame_id="body", id=name, lifetime=_LIFETIME, frame_locked=True, **parts)


def _pose(place: Vector, turn: Vector = (1.0, 0.0, 0.0, 0.0)) -> Pose:
    return Pose(position=_vector(place), orientation=_quaternion(turn))


def _vector(v: Vector) -> Vector3:
    return Vector3(x=v[0], y=v[1], z=v[2])


def _quaternion(q: Vector) -> Quaternion:
    return Quaternion(w=q[0], x=q[1], y=q[2], z=q[3])


def _stamp(ns: int) -> Timestamp:
    return Timestamp(sec=ns // 10**9, nsec=ns % 10**9)
