"""High dynamic range on an ordinary screen: what BT.2100 and BT.2408 say of single colours, and quickly."""

import time
from pathlib import Path

import av
import numpy as np
import pytest
from av.video.reformatter import ColorPrimaries, ColorTrc

from model.video.ffmpeg.tone_mapping import Transfer, standard_range
from model.video.frames import ReadLimits
from model.video.reading import read_informative_frames
from tests.model.video.encoded_videos import numbered_frame, write_video

ALL = ReadLimits(max_frames=64, max_side_px=512)
HLG, PQ, BT2020 = 18, 16, 9  # FFmpeg's numbers


def pq_code(nits: float) -> float:
    """SMPTE ST 2084."""
    power = (nits / 10000.0) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


def hlg_code(light: float) -> float:
    """BT.2100's OETF of scene light 0..1."""
    if light <= 1 / 12:
        return (3 * light) ** 0.5
    return 0.17883277 * np.log(12 * light - 0.28466892) + 0.55991073


BT2020_FROM_BT709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.0880, 0.8956]])


def codes_of(nits: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Codes of BT.2020 light on a display, one colour a row."""
    if transfer == "PQ":
        return np.array([[pq_code(light) for light in row] for row in nits])
    luminance = nits @ [0.2627, 0.6780, 0.0593] / 1000.0
    scene = nits / 1000.0 * luminance[:, None] ** (1 / 1.2 - 1)
    return np.array([[hlg_code(light) for light in row] for row in scene])


def shown(codes: list[float] | np.ndarray, transfer: Transfer) -> np.ndarray:
    """8-bit results of codes 0..1, one row each; a number is a grey."""
    codes = np.asarray(codes, np.float64)
    rgb = codes if codes.ndim == 2 else np.repeat(codes[:, None], 3, axis=1)
    return standard_range(np.round(rgb[None] * 65535).astype(np.uint16), transfer)[0].astype(int)


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_greys_stay_grey_in_their_order_from_black_to_white(transfer: Transfer) -> None:
    grey = shown(np.linspace(0, 1, 1025), transfer)
    assert np.ptp(grey, axis=1).max() <= 1
    assert (np.diff(grey[:, 1]) >= 0).all()
    assert grey[0, 1] == 0
    assert grey[-1, 1] == 255


def test_both_kinds_show_the_same_light_alike() -> None:
    nits = np.array([1.0, 10.0, 26.0, 100.0, 203.0, 600.0, 1000.0])
    scene = (nits / 1000.0) ** (1 / 1.2)
    hlg = shown([hlg_code(light) for light in scene], "HLG")
    pq = shown([pq_code(light) for light in nits], "PQ")
    assert np.abs(hlg - pq).max() <= 1


def test_greys_keep_their_light_up_to_reference_white() -> None:
    """Light relative to 203 nits (BT.2408) on a screen of gamma 2.4; HLG's 75 % is that white."""
    nits = np.array([1.0, 5.0, 18.0, 50.0, 100.0, 203.0])
    expected = 255.0 * (nits / 203.0) ** (1 / 2.4)
    assert np.abs(shown([pq_code(light) for light in nits], "PQ")[:, 1] - expected).max() <= 1.0
    assert shown([0.75], "HLG")[0].min() >= 254


def test_what_is_brighter_than_white_keeps_its_hue() -> None:
    """An orange of four times the light stays orange; cut by channel it would turn yellow."""
    orange = np.array([[1.0, 0.4, 0.1]])
    result = shown(codes_of(4.0 * 203.0 * orange @ BT2020_FROM_BT709.T, "PQ"), "PQ")
    np.testing.assert_allclose(result, 255.0 * orange ** (1 / 2.4), atol=2)


@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_colours_of_an_ordinary_screen_are_kept(transfer: Transfer) -> None:
    """A colour of BT.709 in BT.2020's primaries comes out as itself."""
    steps = np.linspace(5, 250, 8)
    colours = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    nits = 203.0 * (colours / 255.0) ** 2.4 @ BT2020_FROM_BT709.T
    np.testing.assert_allclose(shown(codes_of(nits, transfer), transfer), colours, atol=2)


@pytest.mark.slow
@pytest.mark.parametrize("transfer", ["HLG", "PQ"])
def test_swscale_agrees_on_ordinary_colours(transfer: Transfer) -> None:
    """FFmpeg's own conversion, whose tables take seconds. It makes pure colours paler (by up to 57)."""
    steps = np.linspace(110, 220, 8) / 255.0
    colours = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    codes = codes_of(203.0 * colours**2.4 @ BT2020_FROM_BT709.T, transfer)
    pixels = np.round(codes.reshape(-1, 8, 3) * 65535).astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(pixels, format="rgb48le")
    frame.color_trc, frame.color_primaries = {"HLG": HLG, "PQ": PQ}[transfer], BT2020
    other = frame.reformat(
        format="rgb24", dst_color_trc=ColorTrc.BT709, dst_color_primaries=ColorPrimaries.BT709
    )
    difference = standard_range(pixels, transfer).astype(int) - other.to_ndarray()
    assert np.percentile(np.abs(difference), 95) <= 3


def test_pure_colours_of_bt2020_keep_their_hue() -> None:
    for channel in range(3):
        code = np.zeros(3)
        code[channel] = 0.6
        result = shown(code[None], "HLG")[0]
        assert result.argmax() == channel
        assert np.delete(result, channel).max() <= 40


@pytest.mark.parametrize("transfer", [HLG, PQ])
def test_a_short_hdr_video_takes_less_than_a_second(tmp_path: Path, transfer: int) -> None:
    """8 frames of 160 x 120 and the choice among them; swscale's tables take 3.5 s, for each reading."""
    frames = [numbered_frame(number, (160, 120)) for number in range(8)]
    path = write_video(
        tmp_path / "h.mov", frames, codec="libx265", pix_fmt="yuv420p10le", hdr_transfer=transfer
    )
    start = time.process_time()
    read, _ = read_informative_frames(path, 8, ALL, max_side_px=2048)
    assert time.process_time() - start < 1.0
    assert read.indices.tolist() == list(range(8))
    assert any("high dynamic range" in change for change in read.changes)
