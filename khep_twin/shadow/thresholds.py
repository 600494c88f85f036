"""Thresholds of the diagnosis, in one place; those without a source were chosen on stand-in robots.

`python -m studies twin-trials` prints what they lead to, on robots, hosts and seeds not used for that.
"""

import math
from dataclasses import dataclass

from khep_twin.clock import NS_PER_S


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds of a diagnosis.

    Attributes:
        known: Standard deviation of a known position [m] (assumed).
        known_turn: Standard deviation of a known heading [rad] (assumed).
        lit: Standard deviation of a position by which lamps are compared, at the most [m] (assumed).
        lit_turn: The same of a heading [rad] (assumed).
        usual: Surprise of one reading that is usual (assumed).
        surprise_s: Time constant over which surprise is summed [s].
        surprised: Sum of one sensor from which on a pose is unsure.
        startled: Sum of one sensor from which on what has happened is searched for.
        most_startled: The same after searches that have found nothing, at the most.
        raised: Factor of each of them.
        raised_s: Time constant with which it falls again [s].
        calm: Sum of any sensor below which replies do not surprise, or a tenth of what they do later.
        in_sight: Counts of a reading that confirms a pose.
        waited_ns: Time after the begin of the surprise before the search [ns].
        tried_ns: Longest interval of searches while replies surprise: half the time that they repeat [ns].
        explained: Probability that nothing has happened, below which something does.
        window_ns: Time before now from which on something may have happened [ns].
        dropped: Probability that nothing has, above which faults are not considered any more.
        dropped_ns: Time after a search for which they are [ns].
        found_ns: Time of a known pose, without surprise that lasts, after which a search has found it [ns].
        proven_ns: Time after that from which on faults are told: before it another place is the likelier
            explanation [ns].
        begun_ns: Time after a known start from which on they are: it is known to about a centimetre [ns].
        suspected: Probability from which on a fault is suspected (assumed), before the next factor.
        believed: Factor of a suspicion's probability: what is not considered may be the reason as well. Of
            180 suspicions with 80 % or more, before this factor, 122 were right (faults, seeds 930 to 959).
        sure: Probability from which on there is one of faults that look alike: that of an alarm.
        surest: Highest probability that an alarm tells.
        named: Part of that probability that one of them has, to give the alarm its name.
        replies: Replies from which something may be told, however long they take.
        told_ns: Time for which replies show a fault before an alarm, and for which they surprise until a pose
            counts as unknown [ns].
        held_ns: Time for which it stays so probable before an alarm, and after which a pose is unsure, or
            followed again [ns].
        unnamed_ns: Time after which an alarm has all names, if none of them has that part [ns].
        settled_ns: Time after an alarm from which on the fault is taken for granted, and others may begin
            [ns].
    """

    known: float = 0.025
    known_turn: float = math.radians(10)
    lit: float = 0.012
    lit_turn: float = math.radians(4)
    usual: float = 0.15
    surprise_s: float = 0.7
    surprised: float = 3.0
    startled: float = 2.0
    most_startled: float = 8.0
    raised: float = 2.0
    raised_s: float = 10.0
    calm: float = 0.3
    in_sight: int = 100
    waited_ns: int = 200_000_000
    tried_ns: int = 2 * NS_PER_S
    explained: float = 0.5
    window_ns: int = 6 * NS_PER_S
    dropped: float = 0.9
    dropped_ns: int = 1_500_000_000
    found_ns: int = 5 * NS_PER_S
    proven_ns: int = 15 * NS_PER_S
    begun_ns: int = 4 * NS_PER_S
    suspected: float = 0.2
    believed: float = 0.7
    sure: float = 0.95
    surest: float = 0.999
    named: float = 0.8
    replies: int = 3
    told_ns: int = NS_PER_S
    held_ns: int = 400_000_000
    unnamed_ns: int = 1_500_000_000
    settled_ns: int = 5 * NS_PER_S


THRESHOLDS = Thresholds()
"""Thresholds of every shadow."""
