"""Motion of a robot in a plane: two motors, and tyres without slip.

All constants are those of the scene from `playpen_to_mjcf`. Motion is integrated as by MuJoCo's implicit
integrator, in substeps of 2.5 ms, one or more per step:

    J w' = K (V - K w) / R - T - r F      each wheel, w its speed, F the force of its tyre on the floor
    m v' = F_left + F_right + walls       and likewise about the vertical axis

T is the gear's dry friction, against the speed; a wheel stands still while the torque that drives it is
smaller. Without slip or a change of direction of a wheel, translation and rotation are two first-order lags
in closed form. Wheels of different radii use the mean radius there. `contact_solver` handles other cases.
"""

import math

from khep_twin.compilable import compilable, compilable_once
from khep_twin.episodes.planar import contact_solver
from khep_twin.episodes.planar import plane as planar
from khep_twin.episodes.planar.plane import (
    ANCHOR_DISTANCE,
    CENTRE_X,
    CENTRE_Y,
    DISTANCE,
    LEFT_ANGLE,
    N_NEAR,
    RIGHT_ANGLE,
    PlanarRobot,
    Plane,
    X,
    Y,
)

_ANCHOR_RANGE = 0.02
"""Distance from the anchor at which the distances to all obstacles are measured again [m]."""


@compilable_once
def step(plane: Plane) -> None:
    """Advance by one step (all its substeps) at the present motor voltages."""
    robot = plane.robot
    joints, speeds, last = robot.joints, robot.speeds, robot.last_step
    locate(plane)
    x, y, heading = joints[X], joints[Y], joints[planar.HEADING]
    c, s = last[planar.HEADING_COSINE], last[planar.HEADING_SINE]
    robot.force[0] = robot.stall_torque * robot.ctrl[0] - robot.damping * speeds[LEFT_ANGLE]
    robot.force[1] = robot.stall_torque * robot.ctrl[1] - robot.damping * speeds[RIGHT_ANGLE]
    left, right = robot.left_wheel * speeds[LEFT_ANGLE], robot.right_wheel * speeds[RIGHT_ANGLE]
    left_direction = _wheel_direction(left, robot.ctrl[0], robot)
    right_direction = _wheel_direction(right, robot.ctrl[1], robot)
    if left_direction == 0.0 and right_direction == 0.0 and last[planar.SLIPS] == 0:
        # Both gears hold; a remaining speed is the solver's residual.
        for i in range(len(speeds)):
            speeds[i] = 0.0
        return
    left_target = robot.left_free_speed * (robot.ctrl[0] - left_direction * robot.dead_voltage)
    right_target = robot.right_free_speed * (robot.ctrl[1] - right_direction * robot.dead_voltage)
    linear, angular = (left + right) / 2, (right - left) / 2
    linear_target, angular_target = (left_target + right_target) / 2, (right_target - left_target) / 2
    n_substeps, h = robot.n_substeps, robot.substep
    # The first substep needs the largest tyre force.
    acceleration = (linear_target - linear) * (1 - robot.linear_decay) / h
    angular_acceleration = (angular_target - angular) * (1 - robot.angular_decay) / h
    turn_per_path = 2 / robot.track
    tyre_force = abs(robot.mass * acceleration) / 2
    tyre_force += abs(robot.inertia * angular_acceleration) * turn_per_path * turn_per_path / 2
    tyre_force += abs(robot.mass * linear * angular) * turn_per_path / 2
    pitch_moment = abs(robot.weight_moment + robot.mass * robot.pitch_arm * acceleration)
    max_travel = max(abs(linear), abs(linear_target)) * h * n_substeps
    max_force = (robot.tyre_force - robot.pitch_relief * pitch_moment) * min(
        robot.left_grip, robot.right_grip
    )
    if (
        last[planar.SLIPS] != 0
        or left_direction * right_direction == 0.0
        or tyre_force > max_force
        or not _is_clear(plane, robot.radius + max_travel)
    ):
        contact_solver.step_with_slip(plane)
        return
    left_path = right_path = 0.0
    for _ in range(n_substeps):
        linear = linear_target + (linear - linear_target) * robot.linear_decay
        angular = angular_target + (angular - angular_target) * robot.angular_decay
        # Positions are integrated with the new speeds along the old heading, as in MuJoCo.
        x += h * linear * c
        y += h * linear * s
        left_path += linear - angular
        right_path += linear + angular
        turn = h * angular * turn_per_path
        heading += turn
        turn_c, turn_s = planar.turn_vector(turn)
        c, s = c * turn_c - s * turn_s, s * turn_c + c * turn_s
    if (linear - angular) * left_direction < 0 or (linear + angular) * right_direction < 0:
        # A wheel stops within the step.
        contact_solver.step_with_slip(plane)
        return
    joints[X], joints[Y] = x, y
    planar.set_heading(robot, heading, c, s)
    joints[LEFT_ANGLE] += left_path * h / robot.left_wheel
    joints[RIGHT_ANGLE] += right_path * h / robot.right_wheel
    speeds[0], speeds[1], speeds[2] = linear, 0.0, angular * turn_per_path
    speeds[LEFT_ANGLE] = (linear - angular) / robot.left_wheel
    speeds[RIGHT_ANGLE] = (linear + angular) / robot.right_wheel


