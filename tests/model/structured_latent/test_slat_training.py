"""The stage-2 tasks on small networks: losses fall, samples are independent, predictions repeat, tables are honest."""

import math

import numpy as np
import pytest
import torch

from model.data.batch import Batch
from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.errors import ModelError
from model.flow import Guidance, SamplerSettings, UniformTime
from model.structured_latent.flow import SlatFlow, SlatFlowConfig
from model.structured_latent.flow_training import LATENT, SlatFlowTask, SlatFlowTraining
from model.structured_latent.mesh_evaluation import MeshEvaluationConfig, mean_scores, scored_mesh
from model.structured_latent.object_features.object_input import ObjectInputs, object_surface
from model.structured_latent.object_features.surface_features import FEATURE_CHANNELS
from model.structured_latent.vae.latent import LatentNormalisation, SlatVaeConfig
from model.structured_latent.vae.surface_loss import SurfaceLossConfig
from model.structured_latent.vae_training import SlatVae, SlatVaeTask, normal_rows
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from model.surface.extraction import ExtractionConfig
from model.surface.fields import CHANNELS, CORNERS
from model.training.step_generators import sample_generators
from model.training.task import Task
from tests.model.encoders.mean_color import MeanColor
from tests.model.networks.sparse.dense import from_samples, occupancy_of
from tests.model.structured_latent.watertight_shapes import (
    ball,
    ball_distance,
    batch_of,
    plate,
    plate_distance,
    shell,
)

VAE = SlatVaeConfig(
    feature_channels=FEATURE_CHANNELS,
    channels=16,
    latent_channels=8,
    blocks=1,
    heads=1,
    mlp_ratio=2,
    window=8,
    upsample=(),
    resolution=64,
)
FLOW = SlatFlowConfig(
    resolution=64,
    latent_channels=8,
    channels=24,
    condition_channels=12,
    blocks=1,
    heads=2,
    mlp_ratio=2,
    patch=4,
    io_channels=(8, 16),
    pool_pseudo_count=0,
    checkpoint_blocks=False,
    preconditioned=False,
)
LOSS = SurfaceLossConfig(
    distance=1.0, surface=0.3, normal=0.1, corner=0.3, color=1.0, deformation=1.0, kl=1e-4, truncation=1.0
)
MESHES = MeshEvaluationConfig(extraction=ExtractionConfig(seal=1), samples=5000)


@pytest.fixture(scope="module")
def batch() -> Batch:
    half = (0.25, 0.2, 0.05)
    return batch_of(
        (ball(radius=0.2), shell(ball_distance(0.2))),
        (plate(half), shell(plate_distance(np.array(half)))),
    )


@pytest.fixture
def vae_task() -> SlatVaeTask:
    torch.manual_seed(0)
    return SlatVaeTask(
        network=SlatVae(VAE), loss_config=LOSS, evaluation=MESHES, inputs=ObjectInputs(of_views=None)
    )


@pytest.fixture
def flow_task(vae_task) -> SlatFlowTask:
    torch.manual_seed(1)
    aggregator = FeatureAggregator(
        AggregatorConfig(
            image_channels=3, image_grid=4, hand_channels=3, hand_grid=2, hand_width=8, hidden=16, channels=12
        )
    )
    normalisation = LatentNormalisation(torch.full((8,), 0.1), torch.full((8,), 0.7))
    return SlatFlowTask(
        network=ViewConditionedSlatFlow(aggregator, SlatFlow(FLOW), normalisation),
        image_encoder=MeanColor(4),
        hand_encoder=MeanColor(2),
        vae=vae_task.network.eval().requires_grad_(False),
        config=SlatFlowTraining(
            drop_condition=0.1,
            time=UniformTime(),
            sampler=SamplerSettings(steps=2, rescale_t=1.0),
            guidance=Guidance(strength={LATENT: 1.0}, interval=(0.5, 1.0)),
        ),
        evaluation=MESHES,
        inputs=ObjectInputs(of_views=None),
    )


def test_both_are_tasks(vae_task, flow_task):
    assert isinstance(vae_task, Task)
    assert isinstance(flow_task, Task)


