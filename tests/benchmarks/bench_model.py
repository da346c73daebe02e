"""Cost of stage 1: memory of a training step by views, time of a block, time spent waiting for data or for neighbours.

Also a program, because peak memory is a property of a process: `python bench_model.py VIEWS` prints megabytes.
"""

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from accelerate import Accelerator

from model.data.batch import Batch
from model.data.stream import open_motions
from model.encoders.efficientnet import EfficientNetConfig, load_efficientnet
from model.encoders.hand import HandEncoder, HandNet
from model.encoders.protocol import FeatureEncoder
from model.recipes.components.flow_settings import guidance_of
from model.recipes.components.frozen_encoders import OwnHandEncoder, aggregator_over, given_hand_encoder
from model.recipes.components.shard_source import StreamSource
from model.recipes.config import load_config
from model.recipes.stage_one_config import StageOneTrainingConfig
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae
from model.training.precision import used_precision
from model.training.step_generators import sample_generators
from model.training.trainer import StepReport, TrainingEvent, train

ROOT = Path(__file__).resolve().parents[2]
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
VIEWS = (2, 4, 6, 12)


def configuration(name: str) -> StageOneTrainingConfig:
    config = load_config(name)
    assert isinstance(config, StageOneTrainingConfig)
    return config


def stage_one_task(config: StageOneTrainingConfig) -> StageOneTask:
    """The task of a configuration with open encoders, with random weights in all but the image encoder."""
    section, hand = config.stage_one, config.encoders.hand
    assert isinstance(config.encoders.image, EfficientNetConfig)
    torch.manual_seed(0)
    image_encoder = load_efficientnet(config.encoders.image)
    if isinstance(hand, OwnHandEncoder):
        assert config.hand_encoder is not None
        network = HandNet(config.hand_encoder.network).eval()
        hand_encoder: FeatureEncoder = HandEncoder(network=network, grid=hand.own_grid)
    else:
        hand_encoder = given_hand_encoder(config.encoders)
    aggregator = aggregator_over(
        image_encoder,
        hand_encoder,
        hand_width=section.hand_width,
        hidden=section.hidden,
        channels=section.network.masks.feature_channels,
    )
    return StageOneTask(
        network=StageOne(aggregator, section.network).to(DEVICE),
        image_encoder=image_encoder.to(DEVICE, torch.float32),
        hand_encoder=hand_encoder.to(DEVICE, torch.float32),
        vae=StructureVae(config.vae.network).to(DEVICE).eval().requires_grad_(False),
        config=StageOneConfig(
            beta=section.beta,
            drop_condition=section.drop_condition,
            time=section.time,
            sampler=section.sampler,
            guidance=guidance_of(section.guidance, "geometry"),
            latent_scale=1.0,
        ),
        mean_shape=torch.zeros(64, 64, 64, dtype=torch.bool),
    )


