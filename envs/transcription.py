"""The passive part of a compiled model, written anew: what moves without the robot (section 4.1).

MuJoCo makes no spec of a compiled model, and the XML that a model came from is often not at hand or
no longer true. The compiled numbers are: they are copied into a fresh spec one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .physics_engine import mujoco
from .robot_parts import body_name, carrier, robot_bodies, tendon_bodies, touching_geoms

# What makes a tendon more than a thing that is measured.
_ACTS = ("stiffness", "damping", "frictionloss", "limited", "armature")
JOINT_SIZE = {0: (7, 6), 1: (4, 3), 2: (1, 1), 3: (1, 1)}  # of mjtJoint: positions, velocities
_OFF = mujoco.mjtDisableBit
_EQUALITIES = (mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_JOINT)


@dataclass
class Transcription:
    """A spec of the passive part, and where each of its things was in the model.

    Attributes:
        spec: not compiled yet; may be added to.
        bodies: body of the model -> name in the spec.
        added: body of the model -> body of the spec; older MuJoCo finds none by its name.
        joints: joint of the model -> name in the spec.
        standing: bodies that nothing moves within an episode and that are mocap bodies here.
        sites: site of the model -> name in the spec, of those that equalities are about.
    """

    spec: mujoco.MjSpec
    bodies: dict[int, str] = field(default_factory=dict)
    added: dict[int, Any] = field(default_factory=dict)
    joints: dict[int, str] = field(default_factory=dict)
    standing: list[int] = field(default_factory=list)
    sites: dict[int, str] = field(default_factory=dict)


def transcribe(
    model: mujoco.MjModel, data: mujoco.MjData, varying: frozenset[int] = frozenset()
) -> Transcription:
    """Write the passive part of a model into a fresh spec.

    Kept are the world, bodies without or with passive joints, their inertia, geoms that touch,
    pairs and excludes, equalities among them, and the options. What stands still hangs on the world
    here, at the pose that `data` has it at. Left out are the robot and its tendons, sensors and
    what is only seen.

    Args:
        model: any compiled model.
        data: its state, with the kinematics run.
        varying: bodies without a joint above them whose place changes from episode to episode;
            they become mocap bodies, so that all copies can share one model.

    Raises:
        ValueError: it has deformable things, geoms that a plugin shapes, tendons that pull at
            nothing but passive bodies, or no constraints.
    """
    if model.nflex:
        raise ValueError(
            "the scene has deformable parts, which the object's own scene cannot have yet"
        )
    if model.opt.disableflags & int(_OFF.mjDSBL_CONSTRAINT):
        raise ValueError(
            "the scene's options disable constraints, and with them contacts, which the object's "
            "own scene cannot do without"
        )
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    copied = Transcription(spec)
    _copy_options(model, spec)
    meshes: dict[tuple[str, int], str] = {}
    touching, robot = touching_geoms(model), robot_bodies(model)
    _check_tendons(model, robot)
    for body in np.flatnonzero(~robot):
        added = _add_body(model, data, int(body), varying, copied)
        first = int(model.body_geomadr[body])
        for geom in range(first, first + int(model.body_geomnum[body])):
            if touching[geom] or model.geom_fluid[geom, 0]:
                _add_geom(model, geom, added, spec, meshes)
    _add_contact_rules(model, copied)
    if not model.opt.disableflags & int(_OFF.mjDSBL_EQUALITY):
        _add_equalities(model, data, copied)
    return copied


def _check_tendons(model: mujoco.MjModel, robot: np.ndarray) -> None:
    """Raise a ValueError where a tendon does something to passive bodies alone."""
    tendons = model.eq_type == int(mujoco.mjtEq.mjEQ_TENDON)
    tied = {*model.eq_obj1id[tendons].tolist(), *model.eq_obj2id[tendons].tolist()}
    fields = [
        getattr(model, f"tendon_{name}") for name in _ACTS if hasattr(model, f"tendon_{name}")
    ]
    for tendon in range(model.ntendon):
        acts = tendon in tied or any(np.any(field[tendon]) for field in fields)
        bodies = list(tendon_bodies(model, tendon))
        passive = not robot[bodies].any() and any(carrier(model, body) for body in bodies)
        if acts and passive:
            named = model.tendon(tendon).name or tendon
            raise ValueError(
                f"tendon {named} pulls at {body_name(model, bodies[0])} and at nothing of the "
                "robot's, which the object's own scene cannot have yet; say it by stiffness, "
                "damping, limits and equalities of joints"
            )


def _copy_options(model: mujoco.MjModel, spec: mujoco.MjSpec) -> None:
    for name in dir(model.opt):
        if name.startswith("_"):
            continue
        value = getattr(model.opt, name)
        if isinstance(value, np.ndarray):
            getattr(spec.option, name)[:] = value
        else:
            setattr(spec.option, name, value)
    # The object is pulled by a weld, whatever the scene itself does without.
    spec.option.disableflags &= ~int(_OFF.mjDSBL_EQUALITY)


def _add_body(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    varying: frozenset[int],
    copied: Transcription,
) -> Any:
    """Add a body with its inertia and joints; what stands still goes below the world."""
    world = copied.spec.worldbody
    if body == 0:
        copied.bodies[0], copied.added[0] = "world", world
        return world
    name = copied.bodies[body] = body_name(model, body)
    if carrier(model, body) == 0:
        mocap = body in varying or model.body_mocapid[body] >= 0
        added = world.add_body(
            name=name, pos=data.xpos[body], quat=data.xquat[body], mocap=bool(mocap)
        )
        copied.added[body] = added
        _copy_inertia(model, body, added)
        if mocap:
            copied.standing.append(body)
        return added
    parent = copied.added[int(model.body_parentid[body])]
    added = parent.add_body(name=name, pos=model.body_pos[body], quat=model.body_quat[body])
    copied.added[body] = added
    _copy_inertia(model, body, added)
    added.gravcomp = float(model.body_gravcomp[body])
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        _add_joint(model, joint, added, copied)
    return added


def _copy_inertia(model: mujoco.MjModel, body: int, added: Any) -> None:
    added.explicitinertial = True
    added.mass = float(model.body_mass[body])
    added.ipos[:], added.iquat[:] = model.body_ipos[body], model.body_iquat[body]
    added.inertia[:] = model.body_inertia[body]


def _add_joint(model: mujoco.MjModel, joint: int, body: Any, copied: Transcription) -> None:
    name = copied.joints[joint] = model.joint(joint).name or f"joint:{joint}"
    dof, adr = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
    added = body.add_joint(
        name=name,
        type=mujoco.mjtJoint(int(model.jnt_type[joint])),
        pos=model.jnt_pos[joint],
        axis=model.jnt_axis[joint],
        range=model.jnt_range[joint],
        limited=int(model.jnt_limited[joint]),
        margin=float(model.jnt_margin[joint]),
        armature=float(model.dof_armature[dof]),
        frictionloss=float(model.dof_frictionloss[dof]),
        solref_limit=model.jnt_solref[joint],
        solimp_limit=model.jnt_solimp[joint],
        solref_friction=model.dof_solref[dof],
        solimp_friction=model.dof_solimp[dof],
        actgravcomp=int(model.jnt_actgravcomp[joint]),
    )
    if JOINT_SIZE[int(model.jnt_type[joint])][0] == 1:
        added.ref = float(model.qpos0[adr])
        added.springref = float(model.qpos_spring[adr])
    _set_polynomial(added, "stiffness", model, "jnt_stiffness", joint)
    _set_polynomial(added, "damping", model, "dof_damping", dof)


def _set_polynomial(joint: Any, name: str, model: mujoco.MjModel, field: str, row: int) -> None:
    """Set what newer MuJoCo has three coefficients of, and older one."""
    linear = float(getattr(model, field)[row])
    if np.ndim(getattr(joint, name)) == 0:
        setattr(joint, name, linear)
        return
    getattr(joint, name)[0] = linear
    getattr(joint, name)[1:] = getattr(model, f"{field}poly")[row]


def _add_geom(
    model: mujoco.MjModel,
    geom: int,
    body: Any,
    spec: mujoco.MjSpec,
    meshes: dict[tuple[str, int], str],
) -> None:
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    kinds = mujoco.mjtGeom
    if kind == kinds.mjGEOM_SDF or model.geom_plugin[geom] >= 0:
        raise ValueError(
            f"geom {model.geom(geom).name!r} is shaped by a plugin, which the object's own scene "
            "cannot have"
        )
    added = body.add_geom(
        name=_geom_name(model, geom),
        type=kind,
        pos=model.geom_pos[geom],
        quat=model.geom_quat[geom],
        contype=int(model.geom_contype[geom]),
        conaffinity=int(model.geom_conaffinity[geom]),
        condim=int(model.geom_condim[geom]),
        priority=int(model.geom_priority[geom]),
        friction=model.geom_friction[geom],
        solmix=float(model.geom_solmix[geom]),
        solref=model.geom_solref[geom],
        solimp=model.geom_solimp[geom],
        margin=float(model.geom_margin[geom]),
        gap=float(model.geom_gap[geom]),
        group=int(model.geom_group[geom]),
        rgba=model.geom_rgba[geom],
    )
    added.fluid_ellipsoid = model.geom_fluid[geom, 0]
    added.fluid_coefs[:] = model.geom_fluid[geom, 1:6]
    shape = int(model.geom_dataid[geom])
    if kind == kinds.mjGEOM_MESH:
        added.meshname = _mesh(model, shape, spec, meshes)
    elif kind == kinds.mjGEOM_HFIELD:
        added.hfieldname = _hfield(model, shape, spec, meshes)
        up = np.array([0.0, 0.0, model.hfield_size[shape, 2] * _heights(model, shape).min()])
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, up, model.geom_quat[geom])
        added.pos[:] = model.geom_pos[geom] + turned
    else:
        added.size[:] = model.geom_size[geom]


def _geom_name(model: mujoco.MjModel, geom: int) -> str:
    return str(model.geom(geom).name) or f"geom:{geom}"


def _mesh(
    model: mujoco.MjModel, mesh: int, spec: mujoco.MjSpec, done: dict[tuple[str, int], str]
) -> str:
    """Add a mesh as compiled, unless it is there; its frame is the compiler's to choose again."""
    if ("mesh", mesh) not in done:
        vertices = slice(int(model.mesh_vertadr[mesh]), None)
        faces = slice(int(model.mesh_faceadr[mesh]), None)
        added = spec.add_mesh(name=f"mesh:{mesh}")
        added.uservert = model.mesh_vert[vertices][: model.mesh_vertnum[mesh]].ravel()
        added.userface = model.mesh_face[faces][: model.mesh_facenum[mesh]].ravel()
        # Masses are given; of a surface that is not closed no other kind can be computed.
        added.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        done["mesh", mesh] = added.name
    return done["mesh", mesh]


