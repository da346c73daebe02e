"""Image features of an object's active voxels, made once per object: rendering and 150 encoder passes are expensive.

    CACHE/ab/abcdef....safetensors    float16, as TRELLIS keeps them: `plain` and `mirrored`, voxels x channels

The file's name is a digest of everything that decides its content: mesh, frame, voxels, images and encoder.
"""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from model.errors import ModelError
from model.structured_latent.object_features.object_mesh import MeshRecord, ObjectMeshes
from model.structured_latent.object_features.object_views import RENDERING, object_views
from model.structured_latent.object_features.surface_features import projected_features
from model.structured_latent.object_features.view_encoder import ViewEncoder
from model.tensor_files.safetensors_file import read_header, read_tensors, write_tensors
from shards.settings import Range
from shards.storage.bounded_cache import BoundedCache

__all__ = ["ViewFeatures", "ViewFeaturesConfig"]

_MEMORY_BYTES = 1 << 30
_PLAIN, _MIRRORED = "plain", "mirrored"


@dataclass(frozen=True, kw_only=True)
class ViewFeaturesConfig:
    """Features of the configured image encoder, of images of the clean object (`object_views`).

    | field         | TRELLIS | meaning |
    |---------------|---------|---------|
    | views         | 150     | cameras around the object |
    | image_size    | 518     | px |
    | supersampling | -       | images are rendered larger by this factor; 1: four times faster, jagged |
    | cache         | -       | folder of what is made, for all runs; null: kept in memory as far as 1 GiB goes |
    """

    views: Annotated[int, Range(1, 100_000)]
    image_size: Annotated[int, Range(8, 8192)]
    supersampling: Annotated[int, Range(1, 64)]
    cache: Path | None

    def __post_init__(self) -> None:
        if min(self.views, self.image_size, self.supersampling) < 1:
            raise ModelError(
                "features", f"a number in {self} is below 1", expected="at least 1", action="Change it."
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewFeatures:
    """Makes them, on the device of the encoder, or finds them. Not shared between threads."""

    meshes: ObjectMeshes
    encoder: ViewEncoder
    config: ViewFeaturesConfig
    device: torch.device
    _kept: BoundedCache[Tensor] = field(default_factory=lambda: BoundedCache(_MEMORY_BYTES), init=False)

    def rows(
        self, object_uid: str, occupancy: Bool[np.ndarray, "i j k"], *, is_mirrored: bool
    ) -> Float[Tensor, "voxel channel"]:
        """Of the active voxels in their order, float16 on the CPU; `is_mirrored`: object and occupancy both are.

        ModelError where the mesh is missing or broken, or a cached file is; ShardError.
        """
        record, plain = self.meshes.record(object_uid), occupancy[::-1] if is_mirrored else occupancy
        name = self._name(record, plain)
        chosen = _MIRRORED if is_mirrored else _PLAIN

        def make() -> Tensor:
            if self.config.cache is None:
                return self._made(record, plain)[chosen]
            path = self.config.cache / name[:2] / f"{name}.safetensors"
            if not path.exists():
                write_tensors(path, self._made(record, plain), {"object_uid": object_uid})
            return self._read(path, chosen, voxels=int(plain.sum()))

        return self._kept.get((name, is_mirrored), make, lambda rows: rows.nbytes)

    def _made(self, record: MeshRecord, occupancy: Bool[np.ndarray, "i j k"]) -> dict[str, Tensor]:
        """Both, since rendering takes longest."""
        settings = self.config
        images = object_views(record.read(), settings.views, settings.image_size, settings.supersampling)
        views = list(images)
        made = {}
        for name, shown, voxels in (
            (_PLAIN, views, occupancy),
            (_MIRRORED, [view.mirrored() for view in views], occupancy[::-1]),
        ):
            where = torch.from_numpy(np.argwhere(voxels)).to(self.device)
            # A training may run in bfloat16; features that are kept must not depend on who asked first.
            with torch.autocast(self.device.type, enabled=False):
                found = projected_features(shown, where, len(occupancy), self.encoder.encoder)
            made[name] = found.features.half().cpu()
        return made

    def _read(self, path: Path, chosen: str, *, voxels: int) -> Tensor:
        action = "Delete it: it is made again."
        header = read_header(path, expected="features of an object", action=action, ours=True)
        expected = (voxels, self.encoder.encoder.channels)
        if header.shapes.get(chosen) != expected:
            raise ModelError(path, f"holds {header.shapes}", expected=f"{chosen} {expected}", action=action)
        return read_tensors(path, {chosen: chosen})[chosen]

    def _name(self, record: MeshRecord, occupancy: Bool[np.ndarray, "i j k"]) -> str:
        settings = self.config
        sizes = f"{RENDERING}; {settings.views} {settings.image_size} {settings.supersampling}"
        digest = hashlib.sha256(f"{sizes}; {self.encoder.digest}; {record.mesh_sha256};".encode())
        digest.update(np.ascontiguousarray(record.T_objmesh_from_canonical).data)
        digest.update(np.packbits(occupancy).tobytes())
        return digest.hexdigest()
