"""Make docs/hero.jpg out of a dataset: what a shard holds of some frames, one column each.

From top to bottom: image; masks, with the part of the object that is hidden; depth; normals; the object's own mesh. The
image in the README is made of docs/hero.yaml:

    for shard in 0 1 3 5 7 12 14 15; do datagen render --config docs/hero.yaml --out data/hero --shard $shard; done
    python docs/make_hero.py data/hero docs/hero.jpg
"""

import argparse
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from model.structured_latent.object_features.object_mesh import textured_mesh
from model.structured_latent.object_features.object_views import object_views
from shards.reader import Dataset, open_dataset
from shards.storage.images import Geometry, Masks

TILE_PX, GAP_PX = 208, 3
ROWS = ("image", "amodal masks", "depth", "normals", "object")
# (clip, frame, camera of the mesh among 12)
COLUMNS = (
    ("motion-000000-cam-03", 2, 9),
    ("motion-000014-cam-03", 2, 9),
    ("motion-000007-cam-02", 1, 9),
    ("motion-000001-cam-02", 1, 6),
    ("motion-000005-cam-03", 2, 7),
    ("motion-000003-cam-02", 2, 6),
    ("motion-000012-cam-03", 1, 7),
    ("motion-000015-cam-03", 2, 9),
)
VISIBLE, HIDDEN, HAND, ARM = (255, 176, 32), (255, 40, 130), (40, 190, 255), (60, 110, 170)


def masked(rgb: np.ndarray, masks: Masks) -> np.ndarray:
    """The image in grey, with the object, its hidden part, hand and arm in colour."""
    gray = cv2.cvtColor(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    painted = 0.45 * gray
    hidden = masks.object_amodal & ~masks.object_visible
    regions = (
        (masks.arm_visible, ARM),
        (masks.hand_visible, HAND),
        (masks.object_visible, VISIBLE),
        (hidden, HIDDEN),
    )
    for region, color in regions:
        painted[region] = 0.35 * gray[region] + 0.65 * np.array(color)
    outline, _ = cv2.findContours(masks.object_amodal.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(painted.astype(np.uint8), outline, -1, (255, 255, 255), 1)


def depth_colors(geometry: Geometry) -> np.ndarray:
    """Near is bright; what has no depth is black."""
    depth = geometry.depth
    hit = depth > 0
    near, far = np.percentile(depth[hit], [1, 97])
    nearness = np.clip((far - depth) / (far - near), 0, 1)
    colors = cv2.cvtColor(
        cv2.applyColorMap((30 + 225 * nearness).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB
    )
    return np.where(hit[..., None], colors, 0).astype(np.uint8)


def normal_colors(geometry: Geometry) -> np.ndarray:
    """Right, up and towards the camera are red, green and blue."""
    colors = 127.5 * (geometry.normals_cam * (1, -1, -1) + 1)
    return np.where(geometry.depth[..., None] > 0, colors, 0).astype(np.uint8)


def object_image(dataset: Dataset, object_uid: str, camera: int) -> np.ndarray:
    """The object alone, from one of 12 cameras around it."""
    row = next(row for row in dataset.objects() if row.object_uid == object_uid)
    assert row.mesh_glb is not None  # the starter pack's licences allow copies
    mesh = textured_mesh(row.mesh_glb, row.T_objmesh_from_canonical, where=object_uid)
    image = next(islice(object_views(mesh, 12, 3 * TILE_PX, 2), camera, None)).image
    filled = np.argwhere(image.any(axis=2))
    center, half = (filled.min(axis=0) + filled.max(axis=0)) // 2, int(0.55 * np.ptp(filled, axis=0).max())
    padded = np.pad(
        image, ((half, half), (half, half), (0, 0))
    )  # a square around the object may leave the image
    return padded[center[0] : center[0] + 2 * half, center[1] : center[1] + 2 * half]


def column(dataset: Dataset, clip_id: str, frame: int, camera: int) -> list[np.ndarray]:
    clip = next(clip for clip in dataset.clips() if clip.clip_id == clip_id)
    frames = dataset.read_frames(clip_id, ["rgb", "masks", "geometry"])
    rgb, geometry = frames.rgb(frame), frames.geometry(frame)
    tiles = [rgb, masked(rgb, frames.masks(frame)), depth_colors(geometry), normal_colors(geometry)]
    tiles.append(object_image(dataset, clip.object_uid, camera))
    return [cv2.resize(tile, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA) for tile in tiles]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset)
    pitch = TILE_PX + GAP_PX
    sheet = Image.new("RGB", (len(COLUMNS) * pitch - GAP_PX, len(ROWS) * pitch - GAP_PX), "black")
    for x, (clip_id, frame, camera) in enumerate(COLUMNS):
        for y, tile in enumerate(column(dataset, clip_id, frame, camera)):
            sheet.paste(Image.fromarray(tile), (x * pitch, y * pitch))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    for y, label in enumerate(ROWS):
        draw.text((8, y * pitch + 5), label, fill="white", font=font, stroke_width=2, stroke_fill="black")
    sheet.save(arguments.out, quality=88, optimize=True)


if __name__ == "__main__":
    main()
