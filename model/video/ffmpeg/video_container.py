"""Opening the container of a video, what may be the film in it, and what decodes it.

The name of a file is never taken for an address, and what a file says never opens another one.
"""

from pathlib import Path

import av
from av.codec.context import CodecContext
from av.container import InputContainer
from av.stream import Disposition
from av.video.codeccontext import VideoCodecContext
from av.video.stream import VideoStream

from model.errors import ModelError

__all__ = ["alpha_is_lost", "decoder_of", "film_streams", "opened", "reason_of"]

# What cameras, phones, editors and screen recorders write. Absent on purpose are playlists (hls, concat),
# addresses (rtsp, sdp), devices and patterns of file names (image2), which open other things.
_VIDEO_DEMUXERS = (
    "mov,matroska,avi,mpegts,mpeg,mpegvideo,m4v,h261,h263,h264,hevc,vvc,av1,obu,ivf,flv,asf,ogg,gif,apng,mjpeg,"
    "mpjpeg,mxf,gxf,dv,nut,rm,wtv,yuv4mpegpipe,vc1,vc1test,cavsvideo,dirac,dnxhd,mlv,nsv,ser,smjpeg,dhav,kux"
)
_SOUND_DEMUXERS = "aac,ac3,aiff,amr,ape,caf,flac,mp3,wav"  # only to say that it is sound
_CONTAINER_OPTIONS = {
    "format_whitelist": f"{_VIDEO_DEMUXERS},{_SOUND_DEMUXERS}",
    "protocol_whitelist": "file",
}

# Spherical cameras record 11520 x 5760. A decoder holds up to 17 frames: 1.7 GB at this size.
_MAX_FRAME_PIXELS = 1 << 26
_LIMITS = {"max_pixels": str(_MAX_FRAME_PIXELS)}

# FFmpeg's own decoders leave the layer of transparency out.
_ALPHA_DECODERS = {"vp8": "libvpx", "vp9": "libvpx-vp9"}

_PLAYLIST_MARKS = (b"#EXTM3U", b"ffconcat version", b"[playlist]", b"<MPD", b"<smil", b"<asx")


def opened(path: Path) -> InputContainer:
    """The container. ModelError when the file is none that is read here."""
    head = _head(path)
    try:
        container = av.open(
            f"file:{path}",  # without it, what stands before a ':' is a protocol
            metadata_errors="replace",  # titles in Latin-1 are common
            options=_LIMITS,
            container_options=_CONTAINER_OPTIONS,
        )
    except (av.FFmpegError, OSError) as error:
        if any(mark in head for mark in _PLAYLIST_MARKS):
            raise ModelError(
                path,
                "it is a playlist, which only names other files",
                expected="the video itself",
                action="Name the video, or join the parts first (ffmpeg -i PLAYLIST -c copy OUT.mp4).",
            ) from error
        raise _unreadable(path, _fault(error)) from error
    if not len(container.streams):
        container.close()
        raise _unreadable(path, "it has no index: zero length, or cut off")
    return container


def film_streams(container: InputContainer, path: Path) -> list[VideoStream]:
    """The streams that may be the film: no cover images, no tiles of a photo. ModelError if there is none."""
    left_out = Disposition.attached_pic | Disposition.dependent
    films = [stream for stream in container.streams.video if not stream.disposition & left_out]
    if not films:
        kinds = {stream.type for stream in container.streams} - {"video"}
        covers = ["a cover image"] if container.streams.video else []
        raise ModelError(
            path,
            f"it holds {' and '.join([*sorted(kinds), *covers])}, but no video",
            expected="a video",
            action="Choose another file.",
        )
    decodable = [stream for stream in films if stream.codec_context is not None]
    if not decodable:
        raise ModelError(
            path,
            "this build of FFmpeg has no decoder for its codec",
            expected="H.264, HEVC, VP9, AV1, ProRes or another common codec",
            action="Convert it with a program that plays it.",
        )
    largest = max(decodable, key=_area)
    if _area(largest) > _MAX_FRAME_PIXELS:
        raise ModelError(
            path,
            f"its frames are {largest.width} x {largest.height}",
            expected=f"at most {_MAX_FRAME_PIXELS / 1e6:.0f} megapixels",
            action="Scale it down (ffmpeg -i IN -vf scale=3840:-2 OUT.mp4).",
        )
    return decodable


def decoder_of(stream: VideoStream) -> VideoCodecContext:
    """What decodes the stream: its transparency too, where that is a layer of its own."""
    decoder: CodecContext = stream.codec_context
    name = _alpha_decoder(stream)
    if name in av.codecs_available:
        decoder = VideoCodecContext.create(name, "r")
        decoder.extradata = stream.codec_context.extradata
    else:
        decoder.thread_type = "AUTO"
    assert isinstance(decoder, VideoCodecContext)
    decoder.options = _LIMITS
    return decoder


def alpha_is_lost(stream: VideoStream) -> bool:
    """Whether the stream has a layer of transparency, and this build of FFmpeg nothing that reads it."""
    name = _alpha_decoder(stream)
    return name is not None and name not in av.codecs_available


def reason_of(error: Exception) -> str:
    """In words, without the file's name."""
    return str(getattr(error, "strerror", None) or error).lower()


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            head = file.read(1024)
    except OSError as error:
        raise ModelError(
            path,
            f"it cannot be opened ({reason_of(error)})",
            expected="a readable file",
            action="Check its permissions.",
        ) from error
    if not head:
        raise ModelError(
            path, "the file is empty (0 bytes)", expected="a video", action="Copy or record it again."
        )
    return head


def _fault(error: Exception) -> str:
    if isinstance(error, av.EOFError):
        return "it ends before its first frame: zero length, or cut off"
    if isinstance(error, av.ArgumentError):  # what FFmpeg says of a format that is not on the list
        return "its format is none of those that are read here"
    return reason_of(error)


def _unreadable(path: Path, reason: str) -> ModelError:
    return ModelError(
        path,
        f"not a video that can be read ({reason})",
        expected="a complete mp4, mov, mkv, webm, avi, ts or gif file, or a JPEG, PNG, WebP, AVIF, BMP or TIFF",
        action="Play it to check it; a download or recording may have been cut off.",
    )


def _area(stream: VideoStream) -> int:
    return stream.width * stream.height


def _alpha_decoder(stream: VideoStream) -> str | None:
    """What reads a layer of transparency, if the stream has one."""
    metadata = {key.lower(): value for key, value in stream.metadata.items()}
    return _ALPHA_DECODERS.get(stream.codec_context.codec.name) if metadata.get("alpha_mode") == "1" else None
