"""What this package uses of MuJoCo 3.3's compiled bindings, whose wheel has no type information of its own.

Arrays are views into the C structures: the shapes are those of MuJoCo's reference (mjModel, mjData).
"""

from enum import IntEnum
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

__version__: str

class mjtCamLight(IntEnum):
    mjCAMLIGHT_FIXED = ...

class mjtGeom(IntEnum):
    mjGEOM_SPHERE = ...
    mjGEOM_CYLINDER = ...
    mjGEOM_BOX = ...
    mjGEOM_MESH = ...

class mjtJoint(IntEnum):
    mjJNT_FREE = ...
    mjJNT_BALL = ...
    mjJNT_SLIDE = ...
    mjJNT_HINGE = ...

class mjtObj(IntEnum):
    mjOBJ_CAMERA = ...
    mjOBJ_GEOM = ...

class mjtRndFlag(IntEnum):
    mjRND_SHADOW = ...
    mjRND_REFLECTION = ...

class mjtStage(IntEnum):
    mjSTAGE_VEL = ...

class mjtState(IntEnum):
    mjSTATE_INTEGRATION = ...

class mjtVisFlag(IntEnum):
    mjVIS_CONVEXHULL = ...

class mjtWarning(IntEnum):
    mjWARN_BADQPOS = ...
    mjWARN_BADQVEL = ...
    mjWARN_BADQACC = ...

class _Named:
    """What `MjModel.body` and its like give: the fields of one of the model's things."""

    id: int
    name: str

class _Joint(_Named):
    dofadr: np.ndarray
    qposadr: np.ndarray

class _Camera(_Named):
    fovy: np.ndarray

class _CameraState:
    """What `MjData.camera` gives."""

    xmat: np.ndarray
    xpos: np.ndarray

class _Options:
    timestep: float

class _BodyState:
    """What `MjData.body` gives."""

    xpos: np.ndarray
    xquat: np.ndarray

class _Quality:
    shadowsize: int
    offsamples: int

class _Global:
    offwidth: int
    offheight: int

class _Visual:
    quality: _Quality
    global_: _Global

class MjModel:
    actuator_ctrlrange: np.ndarray
    nbody: int
    ncam: int
    ngeom: int
    nmesh: int
    nv: int
    body_jntnum: np.ndarray
    body_parentid: np.ndarray
    body_pos: np.ndarray
    body_quat: np.ndarray
    cam_pos: np.ndarray
    geom_aabb: np.ndarray
    geom_bodyid: np.ndarray
    geom_conaffinity: np.ndarray
    geom_contype: np.ndarray
    geom_dataid: np.ndarray
    geom_group: np.ndarray
    geom_matid: np.ndarray
    geom_size: np.ndarray
    geom_type: np.ndarray
    jnt_axis: np.ndarray
    jnt_bodyid: np.ndarray
    jnt_dofadr: np.ndarray
    jnt_limited: np.ndarray
    jnt_pos: np.ndarray
    jnt_qposadr: np.ndarray
    jnt_range: np.ndarray
    jnt_type: np.ndarray
    mat_texid: np.ndarray
    mesh_face: np.ndarray
    mesh_faceadr: np.ndarray
    mesh_facenormal: np.ndarray
    mesh_facenum: np.ndarray
    mesh_facetexcoord: np.ndarray
    mesh_graphadr: np.ndarray
    mesh_normal: np.ndarray
    mesh_normaladr: np.ndarray
    mesh_normalnum: np.ndarray
    mesh_texcoord: np.ndarray
    mesh_texcoordadr: np.ndarray
    mesh_texcoordnum: np.ndarray
    mesh_vert: np.ndarray
    mesh_vertadr: np.ndarray
    mesh_vertnum: np.ndarray
    site_pos: np.ndarray
    site_rgba: np.ndarray
    site_size: np.ndarray
    opt: _Options
    vis: _Visual
    @staticmethod
    def from_xml_string(xml: str) -> MjModel: ...
    def body(self, which: int | str) -> _Named: ...
    def actuator(self, which: int | str) -> _Named: ...
    def camera(self, which: int | str) -> _Camera: ...
    def joint(self, which: int | str) -> _Joint: ...

