"""Line images compiled by numba.

Imported only where numba is installed.
"""

# numba is not typed, nor are its functions.
# pyright: basic, reportMissingTypeStubs=false, reportCallIssue=false

from khep_twin import units
from khep_twin.sensing import line_faces, line_image, line_light, line_scene, mujoco_scene, noise
from khep_twin.sensing.line_faces import FacePoses, MovingFaces, place_faces
from khep_twin.sensing.line_image import take_image
from khep_twin.sensing.line_scene import Eye, LineScene
from khep_twin.simulation.compiled import compiled


def _capture(scene, n_fixed, moving, poses, eye, exposure_ms, tables, noise_key, image_number, pixels):
    surroundings, camera = LineScene(*scene), Eye(*eye)
    place_faces(surroundings, n_fixed, MovingFaces(*moving), FacePoses(*poses), camera)
    return take_image(surroundings, camera, exposure_ms, tables, noise_key, image_number, pixels)


capture = compiled(_capture, (units, noise, mujoco_scene, line_scene, line_light, line_image, line_faces))
"""`camera.capture`, compiled."""
