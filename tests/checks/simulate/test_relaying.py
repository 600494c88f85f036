"""Hosts at the relay to a robot at a simulated cable, and faults of the machine's clocks."""

import pytest

from checks.simulate.case import Case
from checks.simulate.faults import Faults
from checks.simulate.kernel import NS_PER_S, Kernel
from checks.simulate.relaying import MUTANTS
from checks.simulate.system import System


@pytest.mark.share(4)
@pytest.mark.parametrize("seed", [0, 3, 9, 17])
def test_hosts_at_a_relay_get_what_the_robot_says_or_an_error(seed: int) -> None:
    outcome = Case("relay", seed, 15.0).run()
    assert outcome.violation is None
    assert outcome.counts["speeds"] > 0


def test_a_seed_repeats_every_turn_of_its_processes() -> None:
    first, second = (Case("relay", 2, 6.0).run() for _ in range(2))
    assert first == second
    assert first.faults


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("name", "seed", "seconds", "fault"),
    [
        ("replies to the relay's own questions reach hosts", 0, 15.0, ""),
        ("the log of a line misses replies", 0, 80.0, "server-stop/server/77"),
        ("a relay goes on without its cable", 1, 120.0, "unplug/cable/56"),
    ],
)
def test_a_broken_relay_is_caught_by_few_faults(name: str, seed: int, seconds: float, fault: str) -> None:
    case = Case("relay", seed, seconds, name, tuple(filter(None, [fault])))
    assert case.run().invariant == MUTANTS[name].invariant


def test_a_suspended_machine_runs_no_program_and_robots_go_on() -> None:
    faults = Faults(0, ())
    kernel = Kernel(0, faults)
    time = System(kernel).modules["time"]
    woken: dict[str, int] = {}

    def sleeper(name: str) -> None:
        time.sleep(1.0)
        woken[name] = time.monotonic_ns()

    kernel.spawn("program", lambda: sleeper("program"))
    kernel.spawn("robot", lambda: sleeper("robot")).outside = True
    kernel.at(kernel.now_ns + NS_PER_S // 2, lambda: kernel.suspend(5 * NS_PER_S))
    kernel.run(20 * NS_PER_S)
    assert woken["robot"] == pytest.approx(2.0e9, rel=1e-3)
    assert woken["program"] == pytest.approx(6.5e9, rel=1e-3)