class _Contacts:
    geom: np.ndarray

class _Warning:
    number: int

class MjData:
    contact: _Contacts
    ctrl: np.ndarray
    mocap_pos: np.ndarray
    qM: np.ndarray
    qacc_warmstart: np.ndarray
    qfrc_bias: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    geom_xmat: np.ndarray
    geom_xpos: np.ndarray
    site_xmat: np.ndarray
    site_xpos: np.ndarray
    warning: list[_Warning]
    xipos: np.ndarray
    xanchor: np.ndarray
    xaxis: np.ndarray
    xmat: np.ndarray
    xpos: np.ndarray
    xquat: np.ndarray
    def __init__(self, model: MjModel) -> None: ...
    def body(self, which: int | str) -> _BodyState: ...
    def camera(self, which: int | str) -> _CameraState: ...

class _SpecLight:
    mode: int

class _SpecGeom:
    contype: int
    conaffinity: int

class _SpecBody:
    def add_camera(self, **values: object) -> object: ...
    def add_geom(self, **values: object) -> _SpecGeom: ...

class MjSpec:
    lights: list[_SpecLight]
    visual: _Visual
    worldbody: _SpecBody
    @staticmethod
    def from_file(filename: str) -> MjSpec: ...
    def geom(self, name: str) -> _SpecGeom: ...
    def compile(self) -> MjModel: ...

class MjvOption:
    flags: np.ndarray
    geomgroup: np.ndarray

class MjvScene:
    flags: np.ndarray

class Renderer:
    model: MjModel
    scene: MjvScene
    def __init__(self, model: MjModel, height: int = ..., width: int = ...) -> None: ...
    def update_scene(
        self, data: MjData, camera: int | str = ..., scene_option: MjvOption | None = ...
    ) -> None: ...
    def render(self) -> np.ndarray: ...
    def close(self) -> None: ...
    def __enter__(self) -> Renderer: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None: ...

def mj_comPos(m: MjModel, d: MjData) -> None: ...
def mj_forward(m: MjModel, d: MjData) -> None: ...
def mj_forwardSkip(m: MjModel, d: MjData, skipstage: int, skipsensor: int) -> None: ...
def mj_getState(m: MjModel, d: MjData, state: np.ndarray, spec: int) -> None: ...
def mj_fullM(m: MjModel, dst: np.ndarray, M: np.ndarray) -> None: ...
def mj_id2name(m: MjModel, type: int, id: int) -> str | None: ...
def mj_jacSite(m: MjModel, d: MjData, jacp: np.ndarray, jacr: np.ndarray, site: int) -> None: ...
def mj_kinematics(m: MjModel, d: MjData) -> None: ...
def mj_jac(
    m: MjModel, d: MjData, jacp: np.ndarray, jacr: np.ndarray, point: np.ndarray, body: int
) -> None: ...
def mj_name2id(m: MjModel, type: int, name: str) -> int: ...
def mj_ray(
    m: MjModel,
    d: MjData,
    pnt: np.ndarray,
    vec: np.ndarray,
    geomgroup: np.ndarray | None,
    flg_static: int,
    bodyexclude: int,
    geomid: np.ndarray,
) -> float: ...
def mj_resetData(m: MjModel, d: MjData) -> None: ...
def mj_setState(m: MjModel, d: MjData, state: np.ndarray, spec: int) -> None: ...
def mj_stateSize(m: MjModel, spec: int) -> int: ...
def mj_step(m: MjModel, d: MjData, nstep: int = ...) -> None: ...
def mj_step1(m: MjModel, d: MjData) -> None: ...
def mj_step2(m: MjModel, d: MjData) -> None: ...
def mju_axisAngle2Quat(res: np.ndarray, axis: ArrayLike, angle: float) -> None: ...
def mju_mat2Quat(quat: np.ndarray, mat: ArrayLike) -> None: ...
def mju_mulQuat(res: np.ndarray, quat1: ArrayLike, quat2: ArrayLike) -> None: ...
def mju_quat2Mat(res: np.ndarray, quat: ArrayLike) -> None: ...
def mju_quat2Vel(res: np.ndarray, quat: ArrayLike, dt: float) -> None: ...
