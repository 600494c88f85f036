"""Turns until a thing with several dark stripes is in the line image, and drives to it."""

from itertools import groupby

from khep_twin import Vision

DARK = 100  # greys: a white wall has some 180, a black stripe 10
GAP = 14  # pixels between two dark stripes of the same thing, at most
NEAR = 38  # pixels between its outer stripes at the end
AHEAD = 31.5  # pixel straight ahead

side = -1


def striped(image):
    """Return the middle and the width of the widest striped thing in an image [pixels]; None without one."""
    stripes = [[*run] for dark, run in groupby(range(64), lambda pixel: image[pixel] < DARK) if dark]
    things = []
    for stripe in stripes:
        if things and stripe[0] - things[-1][-1][-1] <= GAP:
            things[-1].append(stripe)
        else:
            things.append([stripe])
    ends = [(thing[0][0], thing[-1][-1]) for thing in things if len(thing) > 1]
    if not ends:
        return None
    left, right = max(ends, key=lambda each: each[1] - each[0])
    return (left + right) / 2, right - left


def controller(robot):
    global side
    thing = striped(Vision(robot).image())
    if thing is None:
        robot.set_speed(2 * side, -2 * side)  # to where it was last
        return
    middle, width = thing
    side = 1 if middle > AHEAD else -1
    if width >= NEAR:
        robot.set_speed(0, 0)
    else:
        forward, turn = (8, 0) if abs(middle - AHEAD) < 12 else (4, side)
        robot.set_speed(forward + turn, forward - turn)
