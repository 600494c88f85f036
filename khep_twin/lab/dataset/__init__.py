"""Logs and rollouts as datasets for offline learning."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.dataset.episodes import OfflineEpisode as OfflineEpisode
    from khep_twin.lab.dataset.episodes import episodes_of as episodes_of
    from khep_twin.lab.dataset.minari_files import write_dataset as write_dataset
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
