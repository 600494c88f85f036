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
        usual: Surprise of one reading that is usual (assumed).
        surprise_s: Time constant over which surprise is summed [s].
        surprised: Sum of one sensor from which on the robot may be elsewhere.
        startled: Sum of one sensor without which no fault has begun: what explains readings a little better
            for long explains errors of the model.
        waited_ns: Time for which replies surprise before the robot is looked for everywhere [ns].
        tried_ns: Interval at which it is [ns].
        window_ns: Time before now from which on it is looked for [ns].
        earlier_ns: Time by which a fault may seem to begin before replies surprise [ns].
        elsewhere: Logarithm of the odds from which on it is elsewhere, where no fault explains the replies.
        rather: Logarithm of the odds from which on it is elsewhere instead of having a fault.
        found_ns: Time of a known pose, without surprise that lasts, after which a search has found it [ns].
        proven_ns: Time after that from which on faults are told: before it another place is the likelier
            explanation [ns].
        suspected: Probability from which on a fault is suspected (assumed).
        sure: Probability from which on there is one of faults that look alike: that of an alarm.
        named: Part of that probability that one of them has, to give the alarm its name.
        told_ns: Time for which replies show a fault before an alarm [ns].
        held_ns: Time for which it stays so probable before an alarm, and after which a pose is unsure, or
            followed again [ns].
        unnamed_ns: Time after which an alarm has all names, if none of them has that part [ns].
        settled_ns: Time after an alarm from which on the fault is taken for granted, and others may begin
            [ns].
    """

    known: float = 0.025
    known_turn: float = math.radians(10)
    usual: float = 0.15
    surprise_s: float = 0.7
    surprised: float = 3.0
    startled: float = 1.2
    waited_ns: int = NS_PER_S
    tried_ns: int = NS_PER_S
    window_ns: int = 1_300_000_000
    earlier_ns: int = NS_PER_S // 2
    elsewhere: float = 9.0
    rather: float = 0.0
    found_ns: int = 5 * NS_PER_S
    proven_ns: int = 15 * NS_PER_S
    suspected: float = 0.2
    sure: float = 0.95
    named: float = 0.8
    told_ns: int = NS_PER_S
    held_ns: int = 400_000_000
    unnamed_ns: int = 1_500_000_000
    settled_ns: int = 5 * NS_PER_S


THRESHOLDS = Thresholds()
"""Thresholds of every shadow."""
