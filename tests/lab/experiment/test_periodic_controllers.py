"""Networks as controllers of a robot on a serial line: requests, decisions and waits."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import serial
from numpy.typing import NDArray

from khep_twin import rollout
from khep_twin.clock import to_ns
from khep_twin.episodes import network_file
from khep_twin.episodes.controllers import Network
from khep_twin.errors import ControllerError
from khep_twin.host import Khepera, Khepera4
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controller_source import source_of
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.experiment.experiment import run
from khep_twin.lab.experiment.measures import HostMetrics
from khep_twin.lab.experiment.periodic_controllers import NetworkController, PeriodicController
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan
from khep_twin.robots.registry import default_model

PLAYPEN = "khep://two-lamps?seed=3&noise=on"


def expected_speeds(
    network: Network, memory: NDArray[np.float64], proximity: list[int], light: list[int]
) -> list[int]:
    """The equation of `networks`, in matrices; `memory` is changed."""
    dark, bright = network.light
    values = np.array(proximity) / 1023
    if network.ambient:
        values = np.concatenate([values, (dark - np.array(light)) / (dark - bright)])
    genes = np.array(network.genes)
    for layer, size in enumerate(network.sizes[1:]):
        feeds_back = network.recurrent and layer == 0
        inputs = np.concatenate([[1.0], values, memory]) if feeds_back else np.concatenate([[1.0], values])
        weights, genes = np.split(genes, [size * len(inputs)])
        values = np.tanh(weights.reshape(size, -1) @ inputs)
        if feeds_back:
            memory[:] = values
    return [round(network.top_speed * value) for value in values]


@pytest.mark.parametrize(
    ("network", "baud"),
    [
        (Network(hidden=(4,), recurrent=True, ambient=True), 38400),
        (Network(hidden=(4,), recurrent=True, ambient=True, period_ns=100_000_000), 9600),
        (Network(), 9600),
    ],
    ids=["fast", "slow", "late"],
)
def test_a_cycle_asks_decides_drives_and_waits_for_its_end(network: Network, baud: int) -> None:
    genes = np.random.default_rng(4).normal(size=network.n_genes)
    network = Network(
        network.hidden, network.recurrent, network.ambient, genes=genes, period_ns=network.period_ns
    )
    messages: list[tuple[str, str]] = []
    ends: list[tuple[int, int]] = []
    mode = {9600: 1, 38400: 3}[baud]
    with Khepera(f"{PLAYPEN}&mode={mode}", baudrate=baud) as robot:
        robot.listen(lambda request, reply: messages.append((request, reply)))
        start_ns = to_ns(robot.time)
        controller = NetworkController(network)
        # The second run starts without the memory of the first.
        for _ in range(2):
            run(
                controller,
                robot,
                cycles=8,
                after_cycle=lambda: ends.append((to_ns(robot.time), len(messages))),
            )
    memory, cycle = np.zeros(network.sizes[1]), 3 if network.ambient else 2
    at = 0
    for number in range(16):
        if number == 8:
            memory[:], at = 0, at + 1  # the motors were stopped
        exchanges, at = messages[at : at + cycle], at + cycle
        letters = [request[0] for request, _ in exchanges]
        assert letters == (["N", "O", "D"] if network.ambient else ["N", "D"])
        counts = [[int(word) for word in reply.split(",")[1:]] for _, reply in exchanges[:-1]]
        left, right = expected_speeds(network, memory, counts[0], counts[-1])
        assert exchanges[-1][0] == f"D,{left},{right}"
    durations = [later - earlier for earlier, later in pairwise([start_ns, *(end for end, _ in ends[:8])])]
    if baud == 38400 or network.period_ns == 100_000_000:
        assert durations[1:] == [network.period_ns] * 7  # to the nanosecond
    else:
        assert min(durations) > network.period_ns


def test_a_network_that_is_given_the_board_decides_as_in_a_rollout() -> None:
    """Speeds without a serial line equal those of the stepping core, bit for bit."""
    from khep_twin.episodes.episode import Episode
    from khep_twin.episodes.episode_options import EpisodeOptions
    from khep_twin.episodes.episode_setup import EpisodeSetup

    network = Network(hidden=(5, 3), recurrent=True, ambient=True)
    network = Network((5, 3), True, True, genes=np.random.default_rng(1).normal(size=network.n_genes))
    setup = EpisodeSetup("two-lamps")
    driven, watched = Episode(setup, network, compiled=False), Episode(setup, compiled=False)
    for episode in (driven, watched):
        episode.begin(2, EpisodeOptions(vary=True))

    class Board:
        model = default_model()

        def read_registers(self, registers: Sequence[int]) -> list[int]:
            return watched.registers[[*registers]].tolist()

    controller = NetworkController(network)
    controller.start(Board())  # type: ignore[arg-type]
    for _ in range(40):
        watched.drive(*controller.decide(Board()))  # type: ignore[arg-type]
        for episode in (driven, watched):
            episode.run(0.02)
        assert (driven.registers == watched.registers).all()


def test_a_network_drives_a_khepera_4_as_in_a_rollout() -> None:
    network = Network(model="khepera4")
    # Forwards at 200 pulses/10 ms, and more to the right with an object at the front left.
    weights = [0.3, *[0.0] * 8, 0.3, *[0.0] * 8]
    weights[1 + 2] = 0.8
    metrics = rollout("arena4", network, [1], 2.0, genes=[weights], compiled=False).metrics
    with Khepera4("khep://arena4?seed=1") as robot:
        requests: list[str] = []
        measured = HostMetrics(robot.model)
        robot.listen(lambda request, reply: (requests.append(request), measured(request, reply)))
        controller = NetworkController(replace(network, genes=weights))
        run(controller, robot, seconds=2.0, after_cycle=measured.end_cycle)
    assert requests[::2][:100] == ["N"] * 100
    fitness = metrics["obstacle_avoidance"][0]
    assert measured.metrics()["fitness"] == pytest.approx(fitness, rel=0.02)
    with (
        Khepera("khep://default") as other,
        pytest.raises(ControllerError, match="expected 'khepera' for a K"),
    ):
        run(controller, other, cycles=1)


def test_the_built_in_controller_is_the_vehicle_of_the_model() -> None:
    for robot, speeds in ((Khepera("khep://default"), "10,10"), (Khepera4("khep://arena4"), "177,170")):
        requests: list[str] = []
        robot.listen(lambda request, reply, requests=requests: requests.append(request))
        with robot:
            run(BUILT_IN["braitenberg"], robot, cycles=1)
        assert requests[:2] == ["N", f"D,{speeds}"]


def test_a_network_without_its_genes_or_with_endless_ones_is_refused() -> None:
    with pytest.raises(ControllerError, match=r"0 genes for Network\(.*; expected 18"):
        NetworkController(Network())
    endless = NetworkController(Network(genes=[1e308] * 9 + [-1e308] * 9), "best.npz")
    with Khepera(PLAYPEN) as robot:
        endless._genes[0] = math.nan
        with pytest.raises(ControllerError, match=r"best.npz: speeds nan, -20\.0; expected finite numbers"):
            run(endless, robot, cycles=1)


def test_a_file_of_a_network_is_a_controller_with_its_name_and_content(tmp_path: Path) -> None:
    Network(seed=5).save(tmp_path / "best.npz", np.arange(18.0))
    controller = find_controller(str(tmp_path / "best.npz"))
    assert isinstance(controller, NetworkController)
    source = source_of(controller)
    assert source.facts["controller"] == "best.npz"
    ((name, text),) = source.attachments.items()
    assert name == "controller/best.json"
    assert '"genes": [0.0, 1.0, 2.0' in text
    Network(seed=5).save(tmp_path / "best.npz", np.arange(1.0, 19.0))
    assert source_of(find_controller(str(tmp_path / "best.npz"))).identity != source.identity
    (tmp_path / "data.npz").write_bytes(b"PK")
    for name, message in (("bets.npz", "did you mean '.*best.npz'"), ("data.npz", "no whole NPZ file")):
        with pytest.raises(ControllerError, match=rf"{name}: cannot be read: .*{message}"):
            find_controller(str(tmp_path / name))
    assert network_file.read(tmp_path / "best.npz").seed == 5


class LatePort(serial.SerialBase):
    """A port in a fake clock's time, whose robot takes a duration for each reply."""

    name, baudrate, timeout, is_open = "late", 9600, 0.5, True

    def __init__(self, delay_ns: int) -> None:
        self.time_ns, self._delay_ns, self._reply = 0, delay_ns, b""

    def write(self, data: bytes) -> int:
        self._reply = b"n,0,0,0,0,0,0,0,0\r\n" if data == b"N\n" else data.strip()[:1].lower() + b"\r\n"
        return len(data)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        self.time_ns += self._delay_ns
        return self._reply

    def sleep(self, duration: float) -> None:
        self.time_ns += round(duration * 1e9)

    def close(self) -> None: ...


