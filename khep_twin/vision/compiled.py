"""Line images compiled by numba.

Imported only where numba is installed.
"""

# numba is not typed, and its functions have no types of their own.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from khep_twin import units
from khep_twin.sensing import line_faces, line_image, line_light, line_scene, mujoco_scene, noise
from khep_twin.sensing.line_faces import MovingFaces, Places, set_out
from khep_twin.sensing.line_image import take_image
from khep_twin.sensing.line_scene import Eye, LineScene
from khep_twin.simulation.compiled import compiled


def _see(scene, n_fixed, moving, at, eye, exposure_ms, tables, key, number, pixels):
    faces, count, lamps, room, depths, lights, owners, lit, sums = scene
    around = LineScene(faces, count, lamps, room, depths, lights, owners, lit, sums)
    geoms, kinds, sizes, greys, roles, stripes, stripe_sizes, stripe_greys = moving
    movable = MovingFaces(geoms, kinds, sizes, greys, roles, stripes, stripe_sizes, stripe_greys)
    geom_places, geom_turns, site_places, site_turns = at
    x, y, height, ahead, left = eye
    stands = Eye(x, y, height, ahead, left)
    set_out(around, n_fixed, movable, Places(geom_places, geom_turns, site_places, site_turns), stands)
    return take_image(around, stands, exposure_ms, tables, key, number, pixels)


see = compiled(_see, (units, noise, mujoco_scene, line_scene, line_light, line_image, line_faces))
"""`camera.see`, compiled."""
