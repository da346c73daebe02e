"""deinterlaced: frames of interlaced videos without combs."""

from collections import deque
from collections.abc import Iterable, Iterator
from fractions import Fraction

from av.filter import Graph
from av.video.frame import VideoFrame as DecodedFrame

__all__ = ["deinterlaced"]


def deinterlaced(frames: Iterable[DecodedFrame]) -> Iterator[tuple[DecodedFrame, bool]]:
    """Each frame in turn, and whether it was interlaced.

    Such frames are rebuilt at full height (bwdif) from their first field, the frame before and the frame
    after, where there is one. Frames that are not flagged as interlaced are passed on as they are.
    """
    filtered: _Filtered | None = None
    for frame in frames:
        if filtered is None and not frame.interlaced_frame:
            yield frame, False
            continue
        if filtered is None or not filtered.fits(frame):
            yield from filtered.rest() if filtered else ()
            filtered = _Filtered(frame)
        yield from filtered.add(frame)
    yield from filtered.rest() if filtered else ()


class _Filtered:
    """A graph for frames of one layout. It holds one frame back, to see what comes next."""

    def __init__(self, frame: DecodedFrame) -> None:
        self._layout = (frame.width, frame.height, frame.format.name)
        self._waiting: deque[tuple[int | None, bool]] = deque()
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=frame.width,
            height=frame.height,
            format=frame.format,
            time_base=frame.time_base or Fraction(1, 1000),
        )
        bwdif = self._graph.add("bwdif", mode="send_frame", deint="interlaced")
        self._graph.link_nodes(source, bwdif, self._graph.add("buffersink")).configure()

    def fits(self, frame: DecodedFrame) -> bool:
        return self._layout == (frame.width, frame.height, frame.format.name)

    def add(self, frame: DecodedFrame) -> Iterator[tuple[DecodedFrame, bool]]:
        self._waiting.append((frame.pts, frame.interlaced_frame))
        self._graph.vpush(frame)
        yield from self._pulled()

    def rest(self) -> Iterator[tuple[DecodedFrame, bool]]:
        self._graph.vpush(None)
        yield from self._pulled()

    def _pulled(self) -> Iterator[tuple[DecodedFrame, bool]]:
        while True:
            try:
                frame = self._graph.vpull()
            except (BlockingIOError, EOFError):  # it wants more, or has no more
                return
            frame.pts, was_interlaced = self._waiting.popleft()  # the filter counts in half units
            yield frame, was_interlaced
