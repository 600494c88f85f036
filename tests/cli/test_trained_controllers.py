"""A network's file wherever a controller is expected: `run`, `rollout`, studies, challenges, the page."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import complaint, good

from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.lab.challenge.challenge import load
from khep_twin.lab.challenge.scoring import score
from khep_twin.lab.experiment.periodic_controllers import NetworkController
from khep_twin.log.reader import read_label
from khep_twin.sweep import study
from khep_twin.sweep.sweep import run_sweep
from khep_twin.web.documents import PROGRAM_SUFFIXES, Documents
from khep_twin.web.jobs import series_job
from khep_twin.web.requests import RunRequest

NETWORK = Network(recurrent=True, period_ns=40_000_000)
GENES = np.random.default_rng(2).normal(size=NETWORK.n_genes)

CHALLENGE = """version = 1
name = "far"
title = "Drive far"
description = "Drive as far as you can."
playpen = "default"
seconds = 1
metric = "distance_m"
better = "higher"
"""

STUDY = """version = 1
name = "two"
playpens = ["default"]
controllers = ["best.npz", "braitenberg"]
seeds = 2
seconds = 0.2
step_ms = 10
period_ms = 40
output = "out"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    NETWORK.save(tmp_path / "best.npz", GENES)
    return tmp_path


def read_metrics(output: str) -> dict[str, float]:
    """The metrics that a command prints, by name."""
    return {line[:20].strip(): float(line[20:].split()[0]) for line in output.splitlines()[1:]}


def test_a_run_on_a_port_and_a_rollout_with_its_line_are_the_same(folder: Path) -> None:
    port = ("--port", "khep://obstacles?mode=3&seed=4", "--baudrate", "38400")
    ran = good("run", "best.npz", *port, "--seconds", "1", folder=folder)
    rolled = good(
        *("rollout", "best.npz", "--playpen", "obstacles", "--seed", "4", "--line", "38400"),
        *("--seconds", "1"),
        folder=folder,
    )
    for output in (ran, rolled):
        assert output.startswith("25 cycles in 1.0 s\n")
    assert list(read_metrics(ran))[:4] == ["fitness", "near share", "proximity max", "proximity mean"]
    options = EpisodeOptions(genes=GENES)
    (expected,) = rollout("obstacles", NETWORK, [4], 1.0, options=options, line=38400).metrics["distance_m"]
    assert read_metrics(rolled)["distance m"] == pytest.approx(expected, rel=1e-3)
    # A run's path is measured in steps of a millimetre.
    assert read_metrics(ran)["distance m"] == pytest.approx(expected, abs=2e-3)


def test_a_log_has_the_network(folder: Path) -> None:
    good("run", "best.npz", "--cycles", "3", "--log", "run.mcap", folder=folder)
    label = read_label(folder / "run.mcap")
    assert label.metadata["controller"] == "best.npz"
    assert '"recurrent": true' in label.attachments["controller/best.json"]


def test_a_speed_is_that_of_a_port(folder: Path) -> None:
    error = complaint("run", "best.npz", "--baudrate", "38400", folder=folder)
    assert error == "--baudrate is that of a line to a robot; expected --port with it"


def test_a_study_has_networks_of_files(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)
    rows = pq.read_table(run_sweep(study.load(folder / "study.toml"))).to_pylist()
    assert [row["controller"] for row in rows] == ["best.npz"] * 2 + ["braitenberg"] * 2
    expected = rollout("default", Network.load(folder / "best.npz"), [0, 1], 0.2)
    assert [row["distance_m"] for row in rows[:2]] == pytest.approx(expected.metrics["distance_m"], rel=0.2)
    (folder / "best.npz").write_bytes(b"no network")
    error = complaint("sweep", "study.toml", folder=folder)
    assert error.startswith('study.toml:4: controllers: "best.npz": ')
    assert error.endswith("best.npz: cannot be read: no whole NPZ file: File is not a zip file")


def test_a_challenge_scores_a_network(folder: Path) -> None:
    (folder / "far.toml").write_text(CHALLENGE)
    assert score(load(str(folder / "far.toml")), str(folder / "best.npz"), 1, 1).value > 0.01


def test_the_page_offers_and_runs_networks(folder: Path) -> None:
    (folder / "mine.py").write_text("def controller(robot): ...\n")
    documents = Documents(folder)
    assert documents.names(*PROGRAM_SUFFIXES) == ["best.npz", "mine.py"]
    job = series_job(RunRequest(controllers=("best.npz",), cycles=1), documents)
    assert isinstance(job.controller, NetworkController)
    assert job.controller.network == Network.load(folder / "best.npz")
