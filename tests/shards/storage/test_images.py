"""PNG against two other implementations, OpenEXR against its promised error, and damage."""

import io
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from shards.errors import ImageError, ShardError
from shards.storage.images import (
    MASK_BITS,
    decode_geometry,
    decode_masks,
    decode_rgb,
    encode_geometry,
    encode_masks,
    encode_rgb_png,
    mask_box_px,
)
from shards.storage.png import _undo_any_filters, decode_png, encode_png

sides = st.integers(1, 23)


@st.composite
def pixels(draw):
    shape = draw(st.sampled_from([(), (3,), (4,)]))
    image = draw(hnp.arrays(np.uint8, (draw(sides), draw(sides), *shape)))
    return np.cumsum(image, axis=0, dtype=np.uint8) if draw(st.booleans()) else image


@given(pixels())
def test_png_round_trip(image):
    np.testing.assert_array_equal(decode_png(encode_png(image)), image)


@given(pixels())
def test_pillow_and_opencv_read_our_png(image):
    data = encode_png(image)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), image)
    read = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    order: Any = {1: slice(None), 3: [2, 1, 0], 4: [2, 1, 0, 3]}[image.shape[2] if image.ndim == 3 else 1]
    np.testing.assert_array_equal(read if image.ndim == 2 else read[..., order], image)


@given(pixels(), st.integers(0, 9))
def test_we_read_the_png_of_pillow_and_opencv(image, level):
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, "png", compress_level=level)
    np.testing.assert_array_equal(decode_png(stream.getvalue()), image)
    for strategy in (cv2.IMWRITE_PNG_STRATEGY_DEFAULT, cv2.IMWRITE_PNG_STRATEGY_FILTERED):
        _, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_STRATEGY, strategy])
        order: Any = {1: slice(None), 3: [2, 1, 0], 4: [2, 1, 0, 3]}[image.shape[2] if image.ndim == 3 else 1]
        decoded = decode_png(data.tobytes())
        np.testing.assert_array_equal(decoded if image.ndim == 2 else decoded[..., order], image)


@given(
    st.integers(1, 9).flatmap(
        lambda height: st.tuples(
            hnp.arrays(np.uint8, (height,), elements=st.integers(0, 4)),
            hnp.arrays(np.uint8, (height, 6, 3)),
        )
    )
)
def test_filters_are_undone_as_the_standard_says(case):
    """Against the standard's definition, written as the slow loop over bytes."""
    filters, residuals = case
    height, width, channels = residuals.shape
    expected = np.zeros((height + 1, width + 1, channels), int)
    for y, x, c in np.ndindex(height, width, channels):
        left, above, corner = expected[y + 1, x, c], expected[y, x + 1, c], expected[y, x, c]
        estimate = left + above - corner
        paeth = min((abs(estimate - v), i, v) for i, v in enumerate((left, above, corner)))[2]
        predicted = (0, left, above, (left + above) // 2, paeth)[filters[y]]
        expected[y + 1, x + 1, c] = (residuals[y, x, c] + predicted) % 256
    np.testing.assert_array_equal(_undo_any_filters(filters, residuals), expected[1:, 1:])


@settings(max_examples=300)
@given(st.data())
def test_a_damaged_png_raises_and_never_gives_other_pixels(data):
    image = np.random.default_rng(0).integers(0, 256, (9, 7, 3), dtype=np.uint8)
    encoded = bytearray(encode_png(image))
    position, bit = data.draw(st.integers(0, len(encoded) - 1)), data.draw(st.integers(0, 7))
    encoded[position] ^= 1 << bit
    with pytest.raises(ShardError):
        decode_png(bytes(encoded))
    with pytest.raises(ShardError):
        decode_png(encode_png(image)[:position])


def test_unsupported_pngs_say_so():
    stream = io.BytesIO()
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(stream, "png")
    with pytest.raises(ImageError, match=r"unsupported PNG.*bit depth 16"):
        decode_png(stream.getvalue())
    with pytest.raises(ImageError, match="cannot be a PNG"):
        encode_png(np.zeros((0, 4), np.uint8))


@pytest.mark.parametrize("codec", ["jpeg", "webp"])
def test_jpeg_and_webp_are_read_through_pillow(codec):
    image = np.full((16, 16, 3), 120, np.uint8)
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, codec, quality=95)
    np.testing.assert_allclose(decode_rgb(stream.getvalue()), image, atol=3)
    with pytest.raises(ImageError):
        decode_rgb(stream.getvalue()[:20])


def test_images_give_the_same_bytes_again():
    rng = np.random.default_rng(0)
    rgb, depth = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8), rng.random((8, 8))
    assert encode_rgb_png(rgb) == encode_rgb_png(rgb.copy())
    first, second = (
        encode_geometry(depth, depth, np.zeros((8, 8, 3)), compression="pxr24") for _ in range(2)
    )
    assert first == second


@given(hnp.arrays(np.uint8, (5, 6), elements=st.integers(0, 63)))
def test_mask_bits_round_trip(bits):
    masks = decode_masks(encode_masks(bits))
    back = sum(bit * getattr(masks, name).astype(np.uint8) for name, bit in MASK_BITS.items())
    np.testing.assert_array_equal(back, bits)


def test_mask_bits_are_those_of_the_schema():
    assert list(MASK_BITS) == [
        "hand_visible",
        "object_visible",
        "hand_amodal",
        "object_amodal",
        "arm_visible",
        "arm_amodal",
    ]
    assert list(MASK_BITS.values()) == [1, 2, 4, 8, 16, 32]
    with pytest.raises(ImageError):
        encode_masks(np.full((2, 2), 64, np.uint8))


depths = hnp.arrays(np.float32, (8, 9), elements=st.one_of(st.just(0.0), st.floats(0.0625, 20.0, width=32)))


@given(depths, depths)
def test_pxr24_keeps_depth_to_24_bits_and_nothing_stays_nothing(depth, depth_object):
    data = encode_geometry(depth, depth_object, np.zeros((8, 9, 3)), compression="pxr24")
    decoded = decode_geometry(data)
    for stored, true in ((decoded.depth, depth), (decoded.depth_object, depth_object)):
        assert np.all(np.abs(stored - true) <= 2.0**-16 * true)  # rounded to 15 bits behind the leading one
        np.testing.assert_array_equal(stored == 0, true == 0)


@given(depths)
def test_zip_is_exact_and_normals_are_half_floats(depth):
    normals = np.random.default_rng(0).normal(size=(8, 9, 3)).astype(np.float32)
    decoded = decode_geometry(encode_geometry(depth, depth, normals, compression="zip"))
    np.testing.assert_array_equal(decoded.depth, depth)
    np.testing.assert_array_equal(decoded.normals_cam, normals.astype(np.float16))
    pxr = decode_geometry(encode_geometry(depth, depth, normals, compression="pxr24"))
    np.testing.assert_array_equal(pxr.normals_cam, normals.astype(np.float16))


def test_damaged_geometry_raises_image_error():
    good = encode_geometry(np.ones((8, 8)), np.ones((8, 8)), np.zeros((8, 8, 3)), compression="zip")
    for data in (b"", b"not an image", good[:40], good[: len(good) // 2]):
        with pytest.raises(ImageError):
            decode_geometry(data)


def test_boxes_are_pixel_edges():
    mask = np.zeros((8, 9), bool)
    assert mask_box_px(mask) == (-1, -1, -1, -1)
    mask[5, 3] = True
    assert mask_box_px(mask) == (3, 5, 4, 6)
    mask[7, 8] = True
    assert mask_box_px(mask) == (3, 5, 9, 8)
