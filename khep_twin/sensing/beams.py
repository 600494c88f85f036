"""Level rays from a place on a robot, for example of an ultrasonic sensor with a narrow beam."""

from math import cos, sin

from khep_twin.compilable import compilable
from khep_twin.sensing.robot_sensors import RobotSensors
from khep_twin.sensing.scene import Beams, BeamScene, body_frame, cast_rays, joint_position


@compilable
def cast_level_ray(
    scene: BeamScene,
    sensors: RobotSensors,
    beams: Beams,
    pose: int,
    place: tuple[float, float, float, float],
    reach: float,
) -> float:
    """Return the distance of the nearest obstacle along a ray [m], below 0 without one.

    Args:
        scene: Scene of the robot.
        sensors: Sensors of the robot.
        beams: Buffers for one ray.
        pose: Index of the robot's pose.
        place: Start x, y, z [m] and heading [rad] on the robot, as in `SonarRing.places`.
        reach: Longest distance [m].
    """
    frame, (x, y, z, heading) = body_frame(scene, sensors), place
    for axis in range(3):
        beams.vectors[axis] = frame[3 * axis] * cos(heading) + frame[3 * axis + 1] * sin(heading)
    start_x = joint_position(scene, pose) + frame[0] * x + frame[1] * y
    start_y = joint_position(scene, pose + 1) + frame[3] * x + frame[4] * y
    cast_rays(scene, sensors, beams, (start_x, start_y, z), reach)
    return beams.lengths[0]
