"""The objective of stage 1 (Eq. 2) in closed form: a flow that knows what is clean, but for errors that it is told.

For clean c the path gives x_t = (1 - t) c + t noise, so noise - c = (x_t - c) / t: whoever knows c and t predicts the
velocity exactly, and whoever is told another t, another sign or another scale does not.
"""

import math

import pytest
import torch
from torch import Tensor

from model.data.batch import Batch
from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.flow import Guidance, LogitNormalTime, SamplerSettings, TimeDistribution, UniformTime
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow, DualCondition, DualVelocity
from model.sparse_structure.geometry_branch import GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranchConfig
from model.sparse_structure.stage_one import StageOne, StageOneConfig, StageOneTask
from model.sparse_structure.vae import StructureVae, VaeConfig
from model.training.step_generators import sample_generators
from model.training.task import Losses
from tests.model.encoders.mean_color import MeanColor

SAMPLES, VIEWS, SIZE = 6, 2, 8
SCALE = 2.5  # latents are divided by it
VAE = VaeConfig(patch=16, channels=(4,), latent_channels=3, residual_blocks=(1,), middle_blocks=0)
FLOW = DualBranchConfig(
    geometry=GeometryBranchConfig(
        latent_resolution=4,
        latent_channels=3,
        patch=2,
        channels=8,
        condition_channels=3,  # as wide as the images' features: the geometry sees them too
        blocks=1,
        heads=1,
        mlp_ratio=1,
        preconditioned=False,
    ),
    masks=MaskBranchConfig(feature_channels=8, grid=2, patch=4, channels=8, blocks=1, heads=1, mlp_ratio=1),
    checkpoint_blocks=False,
)


class KnowingFlow(DualBranchFlow):
    """Exact velocities plus given errors, in place of predicted ones. Keeps what it was called with."""

    def __init__(self, latent: Tensor, masks: Tensor) -> None:
        super().__init__(FLOW)
        self.latent, self.clean_masks = latent, masks
        self.latent_error = self.mask_error = 0.0
        self.times: list[Tensor] = []
        self.conditions: list[DualCondition] = []

    def forward(self, x_t: Tensor, masks_t: Tensor, t: Tensor, condition: DualCondition) -> DualVelocity:
        self.times.append(t)
        self.conditions.append(condition)
        time = t.reshape(-1, 1, 1, 1, 1)
        return DualVelocity(
            geometry=(x_t - self.latent) / time + self.latent_error,
            masks=(masks_t - self.clean_masks) / time + self.mask_error,
        )


def tensors_of(condition: DualCondition) -> tuple[Tensor, Tensor]:
    """Features and images; both have to be there."""
    assert condition.images is not None
    return condition.features, condition.images


def batch_of(samples: int = SAMPLES) -> Batch:
    """Random shapes, masks and images; masks have the resolution of the branch, so that nothing is averaged."""
    generator = torch.Generator().manual_seed(1)
    amodal = torch.rand(samples, VIEWS, SIZE, SIZE, generator=generator) < 0.5
    return Batch(
        images=torch.rand(samples, VIEWS, 3, SIZE, SIZE, generator=generator),
        object_amodal=amodal,
        object_visible=amodal,
        hand_visible=~amodal,
        K=torch.eye(3).expand(samples, VIEWS, 3, 3).clone(),
        T_cam_from_canonical=torch.eye(4).expand(samples, VIEWS, 4, 4).clone(),
        occupancy=torch.rand(samples, 64, 64, 64, generator=generator) < 0.1,
        joints_px=torch.zeros(samples, VIEWS, 21, 2),
        is_right=torch.ones(samples, dtype=torch.bool),
        ids=tuple(f"sample {i}" for i in range(samples)),
    )


def task_on(
    batch: Batch,
    *,
    beta: float = 1.0,
    drop_condition: float = 0.0,
    time: TimeDistribution | None = None,
    guidance: float = 0.0,
) -> tuple[StageOneTask, KnowingFlow]:
    """The task, its flow one that knows this batch."""
    torch.manual_seed(0)
    vae = StructureVae(VAE).eval().requires_grad_(False)
    sizes = AggregatorConfig(
        image_channels=3, image_grid=2, hand_channels=3, hand_grid=2, hand_width=4, hidden=8, channels=8
    )
    flow = KnowingFlow(
        latent=vae.encoder(batch.occupancy).mean / SCALE, masks=2.0 * batch.object_amodal[:, :, None] - 1.0
    )
    network = StageOne(FeatureAggregator(sizes), FLOW)
    network.flow = flow
    task = StageOneTask(
        network=network,
        image_encoder=MeanColor(2),
        hand_encoder=MeanColor(2),
        vae=vae,
        config=StageOneConfig(
            beta=beta,
            drop_condition=drop_condition,
            time=time or UniformTime(),
            sampler=SamplerSettings(steps=3, rescale_t=1.0),
            guidance=Guidance(strength={"geometry": guidance}, interval=(0.0, 1.0)),
            latent_scale=SCALE,
        ),
        mean_shape=torch.zeros(64, 64, 64, dtype=torch.bool),
    )
    return task, flow


def loss_of(task: StageOneTask, batch: Batch, step: int = 0) -> Losses:
    return task.loss(batch, sample_generators(0, step, range(len(batch.ids))))


