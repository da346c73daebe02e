"""The stage-1 task on small sizes: losses reach every trained part, prediction is repeatable, targets are exact."""

import math
from dataclasses import replace

import pytest
import torch

from model.data.batch import Batch
from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.encoders.cached import CachedEncoder
from model.encoders.hand import HandEncoder, HandNet, HandNetConfig
from model.flow import Guidance, SamplerSettings, UniformTime
from model.sparse_structure.dual_branch import DualBranchConfig
from model.sparse_structure.geometry_branch import GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranchConfig
from model.sparse_structure.stage_one import METRICS, StageOne, StageOneConfig, StageOneTask, mask_targets
from model.sparse_structure.vae import StructureVae, VaeConfig
from model.sparse_structure.vae_training import turned
from model.training.step_generators import sample_generators
from tests.model.encoders.mean_color import MeanColor


@pytest.fixture
def task() -> StageOneTask:
    torch.manual_seed(0)
    vae = VaeConfig(patch=4, channels=(8, 8), latent_channels=4, residual_blocks=(1, 1), middle_blocks=1)
    flow = DualBranchConfig(
        geometry=GeometryBranchConfig(
            latent_resolution=8,
            latent_channels=4,
            patch=2,
            channels=32,
            condition_channels=32,
            blocks=2,
            heads=2,
            mlp_ratio=2,
            preconditioned=False,
        ),
        masks=MaskBranchConfig(
            feature_channels=16, grid=4, patch=4, channels=32, blocks=2, heads=2, mlp_ratio=2
        ),
        checkpoint_blocks=False,
    )
    aggregator = FeatureAggregator(
        AggregatorConfig(
            image_channels=3, image_grid=4, hand_channels=3, hand_grid=2, hand_width=8, hidden=16, channels=16
        )
    )
    return StageOneTask(
        network=StageOne(aggregator, flow),
        image_encoder=MeanColor(4),
        hand_encoder=MeanColor(2),
        vae=StructureVae(vae).eval().requires_grad_(False),
        config=StageOneConfig(
            beta=1.0,
            drop_condition=0.1,
            time=UniformTime(),
            sampler=SamplerSettings(steps=3, rescale_t=1.0),
            guidance=Guidance(strength={"geometry": 1.0}, interval=(0.5, 1.0)),
            latent_scale=1.0,
        ),
        mean_shape=torch.zeros(64, 64, 64, dtype=torch.bool),
    )


@pytest.fixture
def batch() -> Batch:
    generator = torch.Generator().manual_seed(1)
    occupancy = torch.zeros(3, 64, 64, 64, dtype=torch.bool)
    occupancy[:, 20:40, 20:50, 25:35] = True
    amodal = torch.zeros(3, 2, 32, 32, dtype=torch.bool)
    amodal[..., 8:24, 10:20] = True
    visible = amodal.clone()
    visible[..., 16:24, :] = False
    return Batch(
        images=torch.rand(3, 2, 3, 32, 32, generator=generator),
        object_amodal=amodal,
        object_visible=visible,
        hand_visible=amodal & ~visible,
        K=torch.eye(3).expand(3, 2, 3, 3).clone(),
        T_cam_from_canonical=torch.eye(4).expand(3, 2, 4, 4).clone(),
        occupancy=occupancy,
        joints_px=torch.zeros(3, 2, 21, 2),
        is_right=torch.ones(3, dtype=torch.bool),
        ids=("a:0:0", "b:0:1", "c:0:2"),
    )


def test_the_loss_trains_aggregator_and_both_branches_and_nothing_frozen(task, batch):
    for parameter in task.module.parameters():  # away from zero-initialised projections
        torch.nn.init.normal_(parameter, std=0.05)
    losses = task.loss(batch, sample_generators(0, 0, range(3)))
    losses.total.backward()
    assert set(losses.parts) == {"masks", "geometry"}
    without = {name for name, p in task.module.named_parameters() if p.grad is None or not p.grad.any()}
    # A constant added to every view's score changes no weight: rounding decides whether its gradient is zero.
    assert without <= {"flow.fusion.score.2.bias"}
    assert all(p.grad is None for p in task.vae.parameters())


def test_the_loss_of_a_sample_does_not_depend_on_its_neighbours(task, batch):
    """As it must when ranks share a global batch."""
    whole = task.loss(batch, sample_generators(0, 5, range(3))).total
    alone = [task.loss(one(batch, place), sample_generators(0, 5, [place])).total for place in range(3)]
    torch.testing.assert_close(torch.stack(alone).mean(), whole, rtol=1e-5, atol=1e-6)


def one(batch: Batch, place: int) -> Batch:
    return batch.part(place, place + 1)


