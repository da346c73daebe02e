"""upright: images turned and mirrored as their metadata say."""

import numpy as np
from jaxtyping import Int, Shaped

__all__ = ["EXIF_MATRICES", "upright"]

# (a, b), (c, d) of EXIF's orientations 2 to 8; 1 is the identity.
EXIF_MATRICES = {
    2: ((-1, 0), (0, 1)),
    3: ((-1, 0), (0, -1)),
    4: ((1, 0), (0, -1)),
    5: ((0, 1), (1, 0)),
    6: ((0, 1), (-1, 0)),
    7: ((0, -1), (-1, 0)),
    8: ((0, -1), (1, 0)),
}


def upright(
    image: Shaped[np.ndarray, "height width channel"], matrix: Int[np.ndarray, "2 2"]
) -> Shaped[np.ndarray, "new_height new_width channel"]:
    """The image as a display matrix (a, b), (c, d) wants it shown: x' = a x + c y, y' = b x + d y.

    Turns are rounded to multiples of 90 degrees; reflections are respected.
    """
    (a, b), (c, d) = matrix.tolist()
    if abs(a) + abs(d) < abs(b) + abs(c):
        image, a, d = image.swapaxes(0, 1), c, b
    return np.ascontiguousarray(image[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