class Still(PeriodicController):
    """Controller that reads the sensors and stands still."""

    def decide(self, robot: Khepera) -> tuple[float, float]:
        robot.proximity()
        return 0.0, 0.0


class LateStart(Still):
    """Controller that waits before its first cycle."""

    def start(self, robot: Khepera) -> None:
        robot.sleep(1.0)


def test_the_time_of_cycles_excludes_the_start_of_the_controller() -> None:
    with Khepera(LatePort(1_000_000)) as robot:
        outcome = run(LateStart(40_000_000), robot, cycles=2)
        assert outcome.cycle_time == pytest.approx(0.04)
        assert outcome.duration == pytest.approx(1.08)


def test_a_run_has_the_time_of_its_cycles_and_the_expected_one() -> None:
    """The cycle of a busy machine, by a port whose fake clock adds to each reply."""
    port = LatePort(45_000_000)
    with Khepera(port) as robot:
        outcome = run(Still(40_000_000), robot, cycles=2)
        assert (outcome.cycle_time, outcome.expected_cycle_time) == pytest.approx((0.09, 0.04))
        (series,) = run_series(Still(40_000_000), OneRobot(robot), Plan(cycles=2))
        assert series.delay_text().startswith("cycles took 90 ms on average; expected 40 ms: ")
        outcome = run(lambda robot: robot.proximity(), robot, cycles=2)
        # N, its line feed, and a reply of 19 bytes.
        assert (outcome.cycle_time, outcome.expected_cycle_time) == pytest.approx((0.045, 21 * 11 / 9600))
        (series,) = run_series(Still(90_000_000), OneRobot(robot), Plan(cycles=2))
        assert series.delay_text() == ""


def test_a_network_of_a_khepera_iv_reads_its_terms_on_the_line() -> None:
    network = Network(terms=("ultrasonic", "gyroscope"), model="khepera4", top_speed=1000)
    weights = np.zeros(network.n_genes)
    weights[1 + 8 + 2] = 1.0  # from the front ultrasonic sensor to the left wheel
    with Khepera4("khep://arena4?noise=off") as robot:
        robot.sleep(0.2)
        front = robot.ultrasonic().front
        left, right = NetworkController(replace(network, genes=weights)).decide(robot)
    assert front is not None
    assert 0.25 < front < 2.5
    assert (left, right) == (pytest.approx(1000 * np.tanh(front / 2.5)), 0)


def test_readings_of_one_reply_are_requested_once() -> None:
    network = Network(terms=("ultrasonic", "ground"), model="khepera4")
    controller, requests = NetworkController(replace(network, genes=np.zeros(network.n_genes))), list[str]()
    with Khepera4("khep://arena4") as robot:
        controller.start(robot)
        robot.listen(lambda request, reply: requests.append(request))
        controller.cycle(robot)
        robot.listen(None)
    assert requests == ["N", "G", "D,0,0"]