def _hfield(
    model: mujoco.MjModel, field: int, spec: mujoco.MjSpec, done: dict[tuple[str, int], str]
) -> str:
    """Add a height field, unless it is there.

    The compiler stretches heights to [0, 1] anew: of those that an environment has written, the
    range is put into the size, and the least raises the geom and thickens what is below.
    """
    if ("hfield", field) not in done:
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        heights = _heights(model, field)
        low, high = float(heights.min()), float(heights.max())
        added = spec.add_hfield(name=f"hfield:{field}", nrow=rows, ncol=columns)
        added.size[:] = model.hfield_size[field]
        added.size[3] += added.size[2] * low
        if high > low:
            added.size[2] *= high - low
        added.userdata = heights.tolist()
        done["hfield", field] = added.name
    return done["hfield", field]


def _heights(model: mujoco.MjModel, field: int) -> np.ndarray:
    """Heights of a field, in parts of what its size says, (rows * columns,)."""
    first = int(model.hfield_adr[field])
    n = int(model.hfield_nrow[field] * model.hfield_ncol[field])
    heights: np.ndarray = model.hfield_data[first : first + n]
    return heights


def _add_contact_rules(model: mujoco.MjModel, copied: Transcription) -> None:
    """Pairs of geoms and excluded pairs of bodies, of which both are kept."""
    for pair in range(model.npair):
        geoms = [int(model.pair_geom1[pair]), int(model.pair_geom2[pair])]
        if all(int(model.geom_bodyid[geom]) in copied.bodies for geom in geoms):
            copied.spec.add_pair(
                geomname1=_geom_name(model, geoms[0]),
                geomname2=_geom_name(model, geoms[1]),
                condim=int(model.pair_dim[pair]),
                friction=model.pair_friction[pair],
                solref=model.pair_solref[pair],
                solreffriction=model.pair_solreffriction[pair],
                solimp=model.pair_solimp[pair],
                margin=float(model.pair_margin[pair]),
                gap=float(model.pair_gap[pair]),
            )
    for signature in model.exclude_signature:
        first, second = int(signature) >> 16, int(signature) & 0xFFFF
        if first in copied.bodies and second in copied.bodies:
            names = copied.bodies[first], copied.bodies[second]
            copied.spec.add_exclude(bodyname1=names[0], bodyname2=names[1])


