"""Metrics of a control period: their readings are those of the sensor that matters."""

import numpy as np
import pytest

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.metrics import compute_period, initial_sums

DARK, FLOOR = 450.0, 50.0
AMBIENT = int(kernel.Board.AMBIENT)
POSE = 0.0, 0.0, 1.0, 0.0


@pytest.mark.parametrize("brightest", range(units.N_SENSORS))
def test_light_is_that_of_the_brightest_receiver(brightest: int) -> None:
    home = np.zeros(4)
    registers = np.full(kernel.N_REGISTERS, units.COUNTS_LIMIT, np.int64)
    registers[AMBIENT : AMBIENT + units.N_SENSORS] = DARK
    registers[AMBIENT + brightest] = 150
    interface = EpisodeSetup("default").interface
    period = compute_period(registers, interface, initial_sums(1, home)[0], home, (DARK, FLOOR), POSE)
    assert period.light_seeking == pytest.approx(0.75)
