"""Observers of a world: their order, events before the first one, and updates before a sample."""

from types import SimpleNamespace
from typing import Any, cast

import mujoco
from notes import Notes

from khep_twin.observers import Observer, Observers


def observed_world() -> Any:
    """Return what observers need of a world, at time 0."""
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    world = SimpleNamespace(model=model, data=mujoco.MjData(model), time_ns=0)
    world.observers = Observers(cast(Any, world))
    return world


def test_events_at_time_0_are_kept_until_there_is_an_observer() -> None:
    world = observed_world()
    world.observers.on_event(None, "the lamp is on")
    world.observers.append(Notes())
    world.observers.on_event(1, "the robot starts")
    world.observers.clear()
    world.time_ns = 10
    world.observers.on_event(1, "nobody sees it")
    assert world.observers.early_events == [(None, "the lamp is on")]


def test_robots_are_updated_once_before_the_observers_sample_in_their_order() -> None:
    calls: list[str] = []

    class Sampler(Observer):
        def __init__(self, name: str) -> None:
            self.name = name

        def sample(self, world: Any) -> None:
            calls.append(self.name)

    world = observed_world()
    world.observers.evaluations.append(lambda: calls.append("update"))
    world.observers.sample()
    assert not calls
    world.observers.extend([first := Sampler("first"), Sampler("second")])
    world.observers.sample()
    world.observers.sample(first)
    assert calls == ["update", "first", "second", "update", "first"]
