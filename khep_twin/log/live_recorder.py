"""Recorder for a live view: the messages of a log, passed on while the run goes on."""

import time
from collections.abc import Mapping

from khep_twin.clock import Pacer
from khep_twin.log.output import Output, Writer
from khep_twin.log.recorder import WorldRecorder
from khep_twin.log.run_description import RunDescription
from khep_twin.world import World


class LiveRecorder(WorldRecorder):
    """Recorder of a run in a live view.

    Args:
        view: Destination of the messages.
        world: World to show.
        settings: Configuration of the run.
        interval_ns: Wall time after which the view has what was sampled, at the latest with the next sample.
        real_time: True to slow down a world that runs ahead of the wall clock.
    """

    def __init__(
        self,
        view: Writer,
        world: World,
        settings: Mapping[str, object],
        *,
        interval_ns: int,
        real_time: bool = False,
    ) -> None:
        self._interval_ns = interval_ns
        self._pacer = Pacer(1.0, world.time_ns) if real_time else None
        self._sent_ns = 0
        super().__init__(Output(view), world, RunDescription(settings))

    def sample(self, world: World) -> None:
        """Take a sample; pass on all so far if it is time to, and wait for the wall clock in real time."""
        super().sample(world)
        if time.monotonic_ns() - self._sent_ns >= self._interval_ns:
            self.flush()
        if self._pacer is not None and (early := self._pacer.wait(world.time_ns)) > 0:
            time.sleep(early)
        elif self._pacer is not None:
            self._pacer.slip(world.time_ns)

    def flush(self) -> None:
        """Pass on everything so far."""
        super().flush()
        self._sent_ns = time.monotonic_ns()
