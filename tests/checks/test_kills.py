"""Killed processes lose no more than the logs' promise; `python -m checks kills` does the same 200 times."""

import pytest

from checks.kills import MOST_LOST, kill


def test_a_killed_server_loses_at_most_a_second_of_wall_time() -> None:
    problems = kill("serve", 2, latest=1.5)
    # Pauses in which the machine let nobody do anything are not the log's.
    assert max(problems.lost, problems.lost_replies) <= MOST_LOST["serve"] + 2 * problems.stall


@pytest.mark.long
def test_a_killed_run_in_lock_step_loses_at_most_five_simulated_seconds() -> None:
    problems = kill("run", 1, latest=1.0)
    assert max(problems.lost, problems.lost_replies) <= MOST_LOST["run"]