def random_batch(views: int, size: int, samples: int = 1) -> Batch:
    masks = torch.zeros(samples, views, size, size, dtype=torch.bool)
    masks[..., size // 4 : size // 2, size // 4 : size // 2] = True
    return Batch(
        images=torch.rand(samples, views, 3, size, size),
        object_amodal=masks,
        object_visible=masks,
        hand_visible=~masks,
        K=torch.eye(3).repeat(samples, views, 1, 1),
        T_cam_from_canonical=torch.eye(4).repeat(samples, views, 1, 1),
        occupancy=torch.rand(samples, 64, 64, 64) > 0.9,
        joints_px=torch.zeros(samples, views, 21, 2),
        is_right=torch.ones(samples, dtype=torch.bool),
        ids=tuple(f"a:0:{sample}" for sample in range(samples)),
    )


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def step_memory_mb(views: int) -> float:
    """Peak memory of one training step of one sample of `small`, above weights and libraries."""
    config = configuration("small")
    task = stage_one_task(config)
    batch = random_batch(views, config.stage_one.recipe.image_size).to(DEVICE, torch.float32)
    if DEVICE.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated() / 1e6
    else:
        before = resident_mb()
    task.loss(batch, sample_generators(0, 0, [0])).total.backward()
    if DEVICE.type == "cuda":
        return torch.cuda.max_memory_allocated() / 1e6 - before
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - before


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_of_a_training_step_by_views(say):
    peaks = {}
    for views in VIEWS:
        command = [sys.executable, str(Path(__file__)), str(views)]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
        peaks[views] = float(done.stdout)
    say(f"peak memory of a training step of one sample, small, {DEVICE.type}:")
    for views, peak in peaks.items():
        say(f"    {views:2d} views {peak:7.0f} MB  {peak / peaks[2]:4.1f}x")
    say(f"    a view more: {(peaks[12] - peaks[2]) / 10:.0f} MB")
    assert peaks[12] < 6 * peaks[2]  # less than in proportion to the views


def milliseconds(function: Callable[[], object], repeats: int = 5) -> float:
    """Median; processor time on a CPU, so other programs do not count."""
    clock = time.perf_counter if DEVICE.type == "cuda" else time.process_time
    seconds = []
    for _ in range(1 + repeats):
        start = clock()
        function()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(clock() - start)
    return 1e3 * statistics.median(seconds[1:])


@pytest.fixture
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("name", ["tiny", "small", pytest.param("paper", marks=pytest.mark.gpu)])
def test_time_of_a_block(name, say):
    if name == "paper" and DEVICE.type == "cpu":
        pytest.skip("4,096 + 5,476 tokens of 1,024 channels are for a GPU")
    views = 4
    network = replace(configuration(name).stage_one.network, checkpoint_blocks=False)
    flow = DualBranchFlow(network).to(DEVICE)
    geometry, masks = network.geometry, network.masks
    y = torch.randn(1, 1, geometry.tokens, geometry.channels, device=DEVICE, requires_grad=True)
    x = torch.randn(1, views, masks.grid**2, masks.channels, device=DEVICE, requires_grad=True)
    t = torch.full((1,), 0.5, device=DEVICE)
    t_geometry, t_masks = flow.geometry.t_embedder(t).detach(), flow.masks.t_embedder(t).detach()
    contexts, weights = flow.context(x, None).detach(), flow.fusion(x).detach()
    one = torch.ones(1, 1, device=DEVICE)

    blocks = {
        f"geometry ({geometry.tokens} tokens)": lambda: flow.geometry.blocks[0](
            y, t_geometry, contexts, weights
        ),
        f"mask ({views} x {masks.grid**2} tokens)": lambda: flow.masks.blocks[0](
            x, t_masks, y[:, 0:1].detach(), one
        ),
    }
    for block, forward in blocks.items():
        with torch.no_grad():
            alone = milliseconds(forward)
        both = milliseconds(lambda forward=forward: forward().sum().backward())
        say(f"{name}: {block} block, {views} views: {alone:.1f} ms forward, {both:.1f} ms with backward")
        assert both > alone


def test_share_of_time_spent_waiting_for_data(tmp_path, say):
    """tiny.yaml as it is, on images that are as hard to decode as rendered ones."""
    from tests.benchmarks.bench_loader import SIZE_PX, photographic
    from tests.model.data.balls import write_balls

    config = configuration("tiny")
    section, steps = config.stage_one, 12
    root = write_balls(
        tmp_path / "balls",
        splits=[["train"] * 4],
        cameras=4,
        n_frames=6,
        size_px=SIZE_PX,
        change_frame=photographic,
    )
    stream = section.recipe.stream(replace(config.data, datasets=(str(root),)), surface=False)
    events: list[TrainingEvent] = []
    train(
        stage_one_task(config),
        StreamSource(config=stream, index=open_motions(stream), rank=0, ranks=1),
        replace(section.recipe.trainer, steps=steps, log_every=1, checkpoint_every=steps),
        section.recipe.optimizer,
        folder=tmp_path / "run",
        config_yaml="bench",
        config_sha256="bench",
        report=events.append,
        accelerator=Accelerator(cpu=DEVICE.type == "cpu"),
    )
    reports = [event for event in events if isinstance(event, StepReport)]
    shares = [report.waiting_share for report in reports[3:]]  # loader processes start during the first
    speed = statistics.median(report.samples_per_s for report in reports[3:])
    mean = statistics.mean(shares)
    say(f"tiny on {DEVICE.type}: {speed:.1f} samples/s, {mean:.1%} of the time waiting for data (aim: < 5 %)")
    assert mean < 0.15


@contextmanager
def neighbour(nice: int) -> Iterator[None]:
    """A program that wants a whole core."""
    program = subprocess.Popen(
        [sys.executable, "-c", f"import os\nos.nice({nice})\nwhile True: pass"], stdin=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        program.kill()
        program.wait()


@pytest.mark.skipif(DEVICE.type == "cuda", reason="a GPU has no neighbours")
def test_a_busy_neighbour_leaves_half_of_the_speed(say):
    """In a program that imports `model` before torch, as `forehoi` does: only then the way of waiting is ours."""
    command = "import model; from tests.benchmarks import bench_model; bench_model.print_speeds()"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", command], env=environment, check=True, capture_output=True, text=True
    )
    precision, quiet, busy = done.stdout.split()
    share = float(busy) / float(quiet)
    say(
        f"tiny, {precision}: {quiet} samples/s alone, {busy} beside a program at nice 10: {share:.0%} (aim: >= 50 %)"
    )
    assert share > 0.5


def print_speeds() -> None:
    """Precision and samples per second of steps of `tiny`, alone and beside another program at nice 10, by turns."""
    config = configuration("tiny")
    section, samples = config.stage_one, config.stage_one.recipe.batch_size
    task = stage_one_task(config)
    batch = random_batch(section.recipe.views[1], section.recipe.image_size, samples)
    precision, _ = used_precision("auto", DEVICE)
    parameters = [parameter for parameter in task.module.parameters() if parameter.requires_grad]
    optimizer = torch.optim.AdamW(parameters, lr=1e-4)

    def step(index: int) -> float:
        start = time.perf_counter()
        generators = sample_generators(0, index, range(samples))
        with torch.autocast(DEVICE.type, torch.bfloat16, enabled=precision == "bfloat16"):
            loss = task.loss(batch, generators).total
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return samples / (time.perf_counter() - start)

    alone: list[float] = []
    beside: list[float] = []
    step(0)
    for _ in range(3):
        alone += [step(index) for index in range(4)]
        with neighbour(nice=10):
            beside += [step(index) for index in range(4)]
    print(precision, f"{statistics.median(alone):.1f}", f"{statistics.median(beside):.1f}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(step_memory_mb(int(sys.argv[1])))
