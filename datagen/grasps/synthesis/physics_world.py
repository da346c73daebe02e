"""The physics world of one hand, one object and a table: built once, used for many attempts."""

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from datagen.grasps.config import GraspConfig
from datagen.grasps.hand_body import HandBody
from datagen.grasps.sequence import TableEdge
from datagen.objects.asset.object_asset import ObjectAsset
from shards.joints import DIGIT_JOINTS, DIGITS

__all__ = ["GraspWorld", "HandContacts", "WristTarget"]

HAND, OBJECT, TABLE, FOREARM = 1, 2, 4, 8  # collision groups
TABLE_HALF_M = 0.75
TABLE_DEPTH_M = 0.3  # a block, so that no drawn table top can be thicker
SOLREF = (0.005, 1.0)
SOLIMP = (0.95, 0.99, 0.0008, 0.5, 2.0)
HULL_VERTICES = 40
PALM = 5  # row of HandContacts after the five digits


@dataclass(frozen=True, kw_only=True)
class WristTarget:
    """Where the wrist is driven to: pose of the rest wrist joint in the world."""

    R_world_from_hand: Float[np.ndarray, "3 3"]
    position_world: Float[np.ndarray, "3"]

    def moved(self, shift_world: Float[np.ndarray, "3"]) -> "WristTarget":
        """The same orientation elsewhere."""
        return WristTarget(
            R_world_from_hand=self.R_world_from_hand, position_world=self.position_world + shift_world
        )


@dataclass(frozen=True, kw_only=True)
class HandContacts:
    """Contacts between hand and object at one instant, one row per contact."""

    bone: Int[np.ndarray, " contact"]
    position_world: Float[np.ndarray, "contact 3"]
    normal_world: Float[np.ndarray, "contact 3"]  # unit, from the hand into the object
    force_n: Float[np.ndarray, " contact"]  # normal component
    distance_m: Float[np.ndarray, " contact"]  # < 0: overlap

    def digit_force_n(self) -> Float[np.ndarray, "6"]:
        """Normal force per digit (order of DIGITS), then the palm."""
        force = np.zeros(6)
        np.add.at(force, DIGIT_OF_BONE[self.bone], self.force_n)
        return force


DIGIT_OF_BONE = np.full(16, PALM)
for _row, _digit in enumerate(DIGITS):
    DIGIT_OF_BONE[list(DIGIT_JOINTS[_digit])] = _row


