"""Episodes in a plane on a GPU: an `EpisodeBatch` whose steps are launches of `kernel`.

    setup = EpisodeSetup(Playpen.load("obstacles"), planar=True)
    batch = CardBatch([PreparedEpisode(setup, Policy())] * 4096, Policy())
    for index in range(4096):
        batch.begin(index, seed=index)
    failures = batch.switch_on()
    batch.speeds[:] = 10, 8
    failures |= batch.step(range(4096), setup.steps_per_period)

The CPU prepares an episode, and the GPU runs it. Its state is copied back when a caller reads the episode, or
after it has failed, so that `Episode` alone computes its properties and errors.

Imported only where numba-cuda is installed.
"""

# numba-cuda is not typed.
# pyright: basic, reportMissingTypeStubs=false, reportArgumentType=false, reportOptionalSubscript=false
# pyright: reportOptionalMemberAccess=false

import operator
from collections.abc import Callable, Sequence
from threading import Lock
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from khep_twin.episodes.controllers import Driver, Floats, Policy
from khep_twin.episodes.cuda import card, kernel
from khep_twin.episodes.cuda.episode_layout import EpisodeLayout, State, episode_constants
from khep_twin.episodes.cuda.slot_constants import SlotConstants
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch, Slots
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.plane import PUSHED, PUSHED_ASIDE, true_pose
from khep_twin.episodes.stepping import EpisodeArguments
from khep_twin.errors import DivergedError, PlaypenError
from khep_twin.process.one_thread import one_thread
from khep_twin.step import Reason

BLOCK_SIZE = 64
"""Threads of a block."""

_LAUNCH_LOCK = Lock()
"""Lock for one launch and the copy of its results; other threads prepare episodes meanwhile."""


class PreparedEpisode(Episode):
    """Episode that the CPU starts and a GPU runs; arguments are those of `Episode`."""

    def __init__(self, setup: EpisodeSetup, driver: Driver | None = None) -> None:
        super().__init__(setup, driver, compiled=True)

    def _advance(self, *arguments: Any) -> int:
        if arguments[-2] < 0:  # the end step
            return Reason.DONE  # the GPU switches the robot on
        raise RuntimeError("a GPU runs this episode; expected CardBatch.step")


