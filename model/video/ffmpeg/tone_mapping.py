"""standard_range: high dynamic range (HLG and PQ of BT.2100) to what an ordinary screen shows.

In light of the display, as swscale does it: the transfer functions of BT.2100, the primaries of BT.709,
HDR's reference white as the white of the screen, the gamma of BT.1886. What is brighter is cut, with its
hue. By tables, which take milliseconds to make; swscale makes tables in three dimensions, seconds for each file.
"""

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

__all__ = ["Transfer", "standard_range"]

Transfer = Literal["HLG", "PQ"]

_HLG_PEAK_NITS = 1000.0  # BT.2100's nominal display
_WHITE_NITS = 203.0  # HDR's reference white (BT.2408)
_ENTRIES = 4096  # of the table over the square root of light: fine where the eye is

_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # BT.2020
_BT709_FROM_BT2020 = np.array(
    [
        [1.660491, -0.587641, -0.072850],
        [-0.124550, 1.132900, -0.008349],
        [-0.018151, -0.100579, 1.118730],
    ],
    np.float32,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Tables:
    light: Float32[
        np.ndarray, " code"
    ]  # of 16-bit codes: PQ of the display, 1 is white; HLG of the scene, 0..1
    code: UInt8[np.ndarray, " entry"]  # 8 bits, of the square root of light 0..1


def standard_range(
    rgb: UInt16[np.ndarray, "height width 3"], transfer: Transfer
) -> UInt8[np.ndarray, "height width 3"]:
    """BT.2020 primaries with HLG or PQ codes (0..65535) to BT.709."""
    tables = _tables(transfer)
    light = tables.light[rgb]
    if transfer == "HLG":
        # BT.2100's system gamma: 1.2 on a display of 1000 nits.
        light *= (light @ _LUMINANCE)[..., None] ** np.float32(0.2) * np.float32(_HLG_PEAK_NITS / _WHITE_NITS)
    shown = np.maximum(light @ _BT709_FROM_BT2020.T, np.float32(0))
    shown /= np.maximum(shown.max(axis=-1, keepdims=True), np.float32(1))  # cut with its hue
    return tables.code[(np.sqrt(shown) * np.float32(_ENTRIES - 1) + np.float32(0.5)).astype(np.uint16)]


@cache
def _tables(transfer: Transfer) -> _Tables:
    codes = np.arange(1 << 16) / 65535.0
    light = _hlg_scene_light(codes) if transfer == "HLG" else _pq_nits(codes) / _WHITE_NITS
    roots = np.arange(_ENTRIES) / (_ENTRIES - 1)
    shown = 255.0 * roots ** (2.0 / 2.4)  # BT.1886
    return _Tables(light=light.astype(np.float32), code=shown.round().astype(np.uint8))


def _hlg_scene_light(code: np.ndarray) -> np.ndarray:
    """BT.2100's inverse OETF, 0..1."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(code <= 0.5, code**2 / 3.0, (np.exp((code - c) / a) + b) / 12.0)


def _pq_nits(code: np.ndarray) -> np.ndarray:
    """BT.2100's EOTF."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    power = code ** (1.0 / m2)
    return 10000.0 * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1.0 / m1)
