"""Samples per second of the stream: against pure decoding, and against two other formats.

webdataset and mosaicml-streaming hold exactly the samples of our epoch 0 (the encoded bytes of the
views that were drawn, nothing else), and decode, crop and stack them with the same functions. Neither is
a dependency:

    pip install --no-deps webdataset mosaicml-streaming braceexpand xxhash zstd Brotli python-snappy cramjam catalogue

mosaicml-streaming also imports torchvision, for data sets of its own that are not used here; an empty
package stands in for it when it is missing.
"""

import importlib.util
import itertools
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, get_worker_info

from model.data.batch import Batch, TrainingSample, stack_samples
from model.data.clip_frames import ClipFrames
from model.data.crop import crop_image, crop_masks, draw_crop, mirrored, union_box
from model.data.index import FRAME_COLUMNS, MotionIndex, open_motions
from model.data.order import RandomStream, SampleKey, random_stream, rank_batches
from model.data.reader import choose_views
from model.data.stream import ShardStream, StreamConfig, StreamState
from shards.schema import FrameRow
from shards.splits import Split
from shards.storage.images import encode_rgb_png
from tests.model.data.balls import VARIED, stream_config, write_balls

SIZE_PX, CROP_PX, VIEWS, BATCH, WORKERS, PREFETCH = 256, 224, 4, 8, 2, 2
BATCHES, SKIPPED = 40, 4  # the first ones arrive while the processes start
COLUMNS = ["K", "T_cam_from_obj", "joints_px", "boxes_px", "T_objmesh_from_canonical"]
SHAPES = [(VIEWS, 3, 3), (VIEWS, 4, 4), (VIEWS, 21, 2), (VIEWS, 2, 4), (4, 4)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Stored:
    """One sample as the other formats hold it."""

    rgb: list[bytes]
    masks: list[bytes]
    numbers: bytes  # float64, COLUMNS in order
    voxels: bytes


def photographic(frame: FrameRow) -> FrameRow:
    """The frame with an image that is as hard to compress as a rendered one (about 85 kB of PNG)."""
    seed = [frame.frame_index, *frame.clip_id.encode()]
    rng = np.random.default_rng(seed)
    smooth = cv2.resize(rng.uniform(0, 255, (24, 24, 3)), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_CUBIC)
    grain = rng.normal(0, 1.0, (SIZE_PX, SIZE_PX, 3))
    return replace(frame, rgb=encode_rgb_png(np.clip(smooth + grain, 0, 255).astype(np.uint8)))


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> StreamConfig:
    root = tmp_path_factory.mktemp("bench") / "balls"
    splits: list[list[Split]] = [["train"] * 4, ["train"] * 4]
    write_balls(root, splits=splits, cameras=2, n_frames=12, size_px=SIZE_PX, change_frame=photographic)
    return stream_config(
        root,
        image_size=CROP_PX,
        views=(VIEWS, VIEWS),
        batch_size=BATCH,
        samples_per_motion=BATCHES * BATCH // 8,
        augmentation=VARIED,
        prefetch_batches=PREFETCH,
    )


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> None:
    cv2.setNumThreads(0)
    torch.set_num_threads(1)


def epoch_keys(config: StreamConfig, index: MotionIndex) -> list[tuple[SampleKey, ...]]:
    batches = rank_batches(
        StreamState(epoch=0, consumed=0),
        n_motions=len(index.motions),
        samples_per_motion=config.samples_per_motion,
        batch_size=config.batch_size,
        views=config.views,
        seed=config.seed,
        rank=0,
        world_size=1,
        endless=True,
    )
    return [keys for keys, _ in itertools.islice(batches, BATCHES)]


def stored_samples(config: StreamConfig) -> Iterator[Stored]:
    """The samples of epoch 0, encoded."""
    index = open_motions(config)
    clips: dict[tuple[int, int], ClipFrames] = {}
    for key in (key for keys in epoch_keys(config, index) for key in keys):
        motion = index.motions[key.item]
        shard = index.shards[motion.shard]
        table = shard.read_clips(["clip_id", "K"])
        objects = shard.read_objects(["object_uid", "T_objmesh_from_canonical", "occupancy_64"])
        rng = random_stream(config.seed, key.epoch, key.position, RandomStream.VIEWS)
        views = choose_views(motion, key.n_views, rng)
        for row, _ in views:
            if (motion.shard, row) not in clips:
                frames = shard.read_frames(table["clip_id"][row], FRAME_COLUMNS)
                clips[motion.shard, row] = ClipFrames(frames)
        seen = [(clips[motion.shard, row], row, frame) for row, frame in views]
        number = objects["object_uid"].index(motion.object_uid)
        numbers = [
            np.stack([table["K"][row] for _, row, _ in seen]),
            np.stack([clip.T_cam_from_obj(frame) for clip, _, frame in seen]),
            np.stack([clip.joints_px(frame) for clip, _, frame in seen]),
            np.stack([clip.boxes_px(frame) for clip, _, frame in seen]),
            objects["T_objmesh_from_canonical"][number],
        ]
        yield Stored(
            rgb=[bytes(clip.encoded("rgb", frame)) for clip, _, frame in seen],
            masks=[bytes(clip.encoded("masks", frame)) for clip, _, frame in seen],
            numbers=b"".join(np.float64(array).tobytes() for array in numbers),
            voxels=objects["occupancy_64"][number].tobytes(),
        )


def decoded(stored: Stored, rng: np.random.Generator) -> TrainingSample:
    """What SampleReader does, from bytes that are already there."""
    ends = np.cumsum([np.prod(shape) for shape in SHAPES])
    flat = np.split(np.frombuffer(stored.numbers, np.float64), ends[:-1])
    numbers = dict(zip(COLUMNS, (part.reshape(shape) for part, shape in zip(flat, SHAPES))))
    flip = rng.random() < VARIED.flip_probability
    images = np.empty((VIEWS, 3, CROP_PX, CROP_PX), np.float32)
    crops, masks = [], []
    for view in range(VIEWS):
        box = union_box(numbers["boxes_px"][view].astype(np.int32), (SIZE_PX, SIZE_PX))
        crop = draw_crop(box, numbers["K"][view], CROP_PX, VARIED, rng)
        bits = cv2.imdecode(np.frombuffer(stored.masks[view], np.uint8), cv2.IMREAD_GRAYSCALE)
        rgb = cv2.imdecode(np.frombuffer(stored.rgb[view], np.uint8), cv2.IMREAD_COLOR_RGB)
        masks.append(crop_masks(bits, crop))
        image = crop_image(rgb, crop)
        for channel in range(3):
            np.multiply(image[..., channel], np.float32(1 / 255), out=images[view, channel])
        crops.append(crop)
    occupancy = np.zeros((64, 64, 64), bool)
    occupancy[tuple(np.frombuffer(stored.voxels, np.uint8).reshape(-1, 3).T)] = True
    T = np.stack([c.T_crop_from_cam @ T for c, T in zip(crops, numbers["T_cam_from_obj"])])
    joints_px = [c.points(joints) for c, joints in zip(crops, numbers["joints_px"])]
    sample = TrainingSample(
        motion_id="",
        object_uid="",
        clip_ids=("",) * VIEWS,
        frame_indices=np.zeros(VIEWS, int),
        images=images,
        object_amodal=np.stack([m.object_amodal for m in masks]),
        object_visible=np.stack([m.object_visible for m in masks]),
        hand_visible=np.stack([m.hand_visible for m in masks]),
        K=np.stack([c.K for c in crops]).astype(np.float32),
        T_cam_from_canonical=(T @ numbers["T_objmesh_from_canonical"]).astype(np.float32),
        occupancy=occupancy,
        joints_px=np.stack(joints_px).astype(np.float32),
        is_right=True,
    )
    return mirrored(sample) if flip else sample


def from_fields(fields: dict[str, bytes]) -> TrainingSample:
    stored = Stored(
        rgb=[fields[f"rgb{v}"] for v in range(VIEWS)],
        masks=[fields[f"masks{v}"] for v in range(VIEWS)],
        numbers=fields["numbers"],
        voxels=fields["voxels"],
    )
    return decoded(stored, np.random.default_rng(len(fields["rgb0"])))


def as_fields(stored: Stored) -> dict[str, bytes]:
    named = {f"rgb{v}": stored.rgb[v] for v in range(VIEWS)}
    named |= {f"masks{v}": stored.masks[v] for v in range(VIEWS)}
    return named | {"numbers": stored.numbers, "voxels": stored.voxels}


def stacked(samples: list[TrainingSample]) -> Batch:
    return stack_samples(samples, [""] * len(samples), shared=get_worker_info() is not None)


def one_thread_worker(_: int) -> None:
    cv2.setNumThreads(0)
    torch.set_num_threads(1)


def samples_per_second(batches: Iterable[Batch]) -> float:
    iterator = iter(batches)
    for _ in range(SKIPPED):
        next(iterator)
    start, count = time.perf_counter(), 0
    for batch in itertools.islice(iterator, BATCHES - SKIPPED):
        count += len(batch.ids)
    return count / (time.perf_counter() - start)


def speed_of_stream(config: StreamConfig, *, workers: int) -> float:
    stream = ShardStream(replace(config, workers=workers))
    try:
        return samples_per_second(stream)
    finally:
        stream.close()


def decoded_batches(config: StreamConfig) -> Iterator[Batch]:
    """Decode, crop and stack, with the encoded samples in memory and nothing else to do."""
    stored = list(stored_samples(config))
    for start in range(0, len(stored), BATCH):
        yield stacked(
            [decoded(s, np.random.default_rng(len(s.rgb[0]))) for s in stored[start : start + BATCH]]
        )


def processor_ms_per_sample(batches: Iterator[Batch]) -> float:
    """Processor time of this process; other programs on the machine do not change it much."""
    for _ in range(SKIPPED):
        next(batches)
    start, count = time.process_time(), 0
    for batch in itertools.islice(batches, BATCHES - SKIPPED):
        count += len(batch.ids)
    return 1e3 * (time.process_time() - start) / count


def test_stream_against_pure_decoding(config, say):
    stored = list(itertools.islice(stored_samples(config), 40))
    start = time.process_time()
    for sample in stored:
        for rgb, masks in zip(sample.rgb, sample.masks):
            cv2.imdecode(np.frombuffer(rgb, np.uint8), cv2.IMREAD_COLOR_RGB)
            cv2.imdecode(np.frombuffer(masks, np.uint8), cv2.IMREAD_GRAYSCALE)
    images_ms = 1e3 * (time.process_time() - start) / len(stored)
    pure_ms = processor_ms_per_sample(decoded_batches(config))
    ours_ms = processor_ms_per_sample(iter(ShardStream(config)))
    say(f"processor time per sample of {VIEWS} views: {images_ms:.1f} ms to decode the images alone,")
    say(f"{pure_ms:.1f} ms to decode, crop and stack from memory, {ours_ms:.1f} ms from shards:")
    say(f"the stream runs at {pure_ms / ours_ms:.0%} of pure decoding in one process")
    pure = samples_per_second(decoded_batches(config))
    for workers in (0, 1, 2):
        speed = speed_of_stream(config, workers=workers)
        say(f"{workers} loader processes: {speed:.1f} samples/s; pure, one process: {pure:.1f} samples/s")


def test_stream_against_webdataset(config, say, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    parts = [str(tmp_path / f"part-{part}.tar") for part in range(WORKERS)]  # it divides by file
    writers = [webdataset.TarWriter(part) for part in parts]
    for i, stored in enumerate(stored_samples(config)):
        writers[i % WORKERS].write({"__key__": f"{i:06d}", **as_fields(stored)})
    for writer in writers:
        writer.close()

    def loader(workers: int) -> DataLoader:
        dataset = webdataset.WebDataset(parts, shardshuffle=False).shuffle(64).map(from_fields)
        return DataLoader(
            dataset.batched(BATCH, collation_fn=stacked),
            batch_size=None,
            num_workers=workers,
            prefetch_factor=PREFETCH if workers else None,
            worker_init_fn=one_thread_worker,
        )

    compare("webdataset", loader, config, say)


# its loader processes abort when an epoch is left early
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_stream_against_mosaicml_streaming(config, say, tmp_path, monkeypatch):
    if importlib.util.find_spec("torchvision") is None:
        stand_in_for_torchvision(tmp_path / "stand_in")
        monkeypatch.syspath_prepend(str(tmp_path / "stand_in"))
    streaming = pytest.importorskip("streaming")
    samples = [as_fields(stored) for stored in stored_samples(config)]
    columns = dict.fromkeys(samples[0], "bytes")
    with streaming.MDSWriter(out=str(tmp_path / "mds"), columns=columns, compression=None) as writer:
        for fields in samples:
            writer.write(fields)

    def loader(workers: int) -> DataLoader:
        streaming.base.util.clean_stale_shared_memory()  # its locks do not survive a second use
        dataset = streaming.StreamingDataset(local=str(tmp_path / "mds"), shuffle=True, batch_size=BATCH)
        return DataLoader(
            dataset,
            batch_size=BATCH,
            collate_fn=decode_and_stack,
            num_workers=workers,
            prefetch_factor=PREFETCH if workers else None,
            worker_init_fn=one_thread_worker,
        )

    compare("mosaicml-streaming", loader, config, say)


def decode_and_stack(rows: list[dict[str, bytes]]) -> Batch:
    return stacked([from_fields(row) for row in rows])


def stand_in_for_torchvision(folder: Path) -> None:
    files = {
        "__init__.py": "",
        "datasets.py": "class VisionDataset: ...\n",
        "transforms/__init__.py": "",
        "transforms/functional.py": "to_tensor = None\n",
    }
    for name, text in files.items():
        path = folder / "torchvision" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def compare(name: str, loader: Callable[[int], Iterable[Batch]], config: StreamConfig, say) -> None:
    """Taken in turns, because other programs may be running: the best of two, then the median of five."""
    theirs_ms = min(processor_ms_per_sample(iter(loader(0))) for _ in range(2))
    ours_ms = min(processor_ms_per_sample(iter(ShardStream(config))) for _ in range(2))
    say(f"processor time per sample: {name} {theirs_ms:.1f} ms, stream {ours_ms:.1f} ms")
    say(f"the stream runs at {theirs_ms / ours_ms:.2f}x in one process")
    pairs = [
        (samples_per_second(loader(WORKERS)), speed_of_stream(config, workers=WORKERS)) for _ in range(5)
    ]
    theirs, ours = (statistics.median(speeds) for speeds in zip(*pairs))
    say(
        f"{WORKERS} loader processes: {name} {theirs:.1f} samples/s, stream {ours:.1f} = {ours / theirs:.2f}x"
    )
