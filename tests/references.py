"""Independent references in float64 NumPy: what the package computes, by another road."""

import itertools

import mujoco
import numpy as np
import pytest

from mjx_revolve.water.bed import bed_height

# A cube cut into six tetrahedra around one diagonal (Kuhn): corners as indices into (0, 1)³.
_KUHN = [[np.zeros(3), *np.cumsum(axes, axis=0)] for axes in itertools.permutations(np.eye(3))]


def _tetrahedron_below(corners, height):
    """Volume and volume times centroid of the part of a tetrahedron where height < 0, exactly."""

    def whole(points):
        points = np.asarray(points)
        volume = abs(np.linalg.det(points[1:] - points[0])) / 6
        return volume, volume * points.mean(0)

    def cut(i, j):
        share = height[i] / (height[i] - height[j])
        return corners[i] + share * (corners[j] - corners[i])

    order = np.argsort(height)
    below = int(np.sum(height < 0))
    if below == 0:
        return 0.0, np.zeros(3)
    if below == 4:
        return whole(corners)
    if below == 1:
        a = order[0]
        return whole([corners[a], *(cut(a, b) for b in order[1:])])
    if below == 3:
        top = order[3]
        all_of_it = whole(corners)
        dry = whole([corners[top], *(cut(top, b) for b in order[:3])])
        return all_of_it[0] - dry[0], all_of_it[1] - dry[1]
    # Two corners below: a wedge with triangular ends, of three tetrahedra.
    a, b, c, d = order
    p, q = [corners[a], cut(a, c), cut(a, d)], [corners[b], cut(b, c), cut(b, d)]
    pieces = [whole([*p, q[2]]), whole([p[0], p[1], q[1], q[2]]), whole([p[0], q[0], q[1], q[2]])]
    return sum(v for v, _ in pieces), sum(m for _, m in pieces)


def clip_box(up, depth, half):
    """Submerged share of a box, and that times the piece's centre, by tetrahedra."""
    up, half = np.asarray(up, float), np.asarray(half, float)
    volume, moment = 0.0, np.zeros(3)
    for tetrahedron in _KUHN:
        corners = (2 * np.array(tetrahedron) - 1) * half
        v, m = _tetrahedron_below(corners, corners @ up - depth)
        volume, moment = volume + v, moment + m
    return volume / (8 * half.prod()), moment / (8 * half.prod())


class Lagrangian:
    """Equations of motion from the kinetic energy alone: body and carried water, no recursion.

    T(q, v) = ½ v · B(q) v with B = M + Σ_parts ρ (J_vᵀ A J_v + J_ωᵀ A' J_ω); M and the Jacobians J
    are MuJoCo's, A and A' each part's added mass and inertia. Derivatives are central differences.
    """

    def __init__(self, robot, density):
        self.robot, self.density = robot, density
        self.model, self.data = robot.mj_model, mujoco.MjData(robot.mj_model)

    def inertia(self, qpos):
        """B at a configuration, wholly under water."""
        model, data, fluid = self.model, self.data, self.robot.fluid
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_crb(model, data)
        total = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, total)
        for p, body in enumerate(fluid.body):
            turn = data.xmat[body].reshape(3, 3)
            place = data.xpos[body] + turn @ fluid.position[p]
            axes = turn @ fluid.rotation[p]
            linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, linear, angular, place, body)
            for jacobian, table in (
                (axes.T @ linear, fluid.added_mass[p]),
                (axes.T @ angular, fluid.added_inertia[p]),
            ):
                total += self.density * jacobian.T @ np.diag(table) @ jacobian
        return total

    def moved(self, qpos, direction, step):
        """A configuration moved along a velocity for `step` seconds."""
        qpos = qpos.copy()
        mujoco.mj_integratePos(self.model, qpos, direction, step)
        return qpos

    def energy(self, qpos, qvel):
        """½ v · B v."""
        return qvel @ self.inertia(qpos) @ qvel / 2

    def impulse(self, qpos, qvel):
        """Linear and angular impulse of body and water, the latter about the world's origin.

        Momenta of the root's six coordinates are those of the whole, in its velocities' frames.
        """
        momentum = self.inertia(qpos) @ qvel
        turn = rotation(qpos[3:7] / np.linalg.norm(qpos[3:7]))
        spin = turn @ momentum[3:6] + np.cross(qpos[:3], momentum[:3])
        return np.concatenate([momentum[:3], spin])

    def force(self, qpos, qvel, qacc, step=1e-5):
        """`[nv]` generalised force that this motion needs (Hamel's form of Lagrange's equations).

        d/dt ∂T/∂v - ∂T/∂π, and ω × ∂T/∂ω more for the root's turning, whose velocity is its own
        frame's and not a coordinate's rate.
        """

        def rate(direction):
            ahead, behind = (self.inertia(self.moved(qpos, direction, s)) for s in (step, -step))
            return (ahead - behind) / (2 * step)

        momentum = self.inertia(qpos) @ qvel
        result = self.inertia(qpos) @ qacc + rate(qvel) @ qvel
        result -= [qvel @ rate(e) @ qvel / 2 for e in np.eye(len(qvel))]
        result[3:6] += np.cross(qvel[3:6], momentum[3:6])
        return result


