"""Skin colour as a linear model of a texture (HTML layout, FORMATS 3.3): mean + basis @ coefficients."""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from io import BytesIO

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image
from scipy.ndimage import distance_transform_edt

__all__ = [
    "SkinBasis",
    "decode_skin",
    "load_open_skin",
    "nearest_texels",
    "open_nail_mask_png",
    "sample_skin_coefficients",
]

_DATA = files("datagen.hands") / "data" / "skin"

_MAX_COEFFICIENT = 2.0  # beyond two standard deviations colours turn garish


@dataclass(frozen=True, kw_only=True, eq=False)
class SkinBasis:
    """A texture model. Values are sRGB, 0..255; one unit of a coefficient is one standard deviation.

    `index_map` places each value in a flattened (channel, column, row) image, as HTML does. Texels
    it leaves out stay black, or copy the texel that `fill` (`nearest_texels`) names for them.
    `anchors` are the coefficients of the skins the model was made from (no rows when they are not
    known).
    """

    name: str
    size: int
    mean: Float[np.ndarray, " value"]
    basis: Float[np.ndarray, "value coefficient"]
    index_map: Int[np.ndarray, " value"]
    axes: tuple[str, ...]  # what each coefficient changes; "" when unknown
    anchors: Float[np.ndarray, "skin coefficient"]
    fill: Int[np.ndarray, " texel"] | None = None


def decode_skin(
    basis: SkinBasis, coefficients: Float[np.ndarray, " coefficient"]
) -> UInt8[np.ndarray, "row column 3"]:
    """sRGB texture, row 0 at the top. ValueError unless there is one coefficient per column of the basis."""
    n = basis.basis.shape[1]
    if coefficients.shape != (n,):
        raise ValueError(f"skin {basis.name!r} takes {n} coefficients, found {len(coefficients)}")
    values = basis.mean + basis.basis @ coefficients.astype(basis.basis.dtype)
    flat = np.zeros(3 * basis.size**2, dtype=np.uint8)
    flat[basis.index_map] = np.clip(np.rint(values), 0, 255)
    if basis.fill is not None:
        flat = flat[basis.fill]
    return np.ascontiguousarray(flat.reshape(3, basis.size, basis.size).transpose(2, 1, 0))


def nearest_texels(index_map: Int[np.ndarray, " value"], size: int) -> Int[np.ndarray, " texel"]:
    """For each texel of the flattened image the nearest one that `index_map` writes, in its channel.

    Filtering at the border of an island then mixes skin with skin, not with the black around it.
    """
    empty = np.ones(3 * size**2, dtype=bool)
    empty[index_map] = False
    channels = []
    for number, outside in enumerate(empty.reshape(3, size, size)):
        column, row = distance_transform_edt(outside, return_distances=False, return_indices=True)
        channels.append((number * size + column) * size + row)
    return np.stack(channels).reshape(-1)


def sample_skin_coefficients(rng: np.random.Generator, basis: SkinBasis) -> Float[np.ndarray, " coefficient"]:
    """A plausible skin, tones spread evenly from the darkest to the lightest anchor.

    Two anchors from opposite halves of the tone axis (coefficient 0) are mixed, up to 8 % beyond
    either end, and the other axes get a little variation of their own. Without anchors (HTML): N(0, 1)
    clipped to two standard deviations. Users of the HTML model draw twice that (FORMATS 3.3); whether one
    unit of its coefficients is a standard deviation is not published, so draws stay where it certainly holds.
    """
    n = basis.basis.shape[1]
    if len(basis.anchors) == 0:
        return np.clip(rng.standard_normal(n), -_MAX_COEFFICIENT, _MAX_COEFFICIENT)
    tone = basis.anchors[:, 0]
    dark, light = basis.anchors[tone < np.median(tone)], basis.anchors[tone >= np.median(tone)]
    a, b = dark[rng.integers(len(dark))], light[rng.integers(len(light))]
    coefficients = a + rng.uniform(-0.08, 1.08) * (b - a)
    coefficients[1:] += 0.35 * np.clip(rng.standard_normal(n - 1), -2.0, 2.0)
    coefficients[1:] = np.clip(coefficients[1:], -_MAX_COEFFICIENT, _MAX_COEFFICIENT)
    return coefficients


@lru_cache(maxsize=1)
def load_open_skin() -> SkinBasis:
    """The skin model that ships with the package, in the open hand's UV layout."""
    table = json.loads((_DATA / "skin.json").read_text())
    size = table["size"]
    inside = _image("footprint.png", size)[..., 0] > 127
    # (row, column, channel) of the image to HTML's (channel, column, row)
    order = np.flatnonzero(np.broadcast_to(inside.T, (3, size, size)))

    def values(name: str) -> Float[np.ndarray, " value"]:
        return _image(name, size).transpose(2, 1, 0).reshape(-1)[order].astype(np.float32)

    columns = [values(axis["file"]) * axis["step"] + axis["low"] for axis in table["axes"]]
    return SkinBasis(
        name="open",
        size=size,
        mean=values("mean.jpg"),
        basis=np.stack(columns, axis=1).astype(np.float32),
        index_map=order,
        axes=tuple(axis["meaning"] for axis in table["axes"]),
        anchors=np.array(list(table["anchors"].values()), dtype=np.float64),
    )


def open_nail_mask_png() -> bytes:
    """White on the nails, in the open hand's UV layout."""
    return (_DATA / "nails.png").read_bytes()


def _image(name: str, size: int) -> UInt8[np.ndarray, "row column 3"]:
    image = Image.open(BytesIO((_DATA / name).read_bytes()), formats=("PNG", "JPEG")).convert("RGB")
    return np.asarray(image.resize((size, size), Image.Resampling.BICUBIC))