def test_the_vae_learns_two_objects(vae_task, batch):
    """Fifteen seconds of a core: both come back watertight, with their colours, near their true surfaces."""
    optimizer = torch.optim.AdamW(vae_task.module.parameters(), lr=1e-2, betas=(0.9, 0.99), weight_decay=0)
    first = None
    for step in range(60):
        losses = vae_task.loss(batch, sample_generators(0, step, range(2)))
        first = float(losses.total.detach()) if first is None else first
        losses.total.backward()
        torch.nn.utils.clip_grad_norm_(vae_task.module.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
    assert float(losses.total.detach()) < 0.35 * first
    metrics = vae_task.evaluate([batch]).metrics
    assert metrics["f_5mm"] > 99
    assert metrics["manifold"] == 100
    assert metrics["normal_deg"] < 20
    assert metrics["color_error"] < 0.1


def test_losses_reach_every_trained_parameter(vae_task, flow_task, batch):
    vae_task.network.requires_grad_(True)
    vae_task.loss(batch, sample_generators(0, 0, range(2))).total.backward()
    assert [n for n, p in vae_task.module.named_parameters() if p.grad is None] == []
    flow_task.loss(batch, sample_generators(0, 0, range(2))).total.backward()
    assert [n for n, p in flow_task.module.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize("kind", ["vae_task", "flow_task"])
def test_the_loss_of_a_sample_does_not_depend_on_its_neighbours(kind, batch, request):
    task: Task = request.getfixturevalue(kind)
    with torch.no_grad():
        whole = task.loss(batch, sample_generators(0, 5, range(2)))
        alone = [
            task.loss(batch.part(place, place + 1), sample_generators(0, 5, [place])).total
            for place in range(2)
        ]
    torch.testing.assert_close(torch.stack(alone).mean(), whole.total, rtol=1e-4, atol=1e-6)


def test_features_are_computed_once_per_object(vae_task, batch, monkeypatch):
    first = vae_task.inputs(batch)
    monkeypatch.setattr("model.structured_latent.object_features.object_input.object_features", None)
    again = vae_task.inputs(batch)
    torch.testing.assert_close(again.features.features, first.features.features, rtol=0, atol=0)


def test_noise_of_a_voxel_does_not_depend_on_other_samples(vae_task, batch):
    grid = vae_task.inputs(batch).features.grid
    both = normal_rows(grid, 3, sample_generators(0, 0, [0, 1]))
    second = normal_rows(vae_task.inputs(batch.part(1, 2)).features.grid, 3, sample_generators(0, 0, [1]))
    torch.testing.assert_close(both[grid.sample_sizes[0] :], second, rtol=0, atol=0)


def test_prediction_is_repeatable_and_lies_on_the_given_voxels(flow_task, batch):
    a, b = (
        flow_task.predict(batch.images, batch.occupancy, torch.Generator().manual_seed(3)) for _ in range(2)
    )
    torch.testing.assert_close(a.decoded.features, b.decoded.features, rtol=0, atol=0)
    assert torch.equal(occupancy_of(a.latent.grid), batch.occupancy)
    fields = a.fields(1)
    assert len(fields.voxels) == int(batch.occupancy[1].sum())


def test_true_latents_come_back_through_normalisation(flow_task, batch):
    clean = flow_task.clean_latent(batch)
    mean = flow_task.vae.encoder(flow_task.inputs(batch).features).mean
    torch.testing.assert_close(flow_task.decoded(clean).latent.features, mean.features, rtol=1e-4, atol=1e-5)


def test_the_table_shows_what_is_learned(flow_task, batch):
    evaluation = flow_task.evaluate([batch])
    for name in ("f_5mm", "mean_latent_f_5mm", "true_latent_f_5mm", "latent_error"):
        assert name in evaluation.metrics
    image = next(iter(evaluation.images.values()))
    assert image.shape == (2 * 192, 4 * 192, 3)


def test_an_object_without_a_mesh_is_counted(flow_task, batch):
    decoded = flow_task.decoded(flow_task.clean_latent(batch)).decoded
    outside = decoded.with_features(torch.full_like(decoded.features, 3.0))
    truth = object_surface(batch.true_surface, 0)
    metrics = mean_scores([scored_mesh(outside, 0, truth, MESHES)])
    assert metrics["without_mesh"] == 1
    assert metrics["f_10mm"] == 0
    assert metrics["chamfer_cm"] == pytest.approx(200 * math.sqrt(3) * truth.object_scale_m)
    assert math.isnan(metrics["normal_deg"])  # not 0, which would be perfect
    assert math.isnan(metrics["handles"])


def test_a_pierced_surface_shows_in_its_handles(batch):
    """Of a ball's own distances: one component without handles. A third of the signs wrong: pierced, still manifold."""
    voxels = torch.from_numpy(np.argwhere(batch.occupancy[0].numpy()))
    corners = voxels[:, None].numpy() + CORNERS
    channels = torch.zeros(len(voxels), CHANNELS)
    channels[:, :8] = torch.from_numpy(ball_distance(0.2)(corners / 64 - 0.5) * 64).float() + 1 / 64
    wrong = np.random.default_rng(0).random((65, 65, 65)) < 1 / 3
    flips = torch.from_numpy(np.where(wrong[tuple(np.moveaxis(corners, -1, 0))], -1.0, 1.0)).float()
    truth = object_surface(batch.true_surface, 0)

    def metrics(channels: torch.Tensor) -> dict[str, float]:
        decoded = from_samples([channels], [voxels], 64)
        return mean_scores([scored_mesh(decoded, 0, truth, MESHES)])

    clean = metrics(channels)
    assert (clean["handles"], clean["components"], clean["manifold"]) == (0, 1, 100)
    pierced = channels.clone()
    pierced[:, :8] *= flips
    assert metrics(pierced)["handles"] > 50
    assert metrics(pierced)["manifold"] == 100


def test_a_batch_without_surfaces_is_refused(vae_task, batch):
    bare = Batch(**{**vars(batch), "surface": None})
    with pytest.raises(ModelError, match="surfaces"):
        vae_task.loss(bare, sample_generators(0, 0, range(2)))