@pytest.mark.parametrize("step", [0, 1])
def test_a_perfect_predictor_loses_nothing(step: int) -> None:
    """Both branches are at the t that the flow is told, targets are noise - clean, latents are scaled."""
    batch = batch_of()
    task, flow = task_on(batch)
    assert float(flow.latent.std()) > 0.05  # else no error in a latent would be seen
    losses = loss_of(task, batch, step)
    assert float(losses.parts["masks"]) < 1e-6
    assert float(losses.parts["geometry"]) < 1e-6
    assert float(losses.total) < 1e-6


@pytest.mark.parametrize("beta", [0.0, 1.0, 3.0])
def test_beta_weighs_the_error_of_the_geometry(beta: float) -> None:
    batch = batch_of()
    task, flow = task_on(batch, beta=beta)
    flow.mask_error, flow.latent_error = 0.5, 2.0
    losses = loss_of(task, batch)
    assert float(losses.parts["masks"]) == pytest.approx(0.25, rel=1e-3)
    assert float(losses.parts["geometry"]) == pytest.approx(4.0, rel=1e-3)
    assert float(losses.total) == pytest.approx(0.25 + beta * 4.0, rel=1e-3)


def test_times_are_drawn_as_configured_one_for_each_sample() -> None:
    batch = batch_of()
    task, flow = task_on(batch, time=LogitNormalTime(mean=2.0, std=0.01))
    loss_of(task, batch)
    (t,) = flow.times
    assert t.shape == (SAMPLES,)
    assert t.unique().numel() == SAMPLES
    # Six standard deviations.
    assert all(abs(math.log(x / (1 - x)) - 2.0) < 0.06 for x in t.tolist())


def test_no_condition_is_dropped_at_zero_and_every_one_at_one() -> None:
    batch = batch_of()
    for share in (0.0, 1.0):
        task, flow = task_on(batch, drop_condition=share)
        loss_of(task, batch)
        (condition,), whole = map(tensors_of, flow.conditions), tensors_of(task.condition(batch.images))
        for given, found in zip(whole, condition):
            assert given.flatten(1).any(1).all()
            assert torch.equal(found, torch.zeros_like(given) if share else given)


def test_a_condition_is_dropped_whole_and_as_often_as_configured() -> None:
    batch, steps, share = batch_of(), 12, 0.25
    task, flow = task_on(batch, drop_condition=share)
    for step in range(steps):
        loss_of(task, batch, step)
    (features, images), dropped = tensors_of(task.condition(batch.images)), 0
    for condition in flow.conditions:
        found_features, found_images = tensors_of(condition)
        kept = found_features.flatten(1).any(1)
        assert torch.equal(found_images.flatten(1).any(1), kept)
        assert torch.equal(found_features[kept], features[kept])
        assert torch.equal(found_images[kept], images[kept])
        dropped += int((~kept).sum())
    draws = steps * SAMPLES
    assert abs(dropped / draws - share) < 4 * math.sqrt(share * (1 - share) / draws)


def test_noise_is_standard_normal_and_each_branch_has_its_own() -> None:
    """noise = c + velocity of the perfect predictor."""
    batch = batch_of()
    task, flow = task_on(batch)
    noises: list[tuple[Tensor, Tensor]] = []
    flow.register_forward_hook(
        lambda _, __, v: noises.append((v.geometry + flow.latent, v.masks + flow.clean_masks))
    )
    for step in range(10):
        loss_of(task, batch, step)
    latent, masks = (torch.stack(parts).flatten(2) for parts in zip(*noises))
    for noise in (latent, masks):
        bound = 4 / math.sqrt(noise.numel())
        assert abs(float(noise.mean())) < bound
        assert abs(float(noise.square().mean()) - 1.0) < math.sqrt(2) * bound
    size = min(latent.shape[2], masks.shape[2])
    together = (latent[..., :size] * masks[..., :size]).mean()
    assert abs(float(together)) < 4 / math.sqrt(latent[..., :size].numel())


def test_sampling_a_perfect_predictor_gives_the_masks_and_the_decoded_latent() -> None:
    batch = batch_of()
    task, flow = task_on(batch)
    found = task.predict(batch.images, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.masks, flow.clean_masks[:, :, 0], atol=1e-5, rtol=1e-5)
    decode = task.vae.decoder
    expected = decode(SCALE * flow.latent) > 0
    # Voxels whose logit is zero but for rounding may fall on either side.
    assert (found.occupancy != expected).float().mean() < 1e-3
    assert ((decode(flow.latent) > 0) != expected).float().mean() > 0.01  # the scale can be seen


def test_guidance_compares_the_condition_with_zeros() -> None:
    batch = batch_of()
    task, flow = task_on(batch, guidance=1.0)
    task.predict(batch.images, torch.Generator().manual_seed(0))
    whole = tensors_of(task.condition(batch.images))
    assert len(flow.conditions) == 6  # three steps
    for with_condition, without in zip(flow.conditions[::2], flow.conditions[1::2]):
        for found, zeros, given in zip(tensors_of(with_condition), tensors_of(without), whole):
            assert torch.equal(found, given)
            assert not zeros.any()
