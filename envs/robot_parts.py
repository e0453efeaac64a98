"""Which bodies of a compiled model are the robot's, which move with each other, which touch."""

from __future__ import annotations

import numpy as np

from .physics_engine import mujoco

_PULLS = (mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_CONNECT)


def robot_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Whether each body belongs to a robot, bool (nbody,).

    A robot is what hangs on the first joint of a chain that an actuator drives, or a mocap body
    that pulls. Such mocap bodies belong to it, those too that the model has switched off, as
    suction is; joints without an actuator do not make a robot.
    """
    robot = np.zeros(model.nbody, dtype=bool)
    for body in _driven(model):
        root = first_jointed(model, body)
        if root:
            robot[root] = True
    for body in range(1, model.nbody):  # parents come before their children
        robot[body] |= robot[model.body_parentid[body]]
    for mocap, _, _ in pulled(model):
        robot[mocap] = True
    return robot


def robot_roots(model: mujoco.MjModel) -> list[int]:
    """The robot's bodies that hang on nothing of it."""
    robot = robot_bodies(model)
    roots = np.flatnonzero(robot & ~robot[model.body_parentid])
    return [int(body) for body in roots]


def passive_roots(model: mujoco.MjModel) -> list[int]:
    """Bodies with joints of their own that are not the robot's."""
    passive = (model.body_jntnum > 0) & ~robot_bodies(model)
    return [int(body) for body in np.flatnonzero(passive)]


def first_jointed(model: mujoco.MjModel, body: int) -> int:
    """The body nearest to the world on the way to this one that has a joint; 0, none has."""
    first = 0
    while body:
        if model.body_jntnum[body]:
            first = body
        body = int(model.body_parentid[body])
    return first


def carrier(model: mujoco.MjModel, body: int) -> int:
    """The body with the joints that this one is rigidly fixed to, maybe itself; 0, none has any."""
    root = int(model.body_weldid[body])
    return root if model.body_jntnum[root] else 0


def standing(model: mujoco.MjModel) -> np.ndarray:
    """Whether each body has no joint above it, bool (nbody,).

    What a mocap body carries is fixed to the world before MuJoCo 4.0, and to the mocap body since.
    """
    return model.body_jntnum[model.body_weldid] == 0


def rigid_group(model: mujoco.MjModel, body: int) -> np.ndarray:
    """The bodies that are rigidly fixed to each other and to this one, (n,)."""
    return np.flatnonzero(model.body_weldid == model.body_weldid[body])


def body_name(model: mujoco.MjModel, body: int) -> str:
    """A body's name, or "body 7" where it has none."""
    return str(model.body(body).name) or f"body {body}"


def touching_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Whether each geom can touch anything, bool (ngeom,)."""
    touching: np.ndarray = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    touching[model.pair_geom1] = True
    touching[model.pair_geom2] = True
    return touching


def _driven(model: mujoco.MjModel) -> set[int]:
    """Bodies that an actuator or a pulling mocap body moves."""
    kinds = mujoco.mjtTrn
    driven = {body for _, body, row in pulled(model) if model.eq_active0[row]}
    for kind, target in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True):
        kind = int(kind)
        if kind in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT)):
            driven.add(int(model.jnt_bodyid[target]))
        elif kind == int(kinds.mjTRN_TENDON):
            driven |= tendon_bodies(model, int(target))
        elif kind == int(kinds.mjTRN_BODY):
            driven.add(int(target))
        elif kind in (int(kinds.mjTRN_SITE), int(kinds.mjTRN_SLIDERCRANK)):
            driven.add(int(model.site_bodyid[target]))
    return driven


def tendon_bodies(model: mujoco.MjModel, tendon: int) -> set[int]:
    """The bodies whose joints or sites a tendon runs over."""
    first = int(model.tendon_adr[tendon])
    bodies: set[int] = set()
    for wrap in range(first, first + int(model.tendon_num[tendon])):
        kind, target = int(model.wrap_type[wrap]), int(model.wrap_objid[wrap])
        if kind == int(mujoco.mjtWrap.mjWRAP_JOINT):
            bodies.add(int(model.jnt_bodyid[target]))
        elif kind == int(mujoco.mjtWrap.mjWRAP_SITE):
            bodies.add(int(model.site_bodyid[target]))
    return bodies


def touchable(model: mujoco.MjModel) -> np.ndarray:
    """Whether a body, or what it hangs on or carries, has geoms that can touch, bool (nbody,)."""
    roots = model.body_rootid[model.geom_bodyid[touching_geoms(model)]]
    found: np.ndarray = np.isin(model.body_rootid, roots)
    return found


def pulled(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """Mocap bodies, the body that each is welded or connected to, and the equality that does it."""
    found = []
    for row in range(model.neq):
        if int(model.eq_type[row]) not in map(int, _PULLS):
            continue
        bodies = equated_bodies(model, row)
        for mocap, body in (bodies, bodies[::-1]):
            if model.body_mocapid[mocap] >= 0 and body:
                found.append((mocap, body, row))
    return found


def equated_bodies(model: mujoco.MjModel, row: int) -> list[int]:
    """The bodies that an equality is about, two of bodies or sites, one or two of joints."""
    things = [int(model.eq_obj1id[row]), int(model.eq_obj2id[row])]
    kind = int(model.eq_type[row])
    if kind == int(mujoco.mjtEq.mjEQ_JOINT):
        return [int(model.jnt_bodyid[joint]) for joint in things if joint >= 0]
    if kind not in map(int, _PULLS):
        return []
    of_sites = int(model.eq_objtype[row]) == int(mujoco.mjtObj.mjOBJ_SITE)
    return [int(model.site_bodyid[each]) for each in things] if of_sites else things
