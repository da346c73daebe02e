"""Reading over HTTP, from a real server of this machine: with byte ranges, and from one that ignores them."""

import functools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from shards.errors import ShardError, StorageError
from shards.reader import open_dataset
from shards.verify import verify_dataset

CLIP = "motion-000000-camera-00"


class Plain(SimpleHTTPRequestHandler):
    """`python -m http.server`: answers a range request with the whole file. Says nothing on the terminal."""

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 the name of the base class
        pass


class WithRanges(Plain):
    """Answers a range of bytes with these bytes, as file servers do."""

    def do_GET(self) -> None:
        path, asked = Path(self.translate_path(self.path)), self.headers.get("Range", "")
        if not asked or not path.is_file():
            super().do_GET()
            return
        first, last = (int(number) for number in asked.removeprefix("bytes=").split("-"))
        data = path.read_bytes()
        part = data[first : last + 1]
        self.send_response(206)
        self.send_header("Content-Length", str(len(part)))
        self.send_header("Content-Range", f"bytes {first}-{first + len(part) - 1}/{len(data)}")
        self.end_headers()
        self.wfile.write(part)


@contextmanager
def served(folder: Path, handler: type[SimpleHTTPRequestHandler]) -> Iterator[str]:
    """The address of `folder` while the block runs."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(handler, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_server_with_ranges_reads_as_the_disk(dataset_dir: Path) -> None:
    with served(dataset_dir, WithRanges) as url:
        remote = open_dataset(url).read_frames(CLIP, ["rgb", "T_cam_from_world"])
    assert remote.arrow.equals(open_dataset(dataset_dir).read_frames(CLIP, ["rgb", "T_cam_from_world"]).arrow)


def test_a_server_without_ranges_is_named_and_the_shard_not_blamed(dataset_dir: Path) -> None:
    with served(dataset_dir, Plain) as url:
        dataset = open_dataset(url)
        with pytest.raises(
            StorageError, match=r"frames\.parquet: the server does not answer range requests"
        ) as caught:
            dataset.read_frames(CLIP)
        assert "download the dataset, or use a server that does" in str(caught.value)
        assert "delete" not in str(caught.value)
        with pytest.raises(StorageError, match="range requests"):
            list(dataset.clips())
        (report,) = verify_dataset(url)
    assert len(report.findings) == 3  # one for each file; nothing is called damaged
    assert all("range requests" in finding.problem for finding in report.findings)


@pytest.mark.parametrize("url", ["nonsense://somewhere/data", "https+x://y"])
def test_an_address_of_an_unknown_kind_is_one_line(url: str) -> None:
    with pytest.raises(ShardError, match=r"cannot be opened: .*correct it") as caught:
        open_dataset(url)
    assert "\n" not in str(caught.value)