def test_prediction_is_repeatable_and_has_the_sizes_of_its_inputs(task, batch):
    a, b = (task.predict(batch.images, torch.Generator().manual_seed(3)) for _ in range(2))
    assert a.occupancy.shape == (3, 64, 64, 64)
    assert a.masks.shape == (3, 2, 16, 16)
    assert torch.equal(a.masks, b.masks)
    assert torch.equal(a.occupancy, b.occupancy)


def test_evaluation_scores_the_visible_mask_as_it_is(task, batch):
    evaluation = task.measure([batch]).evaluation()
    assert tuple(evaluation.metrics) == METRICS
    assert evaluation.metrics["visible_iou"] == pytest.approx(0.5)
    assert evaluation.metrics["occluded_visible_iou"] == pytest.approx(0.5)
    assert evaluation.metrics["occluded_mask_iou"] == evaluation.metrics["mask_iou"]
    batch.object_visible[:] = batch.object_amodal
    assert math.isnan(task.measure([batch]).evaluation().metrics["occluded_mask_iou"])
    assert 0.0 <= evaluation.metrics["mask_iou"] <= 1.0
    assert evaluation.images["prediction"].shape == (3 * 128, (2 * 4 + 2) * 128, 3)


def test_the_mask_that_the_hand_network_finds_is_scored_beside_the_found_one(task, batch):
    assert math.isnan(task.measure([batch]).evaluation().metrics["found_visible_iou"])  # no network of ours
    network = HandNet(HandNetConfig(image_size=32, stem=(8, 8), decoder=8)).eval()
    encoder = HandEncoder(network=network, grid=2)
    sizes = replace(task.network.aggregator.config, hand_channels=encoder.channels)
    looking = replace(
        task,
        network=StageOne(FeatureAggregator(sizes), task.network.flow.config),
        hand_encoder=CachedEncoder(encoder=encoder, max_views=9),
    )
    for bias, expected in ((50.0, float(batch.object_amodal.float().mean())), (-50.0, 0.0)):
        with torch.no_grad():  # the object everywhere, then nowhere
            network.maps.weight[1] = 0.0
            network.get_parameter("maps.bias")[1] = bias
        metrics = looking.measure([batch]).evaluation().metrics
        assert metrics["found_visible_iou"] == pytest.approx(expected)
        assert metrics["occluded_found_visible_iou"] == pytest.approx(expected)


def test_an_empty_prediction_is_counted_and_its_distance_is_finite(task, batch):
    """A decoder that fills nothing, as that of a young network may."""
    with torch.no_grad():
        bias = task.vae.decoder.out_layer[2].bias
        bias += 100 - bias.min()
        full = task.measure([batch]).evaluation().metrics
        bias -= 1000
        metrics = task.measure([batch]).evaluation().metrics
    assert (full["empty"], metrics["empty"]) == (0.0, 1.0)
    assert full["chamfer"] < metrics["chamfer"] == pytest.approx(math.sqrt(3))
    assert metrics["voxel_iou"] == 0.0


def test_what_is_measured_on_a_batch_does_not_depend_on_the_batches_before_it(task, batch):
    """So ranks may share them."""
    first, second = one(batch, 0), one(batch, 1)
    together = task.measure([first, second]).numbers
    apart = [task.measure([part]).numbers for part in (second, first)]
    assert together == {name: apart[1][name] + apart[0][name] for name in METRICS}
    assert together["chamfer"][0] != together["chamfer"][1]
    assert (
        task.measure([second, first]).evaluation().metrics
        == task.measure([first, second]).evaluation().metrics
    )


def test_mask_targets_are_plus_one_where_more_than_half_is_covered(batch):
    targets = mask_targets(batch.object_amodal, 16)
    assert targets.shape == (3, 2, 1, 16, 16)
    assert targets[0, 0, 0, 5, 6] == 1.0
    assert targets[0, 0, 0, 0, 0] == -1.0
    assert mask_targets(batch.object_amodal, 8)[0, 0, 0, 3, 2] == -1.0  # half of the cell's columns
    assert set(mask_targets(batch.object_amodal, 5).unique().tolist()) == {-1.0, 1.0}


def test_turned_shapes_are_all_48_orientations_of_the_same_voxels():
    shape = torch.zeros(1, 8, 8, 8, dtype=torch.bool)
    shape[0, 0, 1, 3] = shape[0, 0, 1, 4] = shape[0, 2, 5, 6] = True
    seen = {
        tuple(turned(shape, [torch.Generator().manual_seed(seed)])[0].nonzero().flatten().tolist())
        for seed in range(600)
    }
    assert len(seen) == 48
    assert all(len(voxels) == 9 for voxels in seen)
