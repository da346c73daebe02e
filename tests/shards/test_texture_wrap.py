"""A row of four texels beyond its borders, against NumPy's own padding."""

from typing import Literal

import numpy as np
import pytest

from shards.texture_wrap import WRAPS, Wrap, wrapped_texel

PADDING: dict[Wrap, Literal["wrap", "symmetric", "edge"]] = {
    "repeat": "wrap",
    "mirror": "symmetric",
    "clamp": "edge",
}


@pytest.mark.parametrize("wrap", WRAPS.values())
def test_beyond_the_borders_as_numpy_pads(wrap):
    padded = np.pad(np.arange(4), 9, mode=PADDING[wrap])
    np.testing.assert_array_equal(wrapped_texel(np.arange(-9, 13), 4, wrap), padded)
