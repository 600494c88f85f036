"""Controllers of episodes read and command turrets as hosts do."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS

from khep_twin import (
    Episode,
    EpisodeOptions,
    EpisodeSetup,
    Function,
    Khepera,
    Network,
    NetworkController,
    Playpen,
    Policy,
    TwinOptions,
    World,
    open_twin,
    rollout,
)
from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.lab.experiment import run
from khep_twin.ports import Serial

START, SECONDS, N_CYCLES = (358.0, 251.0, 0.0), 2.0, 20
TERMS, COMMANDS = ("gripper_barrier", "gripper_arm"), ("gripper_arm", "gripper_fingers")
SETUP = EpisodeSetup(Playpen.load("gripper"), period_ns=100_000_000)


def decide(barrier: float, arm: float) -> tuple[float, float, float, float]:
    """Lower the arm, drive until the barrier is dark, and close the fingers."""
    speed = 2.0 if arm > 240 and barrier <= 200 else 0.0
    return speed, speed, 255.0, 0.0 if barrier > 200 else 200.0


def one_robot(
    proximity: Any, ambient: Any, memory: Any, genes: Any, barrier: Any, arm: Any
) -> tuple[float, float, float, float]:
    speed = 2.0 if arm[0] > 240 and barrier[0] <= 200 else 0.0
    return speed, speed, 255.0, 0.0 if barrier[0] > 200 else 200.0


def many_robots(proximity: Any, ambient: Any, which: Any, barrier: Any, arm: Any) -> list[tuple[float, ...]]:
    return [decide(*values) for values in zip(barrier[:, 0], arm[:, 0], strict=True)]


def by_the_line() -> World:
    """A run of the same controller as a host, on a line without delay."""
    world = World(SETUP.playpen, seed=4, unpaced=True)
    world.reset(4, starts=[START])
    firmware = world.robots[0].firmware
    for cycle in range(N_CYCLES):
        barrier, arm = (int(firmware.receive(b"T,1,%s\n" % word).split(b",")[-1]) for word in (b"G", b"H,1"))
        left, right, height, gap = decide(barrier, arm)
        firmware.receive(b"T,1,E,%d\nT,1,D,%d\nD,%d,%d\n" % (height, gap < 100, left, right))
        world.advance_to((cycle + 1) * SETUP.period_ns)
    return world


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
def test_a_function_grips_as_a_host_does(compiled: bool) -> None:
    world = by_the_line()
    episode = Episode(SETUP, Function(one_robot, terms=TERMS, commands=COMMANDS), compiled=compiled)
    for seconds in (0.5, SECONDS):  # the second one does not depend on the first
        episode.begin(4, EpisodeOptions(start=START))
        episode.run(seconds)
    assert episode.joints.tobytes() == world.data.qpos.tobytes()
    gripper = next(iter(world.robots[0].firmware.turrets.values())).registers
    assert gripper[5] in range(60, 110)  # the fingers hold the cylinder
    assert episode.readings()[2:] == ([gripper[6]], [gripper[2]])


def test_a_policy_grips_as_a_function_does() -> None:
    results = [
        rollout(SETUP, driver, [4, 5], 1.0, starts=[START] * 2, compiled=False)
        for driver in (
            Function(one_robot, terms=TERMS, commands=COMMANDS),
            Policy(many_robots, terms=TERMS, commands=COMMANDS),
        )
    ]
    function, policy = results
    assert function.registers.tolist() == policy.registers.tolist()
    assert function.objects.tobytes() == policy.objects.tobytes()


def test_a_network_grips_at_a_port_as_in_a_rollout(tmp_path: Path) -> None:
    network = Network(terms=TERMS, commands=COMMANDS, top_speed=2, period_ns=SETUP.period_ns)
    assert network.sizes == (10, 4)
    weights = np.zeros((4, 11))  # of the bias, proximity, barrier and arm
    weights[:2, [0, 9, 10]] = -9, -50, 10  # drive with the arm down and a free barrier
    weights[2, 0], weights[3, [0, 9]] = 9, (9, -20)
    network.save(tmp_path / "grip.npz", weights.ravel(), setup=SETUP)
    network = Network.load(tmp_path / "grip.npz")
    assert (network.terms, network.commands) == (TERMS, COMMANDS)
    poses = rollout(SETUP, network, [4], 1.0, compiled=False).poses
    twin = open_twin(SETUP.playpen, TwinOptions(seed=4, unpaced=True))
    requests: list[str] = []
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        robot.listen(lambda request, reply: requests.append(request))
        run(NetworkController(network), robot, cycles=10)
        assert twin.world.poses[0] == pytest.approx(poses[0], abs=0)
    assert requests[:7] == ["T,1,B", "N", "T,1,G", "T,1,H,1", "T,1,E,255", "T,1,D,0", "D,-2,-2"]
    assert "T,1,E,255" not in requests[7:]  # an order is given once
    with Khepera("khep://default") as robot, pytest.raises(KhepTwinError, match="Turret order not supported"):
        run(NetworkController(network), robot, cycles=1)


NETWORK = Network(terms=TERMS, genes=np.zeros(22))


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (
            lambda: rollout("default", NETWORK, [0], 1.0),
            "default: gripper_barrier: no gripper; expected robots w",
        ),
        (
            lambda: rollout("default", NETWORK, [0], 1.0, planar=True),
            "no gripper; .*with a gripper, in MuJoCo and",
        ),
        (
            lambda: rollout("gripper", NETWORK, [0], 1.0, planar=True),
            "turrets = .'gripper'.; expected none in the",
        ),
        (
            lambda: rollout("gripper", NETWORK, [0], 1.0, line=9600),
            "the gripper at a line of 9600; expected robots",
        ),
        (
            lambda: rollout("gripper", NETWORK, [0], 1.0, device="cuda"),
            "episodes in MuJoCo with a gripper; expect",
        ),
        (
            lambda: Network(commands=("gripper_barrier",)),
            "command 'gripper_barrier': unknown; .*gripper_fingers, g",
        ),
        (
            lambda: Network(commands=("gripper_arm",), model="khepera4"),
            "'gripper_arm': unknown; expected two speeds",
        ),
    ],
)
def test_episodes_that_cannot_have_the_gripper_name_it(attempt: Callable[[], object], message: str) -> None:
    with pytest.raises(KhepTwinError, match=message) as caught:
        attempt()
    assert "\n" not in str(caught.value)


def test_a_file_with_an_unknown_command_is_refused(tmp_path: Path) -> None:
    Network(commands=("gripper_arm",)).save(tmp_path / "grip.npz", [0.0] * 27)
    with np.load(tmp_path / "grip.npz") as file:
        arrays = dict(file)
    np.savez(tmp_path / "other.npz", **arrays | {"commands": np.array(["gripper_leg"])})
    with pytest.raises(ControllerError, match=r"other.npz: .*command 'gripper_leg': unknown; did you mean"):
        Network.load(tmp_path / "other.npz")