class CardBatch(EpisodeBatch):
    """Episodes that a GPU runs; see `EpisodeBatch`.

    Args:
        episodes: For each slot, the object in which the CPU prepares its episodes; slots may share one.
        driver: Controller of the episodes; the caller sets the speeds of a policy.
    """

    COPY_ADVICE = "another CardBatch of new episodes, started with the same seeds"

    def __init__(self, episodes: Sequence[Episode], driver: Driver) -> None:
        super().__init__(episodes, threads=1)
        self._sets_speeds, self._model = isinstance(driver, Policy), episodes[0].setup.core.name
        self._start_arguments: list[tuple[int, EpisodeOptions]] = [(0, DEFAULT_OPTIONS)] * len(episodes)
        self._new_states: dict[int, State] = {}
        self._constants = SlotConstants(len(episodes))
        self._arrays = self._arrays._replace(addresses=np.zeros((1, 1), np.int64))  # of the CPU's arrays
        self._layout: EpisodeLayout | None = None
        self._shared_arrays: tuple[object, ...] = ()
        self._gpu_states: _GpuStates | None = None
        self._host_states: State | None = None

    @one_thread
    def begin(
        self, index: int, seed: int, options: EpisodeOptions = DEFAULT_OPTIONS, episode: Episode | None = None
    ) -> None:
        """Start an episode in a slot, or replace it by `episode`; `switch_on` has to follow."""
        episode = episode or self._episodes[index]
        arguments = _start_episode(episode, seed, options)
        # Without `vary`, arrays that are the same objects have the same content.
        shared = () if options.vary else (*arguments[1:6], arguments.tables)
        is_shared = shared and self._shared_arrays and all(map(operator.is_, shared, self._shared_arrays))
        if self._layout is None:
            self._layout = EpisodeLayout(arguments)
            self._shared_arrays = shared
        if not self._layout.matches(arguments):
            raise PlaypenError(
                f"{episode.playpen.name}: other numbers of obstacles, or another controller, than in the "
                "first episode; expected the same in all episodes of a batch on a GPU"
            )
        self._episodes[index], self._start_arguments[index] = episode, (seed, options)
        self._new_states[index] = self._layout.pack(arguments)
        controllers = arguments.controllers
        constants = {"genes": controllers.genes, "home": controllers.home, "powers": arguments.powers}
        self._constants.set_slot(index, constants if is_shared else episode_constants(arguments))
        self.steps[index], self._runs_compiled[index] = 0, True

    @one_thread
    def switch_on(self) -> dict[int, DivergedError]:
        """Switch on the robots of episodes that were started; return the failures by slot."""
        if not self._new_states:
            return {}
        slots = np.array(list(self._new_states))
        new_states = np.stack(list(self._new_states.values()), axis=1)
        self._new_states.clear()
        self._launch(slots, new_states, np.full(len(self._episodes), -1))
        return self._failures(slots)

    @property
    def episodes(self) -> Sequence[Episode]:
        """Episodes; each access copies one from the GPU, and may change one that was returned before."""
        return _RestoredEpisodes(self._restore, len(self._episodes))

    @property
    def boards(self) -> NDArray[np.int64]:
        """Registers of the robots (n, n_robots, n_registers)."""
        return self.registers

    @property
    def episode_poses(self) -> Floats:
        """Poses as by `Episode.poses` (n, n_robots, 3)."""
        return np.array([[true_pose(joints)] for joints in self._outputs["joints"].T.tolist()])

    @property
    def sums(self) -> Floats:
        """Sums of the metrics of the robots (n, n_robots, N_SUMS)."""
        return self._outputs["sums"].T[:, None]

    @property
    def objects(self) -> Floats:
        """Positions x, y [m] and headings [rad] of the movable objects (n, n_objects, 3)."""
        return self._layout.objects(self._outputs["objects"])

    def touches(self, slots: Slots) -> NDArray[np.bool_]:
        """Return whether the robots of some slots touch anything but the floor (n_slots, n_robots)."""
        impulses = self._outputs["impulses"]
        return ((impulses[PUSHED] != 0) | (impulses[PUSHED_ASIDE] != 0))[np.asarray(slots), None]

    @property
    def _outputs(self) -> dict[str, Floats]:
        if self._gpu_states is None:
            raise ValueError("no episode has been switched on; expected begin() and switch_on() first")
        return self._gpu_states.outputs

    def _restore(self, index: int) -> Episode:
        """Return an episode, copied from the GPU unless its robot is still to be switched on."""
        episode, start_arguments = self._episodes[index], self._start_arguments[index]
        arguments = _start_episode(episode, *start_arguments)
        if self._gpu_states is not None and index not in self._new_states:
            if self._host_states is None:
                with _LAUNCH_LOCK:
                    self._host_states = self._gpu_states.states.copy_to_host()
            self._layout.unpack(self._host_states[:, index], arguments)
        return episode

    def _finish(self, index: int) -> None:
        self._restore(index)
        super()._finish(index)

    def _update_slot(self, index: int) -> None:
        """Do nothing: an episode that failed stays as it is."""

    def _run_slots(self, slots: NDArray[np.int64]) -> None:
        for error in self.switch_on().values():
            raise error
        self._launch(slots, None, self.steps)

    def _launch(
        self, slots: NDArray[np.int64], new_states: State | None, end_steps: NDArray[np.int64]
    ) -> None:
        """Run some slots on the GPU; with `new_states` (n_words, n_slots), switch their robots on."""
        speeds = self.speeds if self._sets_speeds and new_states is None else self.speeds[:0]
        arrays = self._arrays._replace(indices=slots, end_steps=end_steps, speeds=speeds)
        max_blocks = card.n_processors() * max(card.EPISODES_PER_PROCESSOR // BLOCK_SIZE, 1)
        n_blocks = min(-(-len(slots) // BLOCK_SIZE), max_blocks)
        with _LAUNCH_LOCK, kernel.compiling():
            if self._gpu_states is None:
                self._gpu_states = _GpuStates(self._layout, len(self._episodes))
            gpu_arrays = type(arrays)(*map(cuda.to_device, arrays))
            kernel.kernel(self._layout.capacity, self._model)[n_blocks, min(BLOCK_SIZE, len(slots))](
                kernel.Constants(**self._gpu_states.common_constants, **self._constants.on_gpu()),
                self._gpu_states.templates,
                self._layout.offsets,
                self._gpu_states.states,
                self._gpu_states.states if new_states is None else cuda.to_device(new_states),
                0 if new_states is None else -1,
                gpu_arrays,
            )
            for name in ("reasons", "registers", "poses"):
                getattr(gpu_arrays, name).copy_to_host(getattr(arrays, name))
            self._gpu_states.copy_outputs()
        self._host_states = None


class _GpuStates:
    """States of n slots on the GPU, with the constants that all of them share.

    Args:
        layout: Layout of the states.
        n_slots: Number of slots.

    Attributes:
        states: States on the GPU (n_words, n).
        templates: `kernel.LocalMemory` of arrays on the GPU.
        common_constants: Constants without rows, by name.
        outputs: Results of the last launch by the names of `EpisodeLayout.outputs`, each (n_words, n).
    """

    def __init__(self, layout: EpisodeLayout, n_slots: int) -> None:
        self._layout = layout
        self.states: Any = cuda.device_array((layout.n_state, n_slots), np.int64)
        templates = map(np.ascontiguousarray, layout.templates)
        self.templates = kernel.LocalMemory(*map(cuda.to_device, templates))
        controllers = layout.controllers
        self.common_constants = {
            "kind": controllers.kind,
            "recurrent": controllers.recurrent,
            "top_speed": controllers.top_speed,
            "terms": cuda.to_device(controllers.terms),
            "sizes": cuda.to_device(controllers.sizes),
            "line": cuda.to_device(controllers.line),
        }
        self.outputs: dict[str, Floats] = {}

    def copy_outputs(self) -> None:
        """Copy the outputs from the GPU."""
        for name, indices in self._layout.outputs.items():
            shape = len(indices), self.states.shape[1]
            values = self.states[indices.start : indices.stop].copy_to_host() if indices else np.zeros(shape)
            self.outputs[name] = values.view(np.float64)


class _RestoredEpisodes(Sequence[Episode]):
    """Episodes of a batch.

    Args:
        restore: Function that copies an episode from the GPU.
        count: Number of episodes.
    """

    def __init__(self, restore: Callable[[int], Episode], count: int) -> None:
        self._restore = restore
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            raise TypeError(
                f"{index} of episodes on a GPU; expected one index, as the next access may change it"
            )
        return self._restore(range(self._count)[index])


def _start_episode(episode: Episode, seed: int, options: EpisodeOptions) -> EpisodeArguments:
    """Start an episode; return its arguments for compiled code."""
    episode.begin(seed, options)
    if (call := episode.compiled_call) is None:
        raise PlaypenError(f"{episode.playpen.name}: lamps that change; expected steady ones on a GPU")
    return call[1]
