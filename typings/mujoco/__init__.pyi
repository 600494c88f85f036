"""The part of MuJoCo's Python interface that khep_twin uses; MuJoCo ships no types of its own."""

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

__file__: str
__version__: str
mjMAXVAL: float

class mjtGeom(IntEnum):
    mjGEOM_PLANE = ...
    mjGEOM_SPHERE = ...
    mjGEOM_CAPSULE = ...
    mjGEOM_ELLIPSOID = ...
    mjGEOM_CYLINDER = ...
    mjGEOM_BOX = ...

class mjtIntegrator(IntEnum):
    mjINT_IMPLICITFAST = ...

class mjtDisableBit(IntEnum):
    mjDSBL_AUTORESET = ...
    mjDSBL_ISLAND = ...
    mjDSBL_MULTICCD = ...
    mjDSBL_SENSOR = ...

class mjtEnableBit(IntEnum):
    mjENBL_SLEEP = ...

class mjtLightType(IntEnum):
    mjLIGHT_DIRECTIONAL = ...

class mjtCone(IntEnum):
    mjCONE_ELLIPTIC = ...

class mjtWarning(IntEnum): ...

class _Named:
    """A view of one element of a model; which fields it has depends on its kind."""

    id: int
    name: str
    bodyid: NDArray[np.int32]
    subtreemass: NDArray[np.float64]
    invweight0: NDArray[np.float64]
    adr: NDArray[np.int32]
    dim: NDArray[np.int32]
    fovy: NDArray[np.float64]
    dofadr: NDArray[np.int32]
    qposadr: NDArray[np.int32]
    pos: NDArray[np.float64]
    size: NDArray[np.float64]

class MjStatistic:
    meaninertia: float

class MjVisualHeadlight:
    ambient: NDArray[np.float32]
    diffuse: NDArray[np.float32]

class MjVisual:
    headlight: MjVisualHeadlight

class MjModel:
    nbody: int
    ngeom: int
    nv: int
    nsensor: int
    nsite: int
    nuser_site: int
    nlight: int
    nmesh: int
    names: bytes
    vis: MjVisual
    light_active: NDArray[np.uint8]
    light_type: NDArray[np.int32]
    light_ambient: NDArray[np.float32]
    light_diffuse: NDArray[np.float32]
    mat_rgba: NDArray[np.float32]
    mesh_vertadr: NDArray[np.int32]
    mesh_vertnum: NDArray[np.int32]
    mesh_vert: NDArray[np.float32]
    mesh_faceadr: NDArray[np.int32]
    mesh_facenum: NDArray[np.int32]
    mesh_face: NDArray[np.int32]
    geom_dataid: NDArray[np.int32]
    body_mocapid: NDArray[np.int32]
    body_parentid: NDArray[np.int32]
    body_pos: NDArray[np.float64]
    body_quat: NDArray[np.float64]
    body_invweight0: NDArray[np.float64]
    body_inertia: NDArray[np.float64]
    body_jntadr: NDArray[np.int32]
    body_jntnum: NDArray[np.int32]
    jnt_qposadr: NDArray[np.int32]
    body_mass: NDArray[np.float64]
    body_rootid: NDArray[np.int32]
    body_weldid: NDArray[np.int32]
    body_subtreemass: NDArray[np.float64]
    dof_M0: NDArray[np.float64]
    dof_bodyid: NDArray[np.int32]
    dof_armature: NDArray[np.float64]
    dof_frictionloss: NDArray[np.float64]
    dof_invweight0: NDArray[np.float64]
    qpos0: NDArray[np.float64]
    cam_bodyid: NDArray[np.int32]
    cam_pos: NDArray[np.float64]
    cam_quat: NDArray[np.float64]
    cam_fovy: NDArray[np.float64]
    cam_resolution: NDArray[np.int32]
    geom_bodyid: NDArray[np.int32]
    geom_group: NDArray[np.int32]
    geom_pos: NDArray[np.float64]
    geom_quat: NDArray[np.float64]
    geom_rbound: NDArray[np.float64]
    opt: MjsOption
    stat: MjStatistic
    pair_margin: NDArray[np.float64]
    pair_friction: NDArray[np.float64]
    pair_geom1: NDArray[np.int32]
    pair_geom2: NDArray[np.int32]
    actuator_gainprm: NDArray[np.float64]
    actuator_ctrlrange: NDArray[np.float64]
    geom_rgba: NDArray[np.float32]
    geom_friction: NDArray[np.float64]
    geom_size: NDArray[np.float64]
    geom_aabb: NDArray[np.float64]
    geom_type: NDArray[np.int32]
    geom_user: NDArray[np.float64]
    sensor_interval: NDArray[np.float64]
    site_bodyid: NDArray[np.int32]
    site_pos: NDArray[np.float64]
    site_quat: NDArray[np.float64]
    site_rgba: NDArray[np.float32]
    site_size: NDArray[np.float64]
    site_type: NDArray[np.int32]
    site_user: NDArray[np.float64]

    @staticmethod
    def from_xml_path(filename: str) -> MjModel: ...
    @staticmethod
    def from_xml_string(xml: str) -> MjModel: ...
    def actuator(self, name: str) -> _Named: ...
    def body(self, name: str | int) -> _Named: ...
    def camera(self, name: str) -> _Named: ...
    def geom(self, name: str | int) -> _Named: ...
    def joint(self, name: str) -> _Named: ...
    def sensor(self, name: str) -> _Named: ...
    def site(self, name: str | int) -> _Named: ...

