"""Challenges: tasks for controller files, with a score that repeats, and tables of a class's results."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.challenge.attempt import Attempt as Attempt
    from khep_twin.lab.challenge.attempt import score_file as score_file
    from khep_twin.lab.challenge.challenge import Challenge as Challenge
    from khep_twin.lab.challenge.challenge import ChallengeFile as ChallengeFile
    from khep_twin.lab.challenge.challenge import load as load
    from khep_twin.lab.challenge.scoring import Score as Score
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
