"""Datasets of Minari (extra `minari`): a dataset is written completely or not at all.

    FOLDER/NAMESPACE/NAME-v0/data    found by minari.load_dataset("NAMESPACE/NAME-v0")
                                     with MINARI_DATASETS_PATH=FOLDER

The data are HDF5, Minari's default. The same episodes give the same bytes.
"""

# Minari is not typed, and Gymnasium only partly; a development environment may lack Minari.
# pyright: reportMissingImports=false, reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from khep_twin.envs.gymnasium import register
from khep_twin.envs.tasks import Task
from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.files.folders import atomic_folder
from khep_twin.files.paths import StrPath
from khep_twin.lab.dataset.episodes import OfflineEpisode

try:
    import gymnasium
    import h5py  # noqa: F401  # pyright: ignore[reportUnusedImport]  # Minari needs it later
    import minari
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.spaces import Box, Space
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage
except ModuleNotFoundError as error:
    raise MissingExtraError(error.name or "minari", "minari") from error

_ID = re.compile(r"([A-Za-z0-9_-]{2,}/)*[A-Za-z0-9_-]+-v[0-9]+")


def spec_of(task: Task, period_ns: int) -> EnvSpec:
    """Return the specification of a shipped task's environment with a control period [ns]."""
    register()
    spec = gymnasium.spec(f"khep_twin/{task.name}-v0")
    return replace(spec, kwargs={**spec.kwargs, "period_ns": period_ns})


def spaces_of(task: Task) -> tuple[Space[Any], Space[Any]]:
    """Return the observation space and action space of a task, normalized."""
    low, high = task.bounds()
    return Box(low, high, dtype=np.float32), Box(-1, 1, (2,), np.float32)


def check_new_dataset(folder: Path, dataset_id: str, force: bool) -> Path:
    """Return the path of a dataset.

    Raises:
        KhepTwinError: The id is malformed, or the path exists and may not be replaced.
    """
    if not _ID.fullmatch(dataset_id):
        raise KhepTwinError(f"dataset {dataset_id!r}: expected an id such as khepera/avoid-v0")
    path = folder / dataset_id
    if path.exists() and not (force and (path / "data" / "metadata.json").is_file()):
        hint = "no dataset; expected another id" if force else "expected another id, or --force to replace it"
        raise KhepTwinError(f"{path}: is there already{', ' if force else '; '}{hint}")
    return path


def write_dataset(
    folder: StrPath,
    dataset_id: str,
    episodes: Iterable[OfflineEpisode],
    spec: EnvSpec | None,
    spaces: tuple[Space[Any], Space[Any]] | None = None,
    *,
    description: str = "",
    force: bool = False,
) -> tuple[int, int]:
    """Write a dataset; return the numbers of its episodes and steps.

    Args:
        folder: Folder of datasets, as in MINARI_DATASETS_PATH.
        dataset_id: Id of the dataset, e.g. "khepera/avoid-v0".
        episodes: Episodes, written one by one.
        spec: Specification of their environment.
        spaces: Observation space and action space; by default those of the environment.
        description: Description of the dataset.
        force: Whether a dataset of this id is replaced.

    Raises:
        KhepTwinError: The dataset exists already, or cannot be written; no partial dataset remains.
    """
    target = check_new_dataset(Path(folder), dataset_id, force)
    observations, actions = spaces or (None, None)
    try:
        with atomic_folder(target, force) as folder:
            (data := folder / "data").mkdir()
            storage = MinariStorage.new(data, observations, actions, spec, data_format="hdf5")
            storage.update_metadata(
                {"dataset_id": dataset_id, "minari_version": minari.__version__, "description": description}
            )
            sources: list[dict[str, str]] = []
            for episode in episodes:
                storage.update_episodes([_buffer(episode)])
                sources.append(dict(episode.source))
            storage.update_episode_metadata(sources)
            n_episodes, n_steps = storage.total_episodes, storage.total_steps
    except OSError as error:
        raise KhepTwinError(f"{target}: cannot be written: {error.strerror}") from error
    return n_episodes, n_steps


def _buffer(episode: OfflineEpisode) -> Any:
    # Minari's annotations name only lists, but it also accepts arrays.
    names = ("observations", "actions", "rewards", "terminations", "truncations")
    arrays: dict[str, Any] = {name: getattr(episode, name) for name in names}
    # Minari cannot read back one-dimensional arrays.
    infos = {name: values.tolist() for name, values in episode.infos.items()}
    return EpisodeBuffer(seed=episode.seed, infos=infos, **arrays)
