"""Programs in C of networks: refusals, and files that they replace."""

from pathlib import Path

import numpy as np
import pytest

from khep_twin.episodes.controllers import Network
from khep_twin.errors import ControllerError

NETWORK = Network(model="khepera4")
GENES = np.linspace(-1, 1, NETWORK.n_genes)


def test_a_network_of_a_robot_that_runs_no_programs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ControllerError, match=r"^a program in C for model khepera1, which runs none; exp"):
        Network().save(tmp_path / "best.c", GENES)
    assert not [*tmp_path.iterdir()]


def test_a_program_replaces_only_another_one_of_a_network(tmp_path: Path) -> None:
    path = tmp_path / "best.c"
    for genes in GENES, 0 * GENES:
        NETWORK.save(path, genes)
    assert "static const double GENES[] = {-0.0, -0.0" in path.read_text()
    path.write_text("int main(void) { return 0; }")
    with pytest.raises(ControllerError, match=r"is there, and no network; expected another name, or replace"):
        NETWORK.save(path, GENES)
    with pytest.raises(ControllerError, match=r"ends in \.npz, or in \.c for a program$"):
        NETWORK.save(tmp_path / "best.h", GENES)


def test_a_program_reads_neighbouring_registers_at_once(tmp_path: Path) -> None:
    network = Network(ambient=True, terms=("ground", "ultrasonic", "gyroscope"), model="khepera4")
    network.save(tmp_path / "best.c", np.zeros(network.n_genes))
    text = (tmp_path / "best.c").read_text()
    assert "READS[] = {88, 8, 64, 8, 104, 9, 232, 1};" in text
    assert "    -INFINITY, INFINITY, 0.0, 1023.0, /* proximity back_left */\n" in text
    assert "    -8000.0, 8000.0, 0.0, 8000.0, /* gyroscope turn */\n" in text
