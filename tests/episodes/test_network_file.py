"""Network files: they are read as written, and invalid files are refused in one line."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Network
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.network_file import LIGHT
from khep_twin.errors import ControllerError, KhepTwinError
from khep_twin.files import npz_file
from khep_twin.sensing import calibration

NETWORK = Network(hidden=(3,), recurrent=True, ambient=True, top_speed=12.5)
GENES = np.random.default_rng(1).normal(size=NETWORK.n_genes)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    NETWORK.save(tmp_path / "best.npz", GENES, setup=EpisodeSetup("two-lamps", period_ns=40_000_000), seed=7)
    return tmp_path / "best.npz"


def test_a_network_is_read_as_it_was_written(file: Path) -> None:
    network = Network.load(file)
    assert (network.hidden, network.recurrent, network.ambient, network.top_speed) == ((3,), True, True, 12.5)
    assert network.genes == tuple(GENES)
    assert (network.period_ns, network.light, network.playpen, network.seed) == (
        40_000_000,
        LIGHT,
        "two-lamps",
        7,
    )
    content = file.read_bytes()
    network.save(file)  # replaces the existing file
    assert file.read_bytes() == content
    assert Network.load(file) == network


def test_numpy_opens_the_file_without_pickle(file: Path) -> None:
    with np.load(file, allow_pickle=False) as arrays:
        assert arrays["genes"].tolist() == GENES.tolist()
        assert arrays["inputs"][[0, 15]].tolist() == ["proximity left_90", "light back_left"]
        assert arrays["one"][[0, 15]].tolist() == [1023.0, 75.0]


def test_the_scale_of_light_without_a_setup_is_that_of_the_usual_robot() -> None:
    ambient = calibration.read("khepera1")[0].ambient
    assert (ambient.dark_counts, ambient.floor_counts) == LIGHT


def test_a_rollout_has_the_networks_own_genes_and_period(file: Path) -> None:
    options: dict[str, Any] = {"seeds": range(2), "seconds": 0.8, "compiled": False}
    setup = EpisodeSetup("two-lamps", period_ns=40_000_000)
    expected = rollout(setup, NETWORK, genes=np.array([GENES, GENES]), **options)
    results = rollout("two-lamps", Network.load(file), **options)
    np.testing.assert_array_equal(results.registers, expected.registers)
    other = rollout("two-lamps", Network.load(file), genes=np.array([GENES, -GENES]), **options)
    assert (other.registers[0] == results.registers[0]).all()
    assert (other.registers[1] != results.registers[1]).any()


def without(name: str) -> Callable[[dict[str, Any]], object]:
    return lambda arrays: arrays.pop(name)


def changed(**values: object) -> Callable[[dict[str, Any]], object]:
    return lambda arrays: arrays.update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("format"), r"no network: an NPZ file of genes, .*; expected one that Network.save"),
        (changed(format="other"), r"no network: an NPZ file of .*; expected one that Network.save"),
        (changed(version=2), r"version = 2; expected 1; is it of a newer khep_twin\?"),
        (changed(memory=1), r"memory: unknown; .*choices: format, version"),
        (without("top_speed"), r"no top_speed; expected one"),
        (changed(genes=GENES[:-1]), r"67 genes; expected 68 for layers of 16, 3, 2, recurrent"),
        (changed(genes=np.where(GENES == GENES[4], np.nan, GENES)), r"genes\[4\] = nan; expected finite"),
        (changed(genes=["1"] * 68), r"genes: <U1 of shape \(68,\); expected numbers, a row of them"),
        (changed(recurrent=[True]), r"recurrent: bool of shape \(1,\); expected true or false, a single one"),
        (changed(hidden=[0]), r"hidden = \[0\]; expected 1 to 1000 neurons"),
        (changed(top_speed=-1.0), r"top_speed = -1; expected a number above 0 and at most 127"),
        (changed(period_ns=15_000_000), r"period_ns = 15000000; expected whole ticks of 10000000 ns"),
        (changed(seed=-1), r"seed = -1; expected an integer from 0"),
        (
            changed(inputs=["light left_90"] * 16),
            r"inputs\[0\] = 'light left_90'; expected 'proximity left",
        ),
        (changed(inputs=["speed left"]), r"1 inputs; expected 8, or 16 with light"),
        (changed(playpen="x" * 201), r"playpen = 'xxx.*; expected a name of at most 200 characters"),
        (changed(one=[1.0] * 16), r"inputs are 0 at .* counts; expected proximity from 0 to 1023"),
    ],
)
def test_a_file_of_another_network_is_refused(
    file: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    arrays: dict[str, Any] = dict(npz_file.read_arrays(file.read_bytes()))
    change(arrays)
    file.write_bytes(npz_file.npz_bytes(arrays))
    with pytest.raises(ControllerError, match=rf"best\.npz: {message}") as caught:
        Network.load(file)
    assert "\n" not in str(caught.value)


def pickled() -> bytes:
    data = io.BytesIO()
    np.savez(data, genes=np.array([print], object))
    return data.getvalue()


def bomb() -> bytes:
    """Return 65 MB of zeros, compressed."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("genes.npy", bytes(65 * 2**20))
    return data.getvalue()


