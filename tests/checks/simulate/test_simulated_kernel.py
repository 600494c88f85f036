"""Processes of the simulated kernel: turns, time, waiting, and kills."""

import os
from pathlib import Path

import pytest

from checks.simulate.kernel import NS_PER_S, Killed
from checks.simulate.simulation import Outcome, Simulation, Violation, simulate


def test_simulated_time_passes_while_all_wait_and_no_wall_time_does() -> None:
    times: list[float] = []

    def scenario(simulation: Simulation, seconds: float) -> None:
        time = simulation.system.modules["time"]

        def sleeper() -> None:
            for _ in range(3):
                time.sleep(1000.0)
                times.append(time.monotonic())

        simulation.spawn("sleeper", sleeper)
        simulation.run(seconds)

    outcome = simulate("x", scenario, 1, 1e5)
    assert outcome.simulated_ns == 100_000 * NS_PER_S
    assert [round(time / 1000) for time in times] == [1, 2, 3]


def test_a_byte_wakes_who_waits_for_it() -> None:
    messages: list[bytes] = []

    def scenario(simulation: Simulation, seconds: float) -> None:
        modules, ends = simulation.system.modules, {}

        def reader() -> None:
            ends["reader"], ends["writer"] = modules["os"].pipe()
            ends["file"] = simulation.kernel.current.files[ends["writer"]]
            assert modules["select"].select([ends["reader"]], [], [], None)[0] == [ends["reader"]]
            messages.append(modules["os"].read(ends["reader"], 10))

        def writer() -> None:
            modules["time"].sleep(0.5)
            simulation.kernel.current.opened(ends["file"])
            ends["file"].write(b"x")

        simulation.spawn("reader", reader)
        simulation.spawn("writer", writer)
        simulation.run(seconds)

    simulate("x", scenario, 1, 1.0)
    assert messages == [b"x"]


def test_a_killed_process_does_nothing_more_and_leaves_no_descriptor(tmp_path: Path) -> None:
    kept_file, log = tmp_path / "kept", list[str]()

    def scenario(simulation: Simulation, seconds: float) -> None:
        modules = simulation.system.modules

        def victim() -> None:
            modules["os"].pipe()
            descriptor = modules["os"].open(kept_file, os.O_WRONLY | os.O_CREAT)
            try:
                modules["time"].sleep(10.0)
            finally:
                log.append("unwound")
                with pytest.raises(Killed):
                    modules["os"].unlink(kept_file)
                with pytest.raises(Killed):
                    modules["os"].write(descriptor, b"x")

        process = simulation.spawn("victim", victim)
        simulation.kernel.at(2 * NS_PER_S, lambda: simulation.kernel.kill(process))
        simulation.run(seconds)
        assert not process.alive
        assert not process.files
        assert not process.real

    simulate("x", scenario, 1, 5.0)
    assert log == ["unwound"]
    assert kept_file.read_bytes() == b""


def test_an_error_that_is_not_the_packages_own_is_a_violation() -> None:
    def scenario(simulation: Simulation, seconds: float) -> None:
        simulation.spawn("careless", lambda: {}["missing"])
        simulation.run(seconds)

    outcome = simulate("x", scenario, 1, 1.0)
    assert outcome.invariant == "errors"
    assert "careless ended by KeyError('missing')" in (outcome.violation or "")


def unlucky(simulation: Simulation, seconds: float) -> None:
    """Have two processes sleep and meet faults until there were three."""
    time, faults = simulation.system.modules["time"], simulation.faults

    def sleeper(name: str) -> None:
        while True:
            time.sleep(simulation.kernel.current.rng.random())
            if faults.happens("odd", name, 0.1) and len(faults.happened) == 3:
                simulation.violate("odds", f"the third at {name}")

    for name in ("left", "right"):
        simulation.spawn(name, lambda name=name: sleeper(name))
    simulation.run(seconds)


def unlucky_seed() -> Outcome:
    """Return the outcome of the first seed under which there are three faults."""
    return next(outcome for seed in range(20) if (outcome := simulate("x", unlucky, seed, 500.0)).violation)


def test_the_same_seed_gives_the_same_outcome_and_its_faults_alone_do_too() -> None:
    outcome = unlucky_seed()
    assert simulate("x", unlucky, outcome.seed, 500.0) == outcome
    assert simulate("x", unlucky, outcome.seed, 500.0, allowed=outcome.faults) == outcome


def test_a_fault_that_is_left_out_does_not_happen() -> None:
    outcome = unlucky_seed()
    other = simulate("x", unlucky, outcome.seed, 500.0, allowed=outcome.faults[:1])
    assert other.faults == outcome.faults[:1]
    assert other.violation is None


def test_a_violation_in_a_process_ends_the_simulation() -> None:
    def scenario(simulation: Simulation, seconds: float) -> None:
        simulation.spawn("checker", lambda: simulation.violate("sums", "2 + 2 = 5"))
        simulation.run(seconds)
        pytest.fail("it went on")

    outcome = simulate("x", scenario, 1, 1.0)
    assert outcome.invariant == "sums"
    assert issubclass(Violation, AssertionError)