def clearance(robot, qpos):
    """`[T]` height of the lowest corner above the bed, negative inside [m]."""
    data, found = mujoco.MjData(robot.mj_model), []
    for q in qpos:
        data.qpos[:] = q
        mujoco.mj_kinematics(robot.mj_model, data)
        turn = data.xmat[robot.contact_body].reshape(-1, 3, 3)
        corner = data.xpos[robot.contact_body]
        corner = corner + np.einsum("nij,nj->ni", turn, robot.contact_position)
        found.append(np.min(corner[:, 2] - bed_height(robot.world.bed, *corner[:, :2].T)))
    return np.array(found)


def mujoco_sensors(robot, names, after, qacc, ctrl):
    """What MuJoCo's sensors say in the middle of modules' main boxes, `[lanes, dim]` by (id, kind).

    Its accelerations are those given: the water's are none of its own.
    """
    spec, kinds, objects = robot.mj_spec.copy(), mujoco.mjtSensor, mujoco.mjtObj
    modules = {module.name: module for module in robot.morphology.modules}
    for name in names:
        module, model = modules[name], robot.mj_model
        part = module.kind.parts[0 if module.kind.hinge is None else -1].name
        geom = model.geom(f"{name}/{part}")
        owner = spec.body(model.body(int(geom.bodyid[0])).name)
        owner.add_site(name=name, pos=geom.pos, quat=geom.quat)
        # A ray goes along z: this one is turned downwards, state by state.
        owner.add_site(name=f"{name}/down", pos=geom.pos)
        site, joint = objects.mjOBJ_SITE, objects.mjOBJ_JOINT
        frames = ("framepos", "framexaxis", "frameyaxis", "framezaxis", "framelinvel")
        for kind in ("gyro", "accelerometer", "velocimeter", *frames):
            what = getattr(kinds, f"mjSENS_{kind.upper()}")
            spec.add_sensor(name=f"{name} {kind}", type=what, objtype=site, objname=name)
        what, at = kinds.mjSENS_RANGEFINDER, f"{name}/down"
        distance = [1, 0, 0]  # of what a ray may tell
        spec.add_sensor(
            name=f"{name} rangefinder", type=what, objtype=site, objname=at, intprm=distance
        )
        if module.kind.hinge is not None:
            at = model.joint(int(model.body(name).jntadr[0])).name
            for kind, what in (
                ("jointpos", kinds.mjSENS_JOINTPOS),
                ("jointvel", kinds.mjSENS_JOINTVEL),
                ("jointactuatorfrc", kinds.mjSENS_JOINTACTFRC),
            ):
                spec.add_sensor(name=f"{name} {kind}", type=what, objtype=joint, objname=at)
    model = spec.compile()
    model.geom_rgba[[model.geom(k).name != "bed" for k in range(model.ngeom)], 3] = 0  # no ray
    data, found = mujoco.MjData(model), {}
    for lane in range(ctrl.shape[1]):
        data.qpos[:], data.qvel[:] = after[0][:, lane], after[1][:, lane]
        data.ctrl[list(robot.servos)] = ctrl[:, lane]
        mujoco.mj_kinematics(model, data)
        for name in names:
            site, quat = model.site(f"{name}/down"), np.zeros(4)
            down = data.xmat[int(site.bodyid[0])].reshape(3, 3).T @ (0, 0, -1)
            mujoco.mju_quatZ2Vec(quat, down)
            model.site_quat[site.id], model.site_sameframe[site.id] = quat, 0
        mujoco.mj_forward(model, data)
        data.qacc[:] = qacc[:, lane]
        mujoco.mj_rnePostConstraint(model, data)
        mujoco.mj_sensorAcc(model, data)
        for k in range(model.nsensor):
            name, kind = model.sensor(k).name.rsplit(" ", 1)
            found.setdefault((name, kind), []).append(data.sensor(k).data.copy())
    return {key: np.array(rows) for key, rows in found.items()}


def check_mujocos_steps(model, qpos, qvel, ctrl, found, close):
    """Steps of lanes are `mj_step`'s, so close in place and speed; `[lanes, na]` at the end."""
    data, ends = mujoco.MjData(model), []
    for lane in range(qpos.shape[1]):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[:, lane], qvel[:, lane], ctrl[:, lane]
        for q, v in zip(*found, strict=True):
            mujoco.mj_step(model, data)
            assert data.qpos == pytest.approx(q[:, lane], abs=close[0])
            assert data.qvel == pytest.approx(v[:, lane], abs=close[1])
        ends.append(data.act.copy())
    return np.array(ends)


def each_lane(function, qpos, qvel):
    """A function of one state, of every lane."""
    return np.array([function(*state) for state in zip(qpos.T, qvel.T, strict=True)])


def rotation(quat):
    """`[..., 3, 3]` of unit quaternions `[..., 4]`."""
    w, x, y, z = np.moveaxis(np.asarray(quat), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
