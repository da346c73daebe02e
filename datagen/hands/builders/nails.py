"""Where the fingernails of the open hand are, as texture masks."""

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from datagen.hands.builders.texel_map import TexelMap
from datagen.hands.model import HandModel

__all__ = ["nail_mask"]

# Measured on the mesh, looking along `view` at the point 0.6 of the way from the last joint to the
# tip: centre and half-axes of the nail's outline in metres, across and towards the tip.
_LOOK = {"thumb": (0.0, 0.6, 0.8)}
_NAILS = {
    "thumb": (-0.0009, 0.0050, 0.0052, 0.0064),
    "index": (-0.0001, 0.0027, 0.0053, 0.0073),
    "middle": (-0.0004, 0.0027, 0.0050, 0.0078),
    "ring": (-0.0008, 0.0037, 0.0047, 0.0072),
    "pinky": (-0.0010, 0.0038, 0.0039, 0.0047),
}
_LAST_JOINT = {"thumb": 15, "index": 3, "middle": 6, "ring": 12, "pinky": 9}


def nail_mask(hand: HandModel, texels: TexelMap) -> Float[np.ndarray, "row column 2"]:
    """How much of each texel is nail (0..1), and how near it lies to the free edge (0..1)."""
    position = texels.sample(hand.v_template[hand.faces])
    joints = hand.J_regressor @ hand.v_template
    edges = hand.v_template[hand.faces]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    facing = normals[np.maximum(texels.face, 0)]
    mask = np.zeros((*texels.face.shape, 2))
    for digit, tip in zip(_NAILS, hand.tip_ids):
        last = joints[_LAST_JOINT[digit]]
        along = hand.v_template[tip] - last
        view = np.array(_LOOK.get(digit, (0.0, 1.0, 0.0)))
        view /= np.linalg.norm(view)
        right = np.cross(along, view)
        right /= np.linalg.norm(right)
        up = np.cross(view, right)
        local = position - (last + 0.6 * along)
        across0, up0, half_across, half_up = _NAILS[digit]
        x, y = (local @ right - across0) / half_across, (local @ up - up0) / half_up
        outline = (np.abs(x) ** 2.6 + np.abs(y) ** 2.6) ** (1 / 2.6)
        near = texels.inside & (np.linalg.norm(local, axis=-1) < 0.025) & (facing @ view > 0.15)
        mask[..., 0] = np.maximum(mask[..., 0], np.where(near, np.clip((1.06 - outline) / 0.14, 0.0, 1.0), 0.0))
        free_edge = np.clip((np.maximum(y, 0.0) ** 2 + 0.35 * x**2 - 0.55) / 0.15, 0.0, 1.0)
        mask[..., 1] = np.maximum(mask[..., 1], np.where(near, free_edge, 0.0))
    return np.stack([ndimage.gaussian_filter(mask[..., k], 0.7) for k in range(2)], axis=-1)