class _Warnings:
    number: NDArray[np.int32]

class _Contacts:
    efc_address: NDArray[np.int32]
    geom: NDArray[np.int32]

class MjData:
    actuator_force: NDArray[np.float64]
    cam_xmat: NDArray[np.float64]
    cam_xpos: NDArray[np.float64]
    contact: _Contacts
    ctrl: NDArray[np.float64]
    cvel: NDArray[np.float64]
    geom_xmat: NDArray[np.float64]
    site_xpos: NDArray[np.float64]
    site_xmat: NDArray[np.float64]
    geom_xpos: NDArray[np.float64]
    history: NDArray[np.float64]
    light_xpos: NDArray[np.float64]
    light_xdir: NDArray[np.float64]
    model: MjModel
    qpos: NDArray[np.float64]
    qvel: NDArray[np.float64]
    sensordata: NDArray[np.float64]
    subtree_com: NDArray[np.float64]
    warning: _Warnings
    xmat: NDArray[np.float64]
    xpos: NDArray[np.float64]
    xquat: NDArray[np.float64]

    def __init__(self, model: MjModel) -> None: ...

class MjvCamera:
    lookat: NDArray[np.float64]
    distance: float
    azimuth: float
    elevation: float

class MjvOption:
    flags: NDArray[np.uint8]

class Renderer:
    def __init__(self, model: MjModel, height: int, width: int, max_geom: int = 10000) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(self, *error: object) -> None: ...
    def update_scene(
        self, data: MjData, camera: MjvCamera, scene_option: MjvOption | None = None
    ) -> None: ...
    def render(self) -> NDArray[np.uint8]: ...
    def close(self) -> None: ...

class MjsOption:
    timestep: float
    gravity: NDArray[np.float64]
    integrator: int
    cone: int
    impratio: float
    noslip_iterations: int
    disableflags: int
    enableflags: int

class MjsGeom:
    name: str
    conaffinity: int
    group: int
    type: mjtGeom
    contype: int
    mass: float
    pos: Sequence[float]
    quat: Sequence[float]
    rgba: Sequence[float]
    size: Sequence[float]
    solimp: Sequence[float]
    solref: Sequence[float]
    userdata: Sequence[float]

class MjsPair:
    solref: Sequence[float]
    solimp: Sequence[float]
    solreffriction: Sequence[float]
    margin: float

class MjsJoint:
    frictionloss: float

class MjsSensor:
    name: str
    interval: Sequence[float]

class MjsKey:
    name: str
    ctrl: Sequence[float]

class MjsFrame: ...

class MjsOrientation:
    xyaxes: Sequence[float]

class MjsCamera:
    alt: MjsOrientation
    pos: Sequence[float]