def quaternion_wxyz(R: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """MuJoCo's order of a rotation matrix."""
    return Rotation.from_matrix(R).as_quat()[..., [3, 0, 1, 2]]


class GraspWorld:
    """MuJoCo model and state. Not thread-safe; one per process and (hand, object)."""

    def __init__(self, body: HandBody, obj: ObjectAsset, config: GraspConfig) -> None:
        spec = mujoco.MjSpec()
        _set_options(spec)
        _add_table(spec)
        _add_hand(spec, body, config)
        self.mass_kg, self.com_obj = _add_object(spec, obj, config)
        _add_targets(spec)
        self.body, self.model = body, spec.compile()
        self.data = mujoco.MjData(self.model)
        self.object_verts_obj = np.concatenate([part.verts_obj for part in obj.watertight.parts])
        self._index()
        self._separate_self_contacts()

    def _index(self) -> None:
        model = self.model
        self.hinge_qpos = np.array([model.joint(h.name).qposadr[0] for h in self.body.hinges])
        self.hinge_dof = np.array([model.joint(h.name).dofadr[0] for h in self.body.hinges])
        self.wrist_qpos = int(model.joint("wrist").qposadr[0])
        self.object_qpos = int(model.joint("object").qposadr[0])
        self.object_dof = int(model.joint("object").dofadr[0])
        self.bone_body = np.array([model.body(f"bone{b}").id for b in range(16)])
        self.object_body = int(model.body("object").id)
        self.pin = int(model.equality("pin").id)
        self.mocap = {n: int(model.body(n).mocapid[0]) for n in ("wrist_target", "object_pin", "table")}
        self.bone_of_geom = np.full(model.ngeom, -1)
        for bone, body_id in enumerate(self.bone_body):
            self.bone_of_geom[model.geom_bodyid == body_id] = bone
        self.forearm_geom = int(model.geom("forearm").id)
        self.bone_of_geom[self.forearm_geom] = -1
        self.object_geom = model.geom_bodyid == self.object_body
        self.table_geom = int(model.geom("table").id)
        self.torque_nm = np.array([h.torque_nm for h in self.body.hinges])
        self.stiffness_nm = np.array([h.stiffness_nm for h in self.body.hinges])
        self.row_of_bone = DIGIT_OF_BONE
        self.bones_of_digit = {digit: list(bones) for digit, bones in DIGIT_JOINTS.items()}
        self.low_rad = np.array([h.low_rad for h in self.body.hinges])
        self.high_rad = np.array([h.high_rad for h in self.body.hinges])

    def _separate_self_contacts(self) -> None:
        """Switch off self-contact pairs that already overlap in the rest pose."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        mujoco.mj_kinematics(model, data)
        for pair in range(model.npair):
            a, b = int(model.pair_geom1[pair]), int(model.pair_geom2[pair])
            if mujoco.mj_geomDistance(model, data, a, b, 0.01, None) < 0.001:
                model.pair_margin[pair] = -1.0

    def reset(
        self,
        wrist: WristTarget,
        angles_rad: Float[np.ndarray, " hinge"],
        T_world_from_obj: Float[np.ndarray, "4 4"],
        edge: TableEdge | None,
    ) -> None:
        """Put everything in place, at rest, with the object pinned."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        position, quaternion = T_world_from_obj[:3, 3], quaternion_wxyz(T_world_from_obj[:3, :3])
        data.qpos[self.object_qpos : self.object_qpos + 7] = [*position, *quaternion]
        self._place("object_pin", position, quaternion)
        self.place_hand(wrist, angles_rad)
        data.ctrl[:] = angles_rad
        data.eq_active[self.pin] = 1
        center, yaw = (0.0, 0.0), 0.0
        if edge is not None:
            point, outward = np.array(edge.point_xy_m), np.array(edge.outward_xy)
            x, y = point - TABLE_HALF_M * outward
            center, yaw = (float(x), float(y)), float(np.arctan2(outward[1], outward[0]))
        self._place("table", np.array([*center, 0.0]), np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))

    def place_hand(self, wrist: WristTarget, angles_rad: Float[np.ndarray, " hinge"]) -> None:
        """Teleport the hand (and its target)."""
        quaternion = quaternion_wxyz(wrist.R_world_from_hand)
        at = self.wrist_qpos
        self.data.qpos[at : at + 7] = [*wrist.position_world, *quaternion]
        self.data.qpos[self.hinge_qpos] = angles_rad
        self._place("wrist_target", wrist.position_world, quaternion)

    def _place(self, name: str, position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"]) -> None:
        self.data.mocap_pos[self.mocap[name]] = position
        self.data.mocap_quat[self.mocap[name]] = wxyz

    def drive_wrist(self, position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"]) -> None:
        """Move the wrist's target; the weld pulls the hand after it."""
        self._place("wrist_target", position, wxyz)

    def release_object(self) -> None:
        """Let go of the object: from now on only the hand and the table hold it."""
        self.data.eq_active[self.pin] = 0

    def detect(self) -> None:
        """Kinematics and collisions at the present state, without dynamics."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_collision(self.model, self.data)

    def step(self) -> None:
        """Advance one time step."""
        mujoco.mj_step(self.model, self.data)

    def overlap(self) -> tuple[float, float]:
        """Deepest overlap (m, >= 0) of hand and forearm with the object, and with the table."""
        contact = self.data.contact
        geom, depth = np.asarray(contact.geom), -np.asarray(contact.dist)
        if len(depth) == 0:
            return 0.0, 0.0
        hand = (self.bone_of_geom[geom] >= 0) | (geom == self.forearm_geom)
        touches_object = hand.any(1) & self.object_geom[geom].any(1)
        touches_table = hand.any(1) & (geom == self.table_geom).any(1)
        return (
            float(np.max(depth, where=touches_object, initial=0.0)),
            float(np.max(depth, where=touches_table, initial=0.0)),
        )

    def contacts(self) -> HandContacts:
        """Hand-object contacts at the present state."""
        contact = self.data.contact
        geom = np.asarray(contact.geom).reshape(-1, 2)
        bones = self.bone_of_geom[geom]
        rows = (bones >= 0).any(1) & self.object_geom[geom].any(1)
        address = np.asarray(contact.efc_address)[rows]
        force = np.zeros(len(address))
        active = address >= 0
        force[active] = np.asarray(self.data.efc_force)[address[active]] if self.data.nefc else 0.0
        # MuJoCo's contact normal points from the first geom to the second.
        sign = np.where(bones[rows, 0] >= 0, 1.0, -1.0)
        return HandContacts(
            bone=bones[rows].max(1),
            position_world=np.array(contact.pos)[rows],
            normal_world=np.array(contact.frame)[rows, :3] * sign[:, None],
            force_n=force,
            distance_m=np.array(contact.dist)[rows],
        )

    def angles(self) -> Float[np.ndarray, " hinge"]:
        """Hinge angles, radians."""
        return self.data.qpos[self.hinge_qpos].copy()

    def wrist(self) -> WristTarget:
        """Where the wrist is."""
        bone = self.bone_body[0]
        return WristTarget(
            R_world_from_hand=self.data.xmat[bone].reshape(3, 3).copy(),
            position_world=self.data.xpos[bone].copy(),
        )

    def T_world_from_obj(self) -> Float[np.ndarray, "4 4"]:
        """Pose of the object."""
        T = np.eye(4)
        T[:3, :3] = self.data.xmat[self.object_body].reshape(3, 3)
        T[:3, 3] = self.data.xpos[self.object_body]
        return T


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.compiler.degree = False
    spec.option.timestep = 0.002
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.impratio = 10.0
    spec.option.iterations = 30
    spec.option.ccd_iterations = 30
    spec.memory = 64 << 20


def _add_table(spec: mujoco.MjSpec) -> None:
    table = spec.worldbody.add_body(name="table", mocap=True)
    table.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[TABLE_HALF_M, TABLE_HALF_M, TABLE_DEPTH_M / 2],
        pos=[0, 0, -TABLE_DEPTH_M / 2],
        contype=TABLE,
        conaffinity=HAND | OBJECT,
        friction=[1.0, 0.01, 0.001],
        solref=SOLREF,
    )


def _add_hand(spec: mujoco.MjSpec, body: HandBody, config: GraspConfig) -> None:
    nodes: dict[int, mujoco.MjsBody] = {}
    for bone in range(16):
        parent = int(body.parents[bone])
        if bone == 0:
            node = spec.worldbody.add_body(name="bone0", gravcomp=1.0)
            node.add_freejoint(name="wrist")
            _add_forearm(node, body, config)
        else:
            offset = body.joints_rest[bone] - body.joints_rest[parent]
            node = nodes[parent].add_body(name=f"bone{bone}", pos=offset, gravcomp=1.0)
        nodes[bone] = node
    for hinge in body.hinges:
        nodes[hinge.bone].add_joint(
            name=hinge.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=hinge.axis_bone,
            range=[hinge.low_rad, hinge.high_rad],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            armature=5e-4,
            damping=[0.02, 0.0, 0.0],
        )
        actuator = spec.add_actuator(
            name=hinge.name, target=hinge.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True
        )
        actuator.set_to_position(kp=hinge.stiffness_nm, kv=0.12 * np.sqrt(hinge.stiffness_nm))
        actuator.forcerange = [-hinge.torque_nm, hinge.torque_nm]
    names: dict[int, list[str]] = {}
    for k, hull in enumerate(body.hulls):
        spec.add_mesh(name=f"hull{k}", uservert=hull.verts_bone.ravel(), maxhullvert=HULL_VERTICES)
        nodes[hull.bone].add_geom(
            name=f"hand{k}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"hull{k}",
            mass=0.06 if hull.bone == 0 else 0.015,
            contype=HAND,
            conaffinity=OBJECT | TABLE,
            condim=4,
            friction=[config.friction, 0.01, 0.001],
            solref=SOLREF,
            solimp=SOLIMP,
            margin=config.contact_distance_m,
        )
        names.setdefault(hull.bone, []).append(f"hand{k}")
    for a, b in _self_contact_bones():
        for first in names[a]:
            for second in names[b]:
                spec.add_pair(geomname1=first, geomname2=second, condim=1)


def _add_forearm(node: mujoco.MjsBody, body: HandBody, config: GraspConfig) -> None:
    start = -body.distal * (config.forearm_radius_m + 0.015)
    end = -body.distal * config.forearm_length_m
    node.add_geom(
        name="forearm",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*start, *end],
        size=[config.forearm_radius_m, 0, 0],
        mass=0.6,
        contype=FOREARM,
        conaffinity=TABLE | OBJECT,
        condim=1,
    )


def _self_contact_bones() -> list[tuple[int, int]]:
    """Thumb against fingers, neighbouring fingers, finger ends against the palm."""
    pairs = [(a, b) for a in (14, 15) for d in DIGITS[1:] for b in DIGIT_JOINTS[d]]
    for near, far in (("index", "middle"), ("middle", "ring"), ("ring", "pinky")):
        for a in DIGIT_JOINTS[near][1:]:
            pairs += [(a, b) for b in DIGIT_JOINTS[far][1:]]
    pairs += [(0, DIGIT_JOINTS[d][2]) for d in DIGITS[1:]]
    return pairs


def _add_object(
    spec: mujoco.MjSpec, obj: ObjectAsset, config: GraspConfig
) -> tuple[float, Float[np.ndarray, "3"]]:
    hulls = [trimesh.convex.convex_hull(part.verts_obj) for part in obj.watertight.parts]
    hulls = [hull for hull in hulls if hull.volume > 1e-10]
    if not hulls:
        raise ValueError(
            f"{obj.uid}: the watertight mesh has no convex part with a volume; decompose it again"
        )
    volume = np.array([hull.volume for hull in hulls])
    mass = float(np.clip(config.density_kg_m3 * volume.sum(), *config.mass_kg))
    node = spec.worldbody.add_body(name="object")
    node.add_freejoint(name="object")
    for k, (hull, share) in enumerate(zip(hulls, volume / volume.sum())):
        spec.add_mesh(name=f"part{k}", uservert=np.asarray(hull.vertices).ravel(), maxhullvert=64)
        node.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"part{k}",
            mass=mass * share,
            contype=OBJECT,
            conaffinity=HAND | TABLE,
            condim=4,
            friction=[config.friction, 0.01, 0.001],
            solref=SOLREF,
            solimp=SOLIMP,
        )
    com = sum(hull.center_mass * part for hull, part in zip(hulls, volume)) / volume.sum()
    return mass, np.asarray(com)


def _add_targets(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_body(name="wrist_target", mocap=True)
    spec.worldbody.add_body(name="object_pin", mocap=True)
    for name, target, follower, stiffness in (
        ("hold", "wrist_target", "bone0", 0.01),
        ("pin", "object_pin", "object", 0.01),
    ):
        weld = spec.add_equality(
            name=name,
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=target,
            name2=follower,
            solref=[stiffness, 1.0],
            solimp=[0.97, 0.995, 0.001, 0.5, 2.0],
        )
        # anchor 0, relative pose identity, torque scale 1
        weld.data[:11] = [0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1]
