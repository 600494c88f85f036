"""Episodes on a GPU: equal to the CPU's in numba's simulator, and the compilation of the kernel."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import good, line_of

from khep_twin import make_vec
from khep_twin.episodes.batch import RolloutResult, rollout
from khep_twin.episodes.controllers import (
    Braitenberg,
    ConstantSpeed,
    Driver,
    Function,
    Network,
    Policy,
)
from khep_twin.episodes.cuda import card
from khep_twin.episodes.device import choose_device
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import DeviceError
from khep_twin.playpen import Lamp, Playpen
from khep_twin.robots.registry import find_model

pytestmark = [
    pytest.mark.skipif(importlib.util.find_spec("numba_cuda") is None, reason="numba-cuda is not installed"),
    # Words of random draws, whose products overflow.
    pytest.mark.filterwarnings("ignore:overflow encountered in scalar multiply:RuntimeWarning"),
]

NETWORK = Network(hidden=(5,), recurrent=True)
GENES = np.random.default_rng(52).normal(scale=1.5, size=(3, NETWORK.n_genes))
PERIODS = 0.04
"""Two control periods [s]."""

LAMPS = [
    [],
    [Lamp(x_mm=300, y_mm=300, power_w=5, flicker=0.4)],
    [Lamp(x_mm=100, y_mm=600, power_w=5), Lamp(x_mm=600, y_mm=300, power_w=3)],
]


def planar(name: str, **options: Any) -> EpisodeSetup:
    playpen = Playpen.load(name)
    return EpisodeSetup(
        playpen.model_copy(update={"robots": (playpen.robots[0].model_copy(update={"turrets": ()}),)}),
        planar=True,
        **options,
    )


def assert_same(one: RolloutResult, other: RolloutResult) -> None:
    for name, values in one.metrics.items():
        assert values.tobytes() == other.metrics[name].tobytes(), name
    assert one.registers.tolist() == other.registers.tolist()
    for ours, theirs in ((one.poses, other.poses), (one.objects, other.objects), (one.paths, other.paths)):
        np.testing.assert_array_equal(ours, theirs)
    assert one.failures == other.failures


def compare(setup: EpisodeSetup, driver: Driver, seconds: float = PERIODS, **options: Any) -> RolloutResult:
    """Run three episodes on a GPU and on the CPU; return the results, which must be equal."""
    results = rollout(setup, driver, range(3), seconds, device="cuda", **options)
    assert_same(results, rollout(setup, driver, range(3), seconds, compiled=False, **options))
    return results


@pytest.mark.share(2)
@pytest.mark.parametrize(("number", "term", "code"), [(4, "gyroscope", 250), (3, "ground", 0)])
def test_further_readings_of_further_models_on_a_gpu_equal_those_on_the_cpu(
    number: int, term: str, code: int
) -> None:
    network = Network(hidden=(2,), terms=("ultrasonic", term), model=f"khepera{number}")
    genes = np.random.default_rng(5).normal(size=(3, network.n_genes))
    results = compare(planar(f"arena{number}"), network, 0.12, genes=genes)
    first = find_model(network.model).find_terms(network.terms)[0].register
    assert (results.registers[:, first : first + 5] != code).any()  # a distance
    policy = Policy(lambda proximity, ambient, which, distances: distances[:, :2], terms=("ultrasonic",))
    compare(planar(f"arena{number}"), policy)


@pytest.mark.parametrize("name", ["obstacles", "looping-maze", "default", "garbage"])
def test_networks_on_a_gpu_equal_those_on_the_cpu(name: str) -> None:
    compare(planar(name), NETWORK, genes=GENES)


@pytest.mark.parametrize("driver", [Braitenberg(), ConstantSpeed(12, -7)], ids=["braitenberg", "constant"])
def test_other_controllers_with_sampled_paths_equal_those_on_the_cpu(driver: Driver) -> None:
    assert len(compare(planar("obstacles"), driver, paths_every=0.02).paths[0]) == 3


def test_robots_lamps_and_starts_may_differ_between_episodes() -> None:
    starts = [(200.0, 200.0, 90.0), (300.0, 150.0, 0.0), (150.0, 400.0, -40.0)]
    options = EpisodeOptions(noise=0.5, vary=True, home=(200.0, 200.0, 100.0, 1.0))
    results = compare(planar("obstacles"), Braitenberg(), lamps=LAMPS, starts=starts, options=options)
    assert len(set(results.metrics["light_seeking"].tolist())) > 1


def test_the_scale_of_the_noise_may_differ_between_episodes() -> None:
    from khep_twin.episodes.cuda.card_batch import CardBatch, PreparedEpisode

    setup = planar("obstacles")
    batch = CardBatch([PreparedEpisode(setup, Braitenberg())] * 4, Braitenberg())
    options = [EpisodeOptions(noise=noise) for noise in (True, 0.5, False, 2.0)]
    for index, episode_options in enumerate(options):
        batch.begin(index, 1, episode_options)
    assert not batch.switch_on()
    assert not batch.step(range(4), setup.steps_per_period)
    episode = Episode(setup, Braitenberg(), compiled=False)
    for registers, episode_options in zip(batch.registers.tolist(), options, strict=True):
        episode.begin(1, episode_options)
        episode.step(setup.steps_per_period)
        assert registers[0] == episode.registers.tolist()
    assert len({str(registers) for registers in batch.registers.tolist()}) == 4


def test_pushed_objects_and_a_line_are_supported_on_a_gpu() -> None:
    setup = planar("garbage", at_line=True)
    cylinder = setup.playpen.cylinders[0]
    starts = [(cylinder.x_mm - 45, cylinder.y_mm, 0.0)] * 3
    results = compare(setup, NETWORK, 0.2, genes=GENES + 1, starts=starts, line=38400)
    assert not np.array_equal(results.objects[0], results.objects[1])


def test_a_policy_drives_robots_on_a_gpu_until_one_fails() -> None:
    def decide(proximity: Any, ambient: Any, which: Any) -> Any:
        return 10 - proximity[:, [3, 2]] / np.where(which == 1, np.nan, 100)[:, None]

    results = compare(planar("obstacles"), Policy(decide), paths_every=0.02)
    assert [failure.index for failure in results.failures] == [1]
    assert "expected finite numbers" in results.failures[0].reason


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")
def test_a_network_whose_speed_is_not_finite_fails_with_the_message_of_the_cpu() -> None:
    results = compare(planar("obstacles"), Network(top_speed=float("inf")), genes=np.zeros((3, 18)))
    assert [failure.step for failure in results.failures] == [0, 0, 0]
    assert "a controller gave a speed that is no number" in results.failures[0].reason


def test_more_episodes_than_fill_a_gpu_run_in_bounded_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(card, "EPISODES_PER_PROCESSOR", 1)
    compare(planar("default"), NETWORK, genes=GENES)


@pytest.mark.share(2)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_environments_on_a_gpu_equal_those_on_the_cpu(mode: str) -> None:
    def steps(device: str) -> list[Any]:
        environments = make_vec(
            "khep_twin/Homing-v0",
            num_envs=3,
            planar=True,
            device=device,
            seconds=0.2,
            details=True,
            vary=True,
            autoreset_mode=mode,
        )
        results: list[Any] = [environments.reset(seed=4)]
        rng = np.random.default_rng(1)
        results += [environments.step(rng.uniform(-1, 1, (3, 2)).astype(np.float32)) for _ in range(6)]
        environments.close()
        return results

    np.testing.assert_equal(to_lists(steps("cuda")), to_lists(steps("cpu")))


def to_lists(value: Any) -> Any:
    """Return nested results without arrays of objects, which numpy cannot compare."""
    if isinstance(value, dict):
        return {key: to_lists(item) for key, item in value.items()}
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype.kind == "O"):
        return [to_lists(item) for item in value]
    return value


BLINKING = [[Lamp(x_mm=100, y_mm=100, power_w=1, blink_period_s=1)]]


@pytest.mark.parametrize(
    ("setup", "driver", "line", "lamps", "message"),
    [
        (
            EpisodeSetup("default"),
            Braitenberg(),
            None,
            None,
            "episodes in MuJoCo; expected episodes in the pl",
        ),
        (
            planar("default"),
            Function(lambda p, a, m, g: (1, 1)),
            None,
            None,
            "a Function; expected a Network",
        ),
        (planar("default"), Policy(), 9600, None, "plain Python at a line of 9600; expected no line"),
        (planar("default"), Braitenberg(), None, BLINKING, "lamps that change; expected steady ones"),
    ],
    ids=["mujoco", "function", "policy at a line", "lamps"],
)
def test_episodes_that_a_gpu_does_not_support_are_refused_by_name(
    setup: EpisodeSetup, driver: Driver, line: int | None, lamps: Any, message: str
) -> None:
    with pytest.raises(DeviceError, match=message):
        choose_device("cuda", setup, driver, line, 1, lamps)
    assert choose_device("auto", setup, driver, line, 10**6, lamps) == "cpu"


def test_auto_selects_a_gpu_that_the_episodes_fill() -> None:
    setup = planar("default")
    assert choose_device("auto", setup, Braitenberg(), None, card.EPISODES_PER_PROCESSOR - 1) == "cpu"
    assert choose_device("auto", setup, Braitenberg(), None, card.EPISODES_PER_PROCESSOR) == "cuda"
    with pytest.raises(DeviceError, match=r"device = 'gpu': unknown; did you mean 'cpu'"):
        choose_device("gpu", setup, Braitenberg(), None, 1)


def environments(device: str, **options: Any) -> Any:
    return make_vec(
        "khep_twin/ObstacleAvoidance-v0", num_envs=2, planar=True, device=device, seconds=0.2, **options
    )


def test_playpens_of_other_shapes_are_refused_in_one_batch_of_environments() -> None:
    message = (
        "obstacles has 15 obstacles, 0 of them movable; expected 4 obstacles, 0 of them movable, as in defa"
    )
    with pytest.raises(DeviceError, match=message):
        environments("cuda", playpen=["default", "obstacles"])
    environments("auto", playpen=["default", "obstacles"]).reset()


def test_a_reset_that_is_refused_changes_nothing() -> None:
    results: list[Any] = []
    for device in ("cuda", "cpu"):
        batch = environments(device)
        batch.reset(seed=3)
        batch.step(np.full((2, 2), 0.5, np.float32))
        if device == "cuda":
            with pytest.raises(DeviceError, match="lamps that change"):
                batch.reset(options={"lamps": [[], *BLINKING]})
        results.append(to_lists(batch.step(np.full((2, 2), 0.5, np.float32))))
    np.testing.assert_equal(*results)


def test_vary_may_differ_between_the_slots_of_a_batch() -> None:
    from khep_twin.episodes.cuda.card_batch import CardBatch, PreparedEpisode

    setup, results = planar("obstacles"), list[Any]()
    gpu_batch = CardBatch([PreparedEpisode(setup, Policy())] * 3, Policy())
    for batch in (gpu_batch, EpisodeBatch([Episode(setup, Policy()) for _ in range(3)], 1)):
        for index in range(3):
            batch.begin(index, index, EpisodeOptions(vary=index == 0))
        assert not batch.switch_on()
        batch.speeds[:] = 12, 9
        assert not batch.step(range(3), 4)
        results.append((batch.poses.tolist(), batch.boards.tolist(), batch.sums.tobytes()))
        assert [episode.steps for episode in batch.episodes] == [4, 4, 4]
    assert results[0] == results[1]


def test_the_command_on_a_gpu_equals_that_on_the_cpu(tmp_path: Path) -> None:
    words = ("rollout", "--planar", "--seconds", "0.2", "--picture")
    gpu_output = good(*words, "card.png", "--device", "cuda", folder=tmp_path)
    assert gpu_output.replace("card", "cpu") == good(*words, "cpu.png", folder=tmp_path)
    assert (tmp_path / "card.png").read_bytes() == (tmp_path / "cpu.png").read_bytes()


def test_without_a_gpu_the_command_fails_with_one_line() -> None:
    words = "-m", "khep_twin", "rollout", "--planar", "--device", "cuda"
    message = line_of(python(*words, CUDA_VISIBLE_DEVICES=""))
    assert message.startswith('device = "cuda": no NVIDIA GPU: ')
    assert message.endswith("; expected a GPU and its driver")


@pytest.mark.parametrize("playpen", ["obstacles", pytest.param("arena3", marks=pytest.mark.long)])
def test_the_kernel_compiles_for_a_gpu(request: pytest.FixtureRequest, playpen: str) -> None:
    script, key = Path(__file__).with_name("cuda_ptx.py"), f"khep_twin/ptx-{playpen}"
    cached_stamp = str(request.config.cache.get(key, "")) if request.config.cache else ""
    process = python(script, cached_stamp, playpen)
    assert process.returncode == 0, process.stderr
    if request.config.cache:
        request.config.cache.set(key, process.stdout.split()[0])


def python(*words: object, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Run a Python program that does not use numba's simulator."""
    variables = os.environ | {"NUMBA_ENABLE_CUDASIM": "0"} | environment
    return subprocess.run(
        [sys.executable, *map(str, words)], env=variables, capture_output=True, text=True, check=False
    )
