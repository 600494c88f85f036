"""Ten short examples, each a function of a few lines that runs alone.

python examples/00_first_lines.py                all of them, in a folder that is removed afterwards
python examples/00_first_lines.py learn read     some of them
"""

import os
import sys
import tempfile
import threading

import numpy as np
import serial

import khep_twin


def drive():
    """Drive a robot: this one is simulated, "/dev/ttyUSB0" is one on a cable."""
    with khep_twin.Khepera("khep://obstacles?seed=1") as robot:
        robot.set_speed(10, 10)
        while max(robot.proximity()) < 500:
            pass
        print("something is near:", robot.proximity())


def talk():
    """Send and receive bytes, as host programs in any language do."""
    with serial.serial_for_url("khep://obstacles", baudrate=9600, timeout=1) as port:
        port.write(b"N\n")
        print("answer to N:", port.readline().decode().strip())


def carry():
    """Use a turret."""
    with khep_twin.Khepera("khep://gripper") as robot:
        gripper = khep_twin.Gripper(robot)
        gripper.lower()
        gripper.wait()
        print("light barrier:", gripper.barrier())


def simulate():
    """Advance a world; it has MuJoCo's model and data."""
    world = khep_twin.World("obstacles", seed=1)
    world.robots[0].send(b"D,10,10\n")
    world.advance(2.0)
    print(f"at {world.data.time:.2f} s: {np.round(world.robots[0].pose, 3)}")


def change():
    """Change a playpen, and draw it."""
    playpen = khep_twin.Playpen.load("two-lamps")
    dark = playpen.model_copy(update={"lamps": ()})
    world = khep_twin.World(dark, noise=False)
    print("light in the dark:", world.robots[0].registers[khep_twin.board.AMBIENT])
    khep_twin.drawing.save(khep_twin.drawing.draw(playpen), "two-lamps.png")


def evaluate():
    """Run many episodes in one call, without a serial line."""
    results = khep_twin.rollout("obstacles", khep_twin.Braitenberg(), seeds=range(8), seconds=60)
    print("fitness:", results.metrics["obstacle_avoidance"].round(3))


def evolve():
    """Select the best of some networks."""
    network = khep_twin.Network(hidden=(5,))
    genes = np.random.default_rng(0).normal(size=(20, network.n_genes))
    results = khep_twin.rollout("looping-maze", network, seeds=range(20), seconds=10, genes=genes)
    print("best network:", results.metrics["obstacle_avoidance"].argmax())


def learn():
    """Step a Gymnasium environment."""
    environment = khep_twin.make("khep_twin/ObstacleAvoidance-v0", vary=True)
    observation, _ = environment.reset(seed=1)
    observation, reward, *_ = environment.step([0.5, 0.5])
    print(f"{len(observation)} numbers observed, reward {reward:.3f}")


def read():
    """Read the log of a run."""
    with khep_twin.Khepera("khep://obstacles?log=run.mcap") as robot:
        robot.set_speed(5, 5)
        robot.sleep(2)
    track = khep_twin.read_log("run.mcap").robots["khepera0"]
    print(f"{len(track.times_ns)} samples, at the end {track.pose[-1].round(3)}")


def test():
    """Serve a twin to a program under test, in real time."""
    stop_event = threading.Event()
    with khep_twin.open_twin("obstacles") as twin, khep_twin.ports.PtyPort() as port:
        thread = threading.Thread(
            target=khep_twin.serve, args=(twin, [port]), kwargs={"stop": stop_event.is_set}
        )
        thread.start()
        try:
            with khep_twin.Khepera(port.path) as robot:  # or any other program that opens this path
                print("served robot's firmware:", robot.versions())
        finally:
            stop_event.set()
            thread.join()


EXAMPLES = [drive, talk, carry, simulate, change, evaluate, evolve, learn, read, test]

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for example in EXAMPLES:
            if len(sys.argv) == 1 or example.__name__ in sys.argv[1:]:
                print(f"{example.__name__}: ", end="", flush=True)
                example()
        os.chdir("/")