def _add_equalities(model: mujoco.MjModel, data: mujoco.MjData, copied: Transcription) -> None:
    """Equalities between kept bodies, sites of theirs or joints, as `data` has them on or off."""
    for row in range(model.neq):
        kind = mujoco.mjtEq(int(model.eq_type[row]))
        if kind not in _EQUALITIES:
            continue
        of_joints = kind == mujoco.mjtEq.mjEQ_JOINT
        objects = int(mujoco.mjtObj.mjOBJ_JOINT if of_joints else model.eq_objtype[row])
        ids = [int(model.eq_obj1id[row]), int(model.eq_obj2id[row])]
        alone = of_joints and ids[1] < 0
        names = [_equated(model, objects, each, copied) for each in (ids[:1] if alone else ids)]
        if None in names:
            continue
        added = copied.spec.add_equality(
            type=kind,
            objtype=mujoco.mjtObj(int(model.eq_objtype[row])),
            name1=names[0],
            name2="" if alone else names[1],
            active=bool(data.eq_active[row]),
            solref=model.eq_solref[row],
            solimp=model.eq_solimp[row],
        )
        added.data[:11] = model.eq_data[row][:11]


def _equated(model: mujoco.MjModel, kind: int, thing: int, copied: Transcription) -> str | None:
    """The name of a joint, a body or a site that an equality is about; None, it is not kept."""
    if kind == int(mujoco.mjtObj.mjOBJ_JOINT):
        return copied.joints.get(thing)
    if kind == int(mujoco.mjtObj.mjOBJ_BODY):
        return copied.bodies.get(thing)
    if kind != int(mujoco.mjtObj.mjOBJ_SITE):
        return None
    body = int(model.site_bodyid[thing])
    if body not in copied.bodies:
        return None
    if thing not in copied.sites:
        copied.sites[thing] = f"site:{thing}"
        copied.added[body].add_site(
            name=copied.sites[thing], pos=model.site_pos[thing], quat=model.site_quat[thing]
        )
    return copied.sites[thing]
