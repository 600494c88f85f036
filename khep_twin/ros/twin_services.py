"""Services of a node for a twin in this process: pose, lamps, steps."""

import math

from khep_twin.errors import KhepTwinError
from khep_twin.interventions.move_robot import place_robot
from khep_twin.interventions.switching import switch
from khep_twin.log.channels import MAP
from khep_twin.log.message_types import Message
from khep_twin.ros.graph import Node
from khep_twin.ros.robot_node import ANSWER_LIMIT, TRIGGER, await_outcome
from khep_twin.ros.twin_time import TwinTime
from khep_twin.world import World

POSE, SET_BOOL = "geometry_msgs/msg/PoseWithCovarianceStamped", "std_srvs/srv/SetBool"


class TwinServices:
    """Subscription `set_pose`, and the services `lamps` (with lamps) and `step` (of a paused twin) of a node.

    Args:
        node: Node of the robot.
        time: Time of its twin.
        world: World of the twin.
        robot: Number of the robot in the playpen.
        is_paused: True if time passes in steps only.
    """

    def __init__(self, node: Node, time: TwinTime, world: World, robot: int, *, is_paused: bool) -> None:
        self._node, self._time, self._world, self._robot = node, time, world, robot
        node.subscribe("~/set_pose", (POSE,), self._on_pose)
        if world.lamps.names:
            node.serve("~/lamps", SET_BOOL, self._on_lamps)
        if is_paused:
            node.serve("~/step", TRIGGER, self._on_step)

    def _on_pose(self, _: str, message: Message) -> None:
        """Move the robot; a pose without room is reported, once for each reason."""
        frame, pose = message["header"]["frame_id"], message["pose"]["pose"]
        position, rotation = pose["position"], pose["orientation"]
        x, y, z, w = (rotation[axis] for axis in "xyzw")
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        arguments = position["x"] * 1e3, position["y"] * 1e3, math.degrees(heading)
        try:
            if frame.removeprefix("/") not in ("", MAP):
                raise KhepTwinError(f"a pose in frame {frame!r}; expected {MAP!r}")
            move = self._time.request(lambda: place_robot(self._world, self._robot, *arguments))
            move.result(ANSWER_LIMIT)
        except (KhepTwinError, TimeoutError) as error:
            text = f"set_pose: {error or 'the twin did not reply'}"
            self._node.report_once(text, text)

    def _on_lamps(self, request: Message) -> Message:
        def switch_all() -> None:
            for lamp in range(len(self._world.lamps.names)):
                switch(self._world, lamp, bool(request["data"]))

        state = "by their schedules" if request["data"] else "off"
        return await_outcome(self._time.request(switch_all), f"the lamps are {state}")

    def _on_step(self, _: Message) -> Message:
        step = self._time.step()
        response = await_outcome(step, "")
        return (
            response
            if not response["success"]
            else {**response, "message": f"{self._world.time_ns / 1e9:g} s"}
        )
