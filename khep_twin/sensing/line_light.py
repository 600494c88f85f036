"""Illuminance around a line camera: by the room and by lamps, with hard shadows.

    illuminance = room + sum over lamps of v intensity cos / distance^2 [lx]

with v = 0 in the shadow of a face, otherwise 1. Light reflected from one surface onto another is ignored.
"""

import math

from khep_twin.compilable import compilable
from khep_twin.sensing.line_scene import (
    BOTTOM,
    CASTS_SHADOW,
    END_X,
    END_Y,
    RADIUS,
    ROLE,
    SAME_ROBOT,
    TOP,
    Eye,
    LineScene,
    X,
    Y,
)
from khep_twin.units import BULB_RADIUS

EFFICACY = 12.0
"""Luminous flux of a lamp per power [lm/W] (assumed: a light bulb)."""

INTENSITY = EFFICACY / (4 * math.pi)
"""Luminous intensity of a lamp per power, the same in all directions [cd/W]."""

BULB_LUMINANCE = INTENSITY / (math.pi * BULB_RADIUS * BULB_RADIUS)
"""Luminance of a lamp per power [cd/(m^2 W)]."""

_MIN_DISTANCE = 1e-4


@compilable
def illuminance(scene: LineScene, eye: Eye) -> float:
    """Return the illuminance at the camera, with equal weight for all directions [lx]."""
    total, lamps = scene.room_lux[0], scene.lamps
    for lamp in range(len(lamps)):
        if lamps[lamp, 3] > 0 and not in_shadow(scene, lamp, eye.x, eye.y, eye.height, SAME_ROBOT):
            dx, dy, dz = lamps[lamp, 0] - eye.x, lamps[lamp, 1] - eye.y, lamps[lamp, 2] - eye.height
            total += INTENSITY * lamps[lamp, 3] / max(dx * dx + dy * dy + dz * dz, BULB_RADIUS * BULB_RADIUS)
    return total


@compilable
def in_shadow(scene: LineScene, lamp: int, x: float, y: float, height: float, excluded_roles: int) -> bool:
    """Return whether a face with none of the excluded roles blocks a lamp's light to a point [m]."""
    faces, lamps = scene.faces, scene.lamps
    dx, dy, dz = lamps[lamp, 0] - x, lamps[lamp, 1] - y, lamps[lamp, 2] - height
    length = math.sqrt(dx * dx + dy * dy)
    if length <= _MIN_DISTANCE:
        return False
    min_hit, max_hit = _MIN_DISTANCE / length, 1.0
    for face in range(scene.n_faces[0]):
        role = int(faces[face, ROLE])
        if role & CASTS_SHADOW == 0 or role & excluded_roles:
            continue
        offset_x, offset_y = faces[face, X] - x, faces[face, Y] - y
        radius = faces[face, RADIUS]
        if radius > 0:
            along, across = (offset_x * dx + offset_y * dy) / length, (offset_y * dx - offset_x * dy) / length
            if abs(across) >= radius:
                continue
            half_chord = math.sqrt(radius * radius - across * across)
            hits = (along - half_chord) / length, (along + half_chord) / length
        else:
            face_x, face_y = faces[face, END_X] - faces[face, X], faces[face, END_Y] - faces[face, Y]
            cross = dx * face_y - dy * face_x
            if cross == 0:
                continue
            face_fraction = (offset_x * dy - offset_y * dx) / cross
            if face_fraction < 0 or face_fraction > 1:
                continue
            hits = (offset_x * face_y - offset_y * face_x) / cross, -1.0
        for hit in hits:
            if min_hit < hit < max_hit and faces[face, BOTTOM] <= height + hit * dz <= faces[face, TOP]:
                return True
    return False


@compilable
def face_illuminance(scene: LineScene, face: int, x: float, y: float, height: float) -> float:
    """Return the illuminance of a point of a face, by the lamps in `visible_lamps` [lx]."""
    faces, lamps, total = scene.faces, scene.lamps, scene.room_lux[0]
    if faces[face, RADIUS] > 0:
        normal_x, normal_y = x - faces[face, X], y - faces[face, Y]
    else:
        normal_x, normal_y = faces[face, END_Y] - faces[face, Y], faces[face, X] - faces[face, END_X]
    length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
    for lamp in range(len(lamps)):
        if scene.visible_lamps[lamp] == 0:
            continue
        dx, dy, dz = lamps[lamp, 0] - x, lamps[lamp, 1] - y, lamps[lamp, 2] - height
        facing = (normal_x * dx + normal_y * dy) / length
        if facing > 0:
            square = max(dx * dx + dy * dy + dz * dz, BULB_RADIUS * BULB_RADIUS)
            total += INTENSITY * lamps[lamp, 3] * facing / (square * math.sqrt(square))
    return total