def too_long() -> bytes:
    """Return an array whose header states a trillion numbers."""
    content, data = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(
        content, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("genes.npy", content.getvalue())
    return data.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "no whole NPZ file: File is not a zip file"),
        (b"def controller(robot): ...\n", "no whole NPZ file: File is not a zip file"),
        (npz_file.npz_bytes({"a": 1})[:-5], "no whole NPZ file: File is not a zip file"),
        (npz_file.npz_bytes({"a": 1}).replace(b"NUMPY", b"numpy"), "no whole NPZ file: Bad CRC-32"),
        (npz_file.npz_bytes({"a": 1}).replace(b"a.npy", b"\n.npy"), r"'.n.npy' is not packed as numpy does"),
        (npz_file.npz_bytes({"a": "\n"}), "characters that cannot be printed"),
        (pickled(), "pickled objects, which are not read; expected numbers or texts"),
        (bomb(), r"1 arrays of 68157440 bytes; expected at most 100 of 67108864 bytes"),
        (too_long(), r"genes.npy: 0 bytes for an array of \(1000000000000,\); it is damaged"),
    ],
    ids=["empty", "text", "cut", "damaged", "a name", "lines", "pickled", "bomb", "too long"],
)
def test_a_file_that_is_no_archive_of_numbers_is_refused(data: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "best.npz").write_bytes(data)
    with pytest.raises(ControllerError, match=rf"best\.npz: cannot be read: .*{message}"):
        Network.load(tmp_path / "best.npz")


def test_an_unreadable_network_is_not_written(file: Path) -> None:
    content = file.read_bytes()
    for network, genes, message in (
        (NETWORK, None, "0 genes; expected 68"),
        (NETWORK, [1.0], "1 genes; expected 68"),
        (Network(), np.full(18, np.inf), "finite numbers"),
        (Network(top_speed=1000.0), np.zeros(18), "at most 127"),
        (Network(seed=2**70), np.zeros(18), "seed"),
    ):
        with pytest.raises(ControllerError, match=message):
            network.save(file, genes)
    with pytest.raises(ControllerError, match=r"best.npy: expected a name that ends in .npz"):
        NETWORK.save(file.with_suffix(".npy"), GENES)
    assert file.read_bytes() == content


def test_a_file_of_another_kind_is_only_replaced_on_request(tmp_path: Path) -> None:
    other = tmp_path / "data.npz"
    np.savez(other, measured=[1, 2])
    content = other.read_bytes()
    with pytest.raises(KhepTwinError, match=r"data.npz: is there, and no network; expected another"):
        Network().save(other, np.zeros(18))
    assert other.read_bytes() == content
    Network().save(other, np.zeros(18), replace=True)
    assert Network.load(other).genes == (0.0,) * 18


KHEPERA_4_NETWORK = Network(model="khepera4")
WEIGHTS = np.linspace(-1, 1, KHEPERA_4_NETWORK.n_genes)


def test_a_network_of_a_robot_that_runs_no_programs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ControllerError, match=r"^a program in C for model khepera1, which runs none; exp"):
        Network().save(tmp_path / "best.c", WEIGHTS)
    assert not [*tmp_path.iterdir()]


def test_a_program_replaces_only_another_one_of_a_network(tmp_path: Path) -> None:
    path = tmp_path / "best.c"
    for genes in WEIGHTS, 0 * WEIGHTS:
        KHEPERA_4_NETWORK.save(path, genes)
    assert "static const double GENES[] = {-0.0, -0.0" in path.read_text()
    path.write_text("int main(void) { return 0; }")
    with pytest.raises(ControllerError, match=r"is there, and no network; expected another name, or replace"):
        KHEPERA_4_NETWORK.save(path, WEIGHTS)
    with pytest.raises(ControllerError, match=r"ends in \.npz, or in \.c for a program$"):
        KHEPERA_4_NETWORK.save(tmp_path / "best.h", WEIGHTS)


def test_a_program_reads_neighbouring_registers_at_once(tmp_path: Path) -> None:
    network = Network(ambient=True, terms=("ground", "ultrasonic", "gyroscope"), model="khepera4")
    network.save(tmp_path / "best.c", np.zeros(network.n_genes))
    text = (tmp_path / "best.c").read_text()
    assert "READS[] = {88, 8, 64, 8, 104, 9, 232, 1};" in text
    assert "    -INFINITY, INFINITY, 0.0, 1023.0, /* proximity back_left */\n" in text
    assert "    -8000.0, 8000.0, 0.0, 8000.0, /* gyroscope turn */\n" in text