@compilable
def locate(plane: Plane) -> None:
    """Set the pose of the sensors, and the obstacles around it, to the present."""
    joints, last = plane.robot.joints, plane.robot.last_step
    x, y = joints[X], joints[Y]
    c, s = planar.direction(plane.robot)
    (last[CENTRE_X], last[CENTRE_Y], last[planar.HEADING_COSINE], last[planar.HEADING_SINE]) = (x, y, c, s)
    dx, dy = x - last[planar.ANCHOR_X], y - last[planar.ANCHOR_Y]
    last[ANCHOR_DISTANCE] = math.sqrt(dx * dx + dy * dy)
    if last[ANCHOR_DISTANCE] > _ANCHOR_RANGE:
        measure_distances(plane)
    find_near(plane)


@compilable
def _wheel_direction(speed: float, voltage: float, robot: PlanarRobot) -> float:
    """Return the direction in which a wheel turns or starts to turn, 1 or -1; 0 if its gear holds it."""
    if abs(speed) > contact_solver.STOP_SPEED:
        return math.copysign(1.0, speed)
    return math.copysign(1.0, voltage) if abs(voltage) > robot.dead_voltage else 0.0


@compilable
def measure_distances(plane: Plane) -> None:
    """Set the anchor to the position before the last step; measure and sort the obstacles' distances."""
    last, order, obstacles = plane.robot.last_step, plane.fixed_by_distance, plane.obstacles
    x, y = last[CENTRE_X], last[CENTRE_Y]
    last[planar.ANCHOR_X], last[planar.ANCHOR_Y], last[ANCHOR_DISTANCE] = x, y, 0.0
    for i in range(len(order)):
        # Insertion sort, as the order changes little.
        obstacle, rank = order[i], i
        distance = planar.distance_to(obstacles, obstacle, x, y)
        obstacles[obstacle, DISTANCE] = distance
        while rank > 0 and obstacles[order[rank - 1], DISTANCE] > distance:
            order[rank] = order[rank - 1]
            rank -= 1
        order[rank] = obstacle


@compilable
def find_near(plane: Plane) -> None:
    """Fill in the obstacles in sensor range at the start of the last step."""
    obstacles, order, last = plane.obstacles, plane.fixed_by_distance, plane.robot.last_step
    last[N_NEAR], last[planar.NEAREST] = 0.0, math.inf
    for i in range(len(order)):
        if obstacles[order[i], DISTANCE] > plane.robot.sensor_range + last[ANCHOR_DISTANCE]:
            break
        _add_if_near(plane, order[i])
    for obstacle in range(len(order), len(obstacles)):
        _add_if_near(plane, obstacle)


@compilable
def _add_if_near(plane: Plane, obstacle: int) -> None:
    """Add an obstacle to the near ones if it is in sensor range."""
    obstacles, near, last = plane.obstacles, plane.near, plane.robot.last_step
    c, s, row = (last[planar.HEADING_COSINE], last[planar.HEADING_SINE], int(last[N_NEAR]))
    dx, dy = (obstacles[obstacle, CENTRE_X] - last[CENTRE_X], obstacles[obstacle, CENTRE_Y] - last[CENTRE_Y])
    near[row, CENTRE_X], near[row, CENTRE_Y] = dx * c + dy * s, dy * c - dx * s
    cosine, sine = obstacles[obstacle, planar.COSINE], obstacles[obstacle, planar.SINE]
    near[row, planar.COSINE], near[row, planar.SINE] = cosine * c + sine * s, sine * c - cosine * s
    for column in range(planar.HALF_LENGTH, planar.REFLECTANCE + 1):
        near[row, column] = obstacles[obstacle, column]
    near[row, DISTANCE] = distance = planar.distance_to(near, row, 0.0, 0.0)
    last[planar.NEAREST] = min(last[planar.NEAREST], distance)
    if distance <= plane.robot.sensor_range:
        last[N_NEAR] = row + 1


@compilable
def _is_clear(plane: Plane, reach: float) -> bool:
    """Return whether no obstacle that can be touched was within reach [m] at the start of the step."""
    near = plane.near
    for i in range(int(plane.robot.last_step[N_NEAR])):
        if near[i, planar.TOUCHABLE] and near[i, DISTANCE] <= reach:
            return False
    return reach <= plane.robot.sensor_range