class MjsActuator:
    def set_to_dcmotor(self, motorconst: Sequence[float], resistance: float) -> None: ...

class MjsBody:
    pos: Sequence[float]
    mass: float
    inertia: Sequence[float]

    def add_body(self, **attributes: Any) -> MjsBody: ...
    def add_frame(self, **attributes: Any) -> MjsFrame: ...
    def add_freejoint(self) -> None: ...
    def add_geom(self, **attributes: Any) -> MjsGeom: ...
    def add_light(self, **attributes: Any) -> None: ...
    def add_site(self, **attributes: Any) -> None: ...

class MjSpec:
    modelname: str
    nuser_geom: int
    nuser_site: int
    option: MjsOption
    visual: Any
    worldbody: MjsBody
    geoms: Sequence[MjsGeom]
    keys: Sequence[MjsKey]
    actuators: Sequence[MjsActuator]
    pairs: Sequence[MjsPair]
    sensors: Sequence[MjsSensor]

    @staticmethod
    def from_file(filename: str) -> MjSpec: ...
    def add_pair(self, **attributes: Any) -> MjsPair: ...
    def add_key(self, **attributes: Any) -> None: ...
    def body(self, name: str) -> MjsBody: ...
    def geom(self, name: str) -> MjsGeom: ...
    def actuator(self, name: str) -> MjsActuator: ...
    def joint(self, name: str) -> MjsJoint: ...
    def attach(self, child: MjSpec, *, prefix: str, frame: MjsFrame) -> MjsFrame: ...
    def camera(self, name: str) -> MjsCamera: ...
    def compile(self) -> MjModel: ...
    def delete(self, element: MjsKey) -> None: ...
    def to_xml(self) -> str: ...

def set_mju_user_warning(handler: Callable[[str], None]) -> None: ...
def mj_forward(model: MjModel, data: MjData) -> None: ...
def mj_fullM(model: MjModel, data: MjData, dst: NDArray[np.float64]) -> None: ...
def mju_quat2Mat(res: NDArray[np.float64], quat: NDArray[np.float64]) -> None: ...
def mj_kinematics(model: MjModel, data: MjData) -> None: ...
def mj_resetData(model: MjModel, data: MjData) -> None: ...
def mj_camlight(model: MjModel, data: MjData) -> None: ...
def mj_comPos(model: MjModel, data: MjData) -> None: ...
def mj_setConst(model: MjModel, data: MjData) -> None: ...
def mju_mat2Quat(quat: NDArray[np.float64], mat: NDArray[np.float64]) -> None: ...
def mj_sensorPos(model: MjModel, data: MjData) -> None: ...
def mju_mulPose(
    posres: NDArray[np.float64],
    quatres: NDArray[np.float64],
    pos1: NDArray[np.float64],
    quat1: NDArray[np.float64],
    pos2: NDArray[np.float64],
    quat2: NDArray[np.float64],
) -> None: ...
def mj_step(model: MjModel, data: MjData, nstep: int = 1) -> None: ...
def mju_rayGeom(
    pos: NDArray[np.float64],
    mat: NDArray[np.float64],
    size: NDArray[np.float64],
    pnt: NDArray[np.float64],
    vec: NDArray[np.float64],
    geomtype: int,
    normal: NDArray[np.float64] | None,
) -> float: ...
def mj_ray(
    model: MjModel,
    data: MjData,
    pnt: NDArray[np.float64],
    vec: NDArray[np.float64],
    geomgroup: NDArray[np.uint8] | None,
    flg_static: bool,
    bodyexclude: int,
    geomid: NDArray[np.int32] | None,
) -> float: ...
def mj_multiRay(
    model: MjModel,
    data: MjData,
    pnt: NDArray[np.float64],
    vec: NDArray[np.float64],
    geomgroup: NDArray[np.uint8] | None,
    flg_static: bool,
    bodyexclude: int,
    geomid: NDArray[np.int32],
    dist: NDArray[np.float64],
    normal: NDArray[np.float64] | None,
    nray: int,
    cutoff: float,
) -> None: ...
