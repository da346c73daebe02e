"""display_matrix: how a decoded frame is meant to be shown."""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any, cast

import numpy as np
from av.filter import Graph
from av.sidedata.sidedata import Type
from av.video.frame import VideoFrame as DecodedFrame
from jaxtyping import Int

__all__ = ["display_matrix"]

_UNIT = 1 << 16  # 16.16 fixed point
# FFmpeg has about 35 kinds of data beside a frame; PyAV names those of the FFmpeg it was written for.
_KINDS_OF_SIDE_DATA = 64


def display_matrix(frame: DecodedFrame) -> Int[np.ndarray, "2 2"]:
    """How the frame is meant to be shown, also where EXIF says so; the identity if nothing does."""
    try:
        side_data = frame.side_data
    except ValueError:
        # PyAV 18.1 lists nothing of a frame that carries a kind of data which it cannot name (EXIF, say).
        side_data = _without_nameless_data(frame).side_data
    by_kind = cast(Mapping[Any, Any], side_data)  # PyAV's stub knows one of its keys only
    if Type.DISPLAYMATRIX not in by_kind:
        return np.eye(2, dtype=np.int32) * _UNIT
    return np.frombuffer(bytes(by_kind[Type.DISPLAYMATRIX]), np.int32).reshape(3, 3)[:2, :2]


def _without_nameless_data(frame: DecodedFrame) -> DecodedFrame:
    """The same image, passed through FFmpeg's filter that drops data by number."""
    named = {kind.value for kind in Type}
    graph = Graph()
    nodes = [
        graph.add_buffer(
            width=frame.width,
            height=frame.height,
            format=frame.format,
            time_base=frame.time_base or Fraction(1, 1000),
        )
    ]
    for kind in range(_KINDS_OF_SIDE_DATA):
        if kind not in named:
            nodes.append(graph.add("sidedata", mode="delete", type=str(kind)))
    nodes.append(graph.add("buffersink"))
    graph.link_nodes(*nodes).configure()
    graph.vpush(frame)
    return graph.vpull()
