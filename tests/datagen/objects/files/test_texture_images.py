"""Image files of every kind as textures: true colours, and PNG or JPEG where they are stored."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.files.texture_images import has_alpha, permitted_image

GREYS = np.linspace(0, 65535, 64).round().astype(np.uint16).reshape(8, 8)
RGB = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
SMOOTH = np.repeat(np.repeat(RGB[:2, :2], 16, axis=0), 16, axis=1)  # plain blocks of a JPEG


def saved(image: Image.Image, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()


def permitted(data: bytes, max_px: int = 64) -> bytes:
    return permitted_image(data, "a.glb", "an image of material 'x'", max_px)


def shown(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def interlaced_png() -> bytes:
    """From the Adam7 passes of an 8x8 image, as Pillow writes none."""
    passes = (
        (0, 0, 8, 8),
        (4, 0, 8, 8),
        (0, 4, 4, 8),
        (2, 0, 4, 4),
        (0, 2, 2, 4),
        (1, 0, 2, 2),
        (0, 1, 1, 2),
    )
    rows = b"".join(
        b"\0" + row.tobytes() for x, y, dx, dy in passes for row in np.ascontiguousarray(RGB[y::dy, x::dx])
    )

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 8, 8, 8, 2, 0, 0, 1)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def exif_turned() -> bytes:
    exif = Image.Exif()
    exif[0x0112] = 6  # to be shown turned by 90 degrees, which glTF ignores
    return saved(Image.fromarray(RGB), "JPEG", quality=95, exif=exif)


KEPT = {
    "png": saved(Image.fromarray(RGB), "PNG"),
    "png with alpha": saved(Image.fromarray(RGB).convert("RGBA"), "PNG"),
    "png of a palette": saved(Image.fromarray(RGB).quantize(16), "PNG"),
    "png of one bit": saved(Image.fromarray(GREYS > 30000), "PNG"),
    "png, grey and alpha": saved(Image.fromarray(RGB).convert("LA"), "PNG"),
    "png, interlaced": interlaced_png(),
    "jpeg": saved(Image.fromarray(RGB), "JPEG"),
    "jpeg, progressive": saved(Image.fromarray(RGB), "JPEG", progressive=True),
    "jpeg, grey": saved(Image.fromarray(RGB).convert("L"), "JPEG"),
    "jpeg, turned by EXIF": exif_turned(),
}


@pytest.mark.parametrize("kind", KEPT)
def test_what_gltf_permits_keeps_its_bytes(kind):
    assert permitted(KEPT[kind]) == KEPT[kind]


def test_an_interlaced_image_has_its_colours():
    np.testing.assert_array_equal(shown(interlaced_png()), RGB)


WITH_HOLE = Image.fromarray(RGB).quantize(16)
CONVERTED = {
    "bmp": (saved(Image.fromarray(RGB), "BMP"), RGB),
    "tga": (saved(Image.fromarray(RGB), "TGA"), RGB),
    "tga, packed": (saved(Image.fromarray(RGB), "TGA", compression="tga_rle"), RGB),
    "tiff": (saved(Image.fromarray(RGB), "TIFF"), RGB),
    "tiff, packed": (saved(Image.fromarray(RGB), "TIFF", compression="tiff_lzw"), RGB),
    "tiff, 16 bit": (saved(Image.fromarray(GREYS), "TIFF"), None),
    "webp": (saved(Image.fromarray(RGB), "WEBP", lossless=True), RGB),
    "gif": (saved(WITH_HOLE, "GIF"), np.asarray(WITH_HOLE.convert("RGB"))),
    "png, 16-bit grey": (saved(Image.fromarray(GREYS), "PNG"), None),
}


@pytest.mark.parametrize("kind", CONVERTED)
def test_other_files_become_png_of_the_same_colours(kind):
    data, expected = CONVERTED[kind]
    made = permitted(data)
    assert made.startswith(b"\x89PNG")
    if expected is None:
        expected = np.repeat(np.round(GREYS / 257).astype(np.uint8)[..., None], 3, axis=2)
    np.testing.assert_array_equal(shown(made), expected)
    assert permitted(made) == made


@pytest.mark.parametrize("mode", ["CMYK", "YCCK"])
def test_print_colours_become_rgb(mode):
    """Pillow writes CMYK; YCCK is its file with the channels turned."""
    ink = np.stack([255 - SMOOTH[..., k] for k in range(3)] + [np.zeros(SMOOTH.shape[:2], np.uint8)], axis=-1)
    data = saved(Image.fromarray(ink, mode="CMYK"), "JPEG", quality=98)
    if mode == "YCCK":
        data = as_ycck(ink)
    made = permitted(data)
    assert made.startswith(b"\x89PNG")
    assert np.abs(shown(made).astype(int) - SMOOTH).max() <= 6


def as_ycck(ink: np.ndarray) -> bytes:
    """As Photoshop writes it (Adobe's transform 2): Y'CbCr of the inks, and K inverted."""
    cmy = Image.fromarray(np.ascontiguousarray(ink[..., :3])).convert("YCbCr")
    channels = np.dstack([np.asarray(cmy), 255 - ink[..., 3]])
    # Pillow inverts what it writes as CMYK, so it is handed the inverse.
    data = bytearray(saved(Image.fromarray(255 - channels, mode="CMYK"), "JPEG", quality=98))
    marker = data.index(b"Adobe")
    data[marker + 11] = 2
    return bytes(data)


REFUSED = {
    "KTX": b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(64),
    "DDS": b"DDS " + bytes(124),
    "PSD": b"8BPS\0\1" + bytes(64),
    "OpenEXR": b"\x76\x2f\x31\x01" + bytes(64),
    "Radiance HDR": b"#?RADIANCE\n",
    "PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n",
    "SVG": b"<svg xmlns='http://www.w3.org/2000/svg'/>",
    "AVIF": b"\0\0\0\x1cftypavif" + bytes(32),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_other_kinds_are_refused_by_name(kind):
    with pytest.raises(ObjectError, match=f"an image of material 'x' is {kind}; expected PNG") as caught:
        permitted(REFUSED[kind])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"hello", KEPT["png"][:60], KEPT["jpeg"][:200], bytes(300)])
def test_damage_is_one_line(data):
    with pytest.raises(ObjectError, match="an image of material 'x' cannot be decoded") as caught:
        permitted(data)
    assert "\n" not in str(caught.value)
    assert "0x" not in str(caught.value)  # no address


def test_size_is_judged_before_anything_is_decoded():
    """A header that promises 60,000 x 60,000, and nothing behind it."""
    for side, message in ((60000, "larger than"), (9000, "is 9000x9000")):
        header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
        empty = struct.pack(">I", 0) + b"IDAT" + struct.pack(">I", zlib.crc32(b"IDAT"))
        with pytest.raises(ObjectError, match=f"{message}.*sides of at most 64 px"):
            permitted(b"\x89PNG\r\n\x1a\n" + chunk + empty)


def test_transparency_is_seen_in_the_header():
    assert has_alpha(KEPT["png with alpha"])
    assert has_alpha(saved(WITH_HOLE, "PNG", transparency=0))
    assert not has_alpha(KEPT["jpeg"])
    assert not has_alpha(b"hello")
