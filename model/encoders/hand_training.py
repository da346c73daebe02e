"""How the open hand encoder is trained: losses, metrics and images, as a Task of the trainer."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn import functional

from model.data.batch import Batch
from model.encoders.hand import HandNet, HandOutput
from model.evaluation.overlap import intersection_over_union
from model.training.task import Losses, Measurements
from shards.settings import Range

__all__ = ["METRICS", "HandLossConfig", "HandTask", "hand_losses", "joint_positions"]

METRICS = (
    "hand_mask_iou",  # of hand and arm, at stride 4
    "held_object_iou",  # of its visible part, at stride 4
    "hand_side_accuracy",  # right told from left
    "hand_pck5",  # share of the joints inside the image that are found within 5 % of its side
    "hand_joint_error",  # of the same joints, % of the side
)
_PCK_SIDE = 0.05  # of the image's side
_IMAGES = 8


@dataclass(frozen=True, kw_only=True)
class HandLossConfig:
    """Mask loss + `object_weight` x object loss + `joint_weight` x joint loss + `side_weight` x side loss."""

    object_weight: Annotated[float, Range(0, 1e6)]
    joint_weight: Annotated[float, Range(0, 1e6)]
    side_weight: Annotated[float, Range(0, 1e6)]
    sigma_cells: Annotated[float, Range(1e-3, 1e3)]
    """Standard deviation of a joint's target distribution, in stride-4 cells."""
    color_jitter: Annotated[float, Range(0, 1)]
    """j: in training each channel is multiplied by e^u and raised to the power e^v, u and v uniform in
    [-j, j] for each sample; 0 for none. Skin is told from wood by more than its hue then."""


def hand_losses(
    output: HandOutput,
    batch: Batch,
    config: HandLossConfig,
) -> dict[str, Float[Tensor, " batch"]]:
    """Losses of each sample: "mask" (cross-entropy + Dice, of hand and arm), "object" (the same of
    the visible part of the held object), "joints" (KL divergence of the
    predicted from a Gaussian distribution, over the joints inside the image), "side" (cross-entropy)."""
    batch_view = batch.images.shape[:2]
    view_losses = {
        "mask": _mask_loss(
            output.mask_logits.float(), _covered(batch.hand_visible, output.mask_logits.shape[-1])
        ),
        "object": _mask_loss(
            output.object_logits.float(), _covered(batch.object_visible, output.object_logits.shape[-1])
        ),
        "joints": _joint_loss(output.joint_logits.float(), batch, config.sigma_cells),
        "side": functional.binary_cross_entropy_with_logits(
            output.right_logit.float(), _side(batch), reduction="none"
        ),
    }
    return {name: loss.unflatten(0, batch_view).mean(1) for name, loss in view_losses.items()}


def joint_positions(joint_logits: Float[Tensor, "view 21 cell cell"]) -> Float[Tensor, "view 21 2"]:
    """(x, y) of each joint in fractions of the image's side.

    The mean of the distribution within two cells of its peak: finer than a cell, blind to far modes.
    """
    count = joint_logits.shape[-1]
    flat = joint_logits.float().flatten(2)
    peak = flat.argmax(-1)
    row, column = peak // count, peak % count
    cells = torch.arange(count, device=flat.device)
    near_row = (cells - row[..., None]).abs() <= 2
    near_column = (cells - column[..., None]).abs() <= 2
    near = (near_row[..., :, None] & near_column[..., None, :]).flatten(2)
    weights = flat.masked_fill(~near, -torch.inf).softmax(-1).unflatten(2, (count, count))
    centres = (cells + 0.5) / count
    return torch.stack([(weights.sum(2) * centres).sum(-1), (weights.sum(3) * centres).sum(-1)], dim=-1)


@dataclass(frozen=True, kw_only=True, eq=False)
class HandTask:
    """Trains a HandNet; a `Task` of model/training/task.py."""

    network: HandNet
    config: HandLossConfig

    @property
    def module(self) -> nn.Module:
        return self.network

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        """Means over the samples; the colours are random, by one generator for each sample."""
        images = _recolored(batch.images, self.config.color_jitter, generators)
        parts = hand_losses(self.module(images.flatten(0, 1)), batch, self.config)
        means = {name: loss.mean() for name, loss in parts.items()}
        total = (
            means["mask"]
            + self.config.object_weight * means["object"]
            + self.config.joint_weight * means["joints"]
            + self.config.side_weight * means["side"]
        )
        return Losses(total=total, parts=means)

    @torch.no_grad()
    def measure(self, batches: Iterable[Batch]) -> Measurements:
        """METRICS of every view, or of every joint inside its image; images of the first batch."""
        numbers: dict[str, list[float]] = {name: [] for name in METRICS}
        images: dict[str, UInt8[np.ndarray, "height width 3"]] = {}
        for batch in batches:
            output = self.module(batch.images.flatten(0, 1))
            for name, values in _scores(output, batch).items():
                numbers[name] += values.tolist()
            if not images:
                images = {"hand": _montage(output, batch)}
        return Measurements(numbers=numbers, images=images)


def _recolored(
    images: Float[Tensor, "batch view 3 size size"], jitter: float, generators: Sequence[torch.Generator]
) -> Float[Tensor, "batch view 3 size size"]:
    if jitter == 0:
        return images
    draws = torch.stack([torch.rand(6, generator=generator) for generator in generators])
    gain, power = (jitter * (2 * draws - 1)).exp().to(images).reshape(-1, 2, 1, 3, 1, 1).unbind(1)
    return (gain * images.clamp_min(1e-4) ** power).clamp(0, 1)


def _scores(output: HandOutput, batch: Batch) -> dict[str, Float[Tensor, " _"]]:
    """METRICS of every view, the last two of every joint that is inside."""
    iou = {}
    for name, logits, mask in (
        ("hand_mask_iou", output.mask_logits, batch.hand_visible),
        ("held_object_iou", output.object_logits, batch.object_visible),
    ):
        iou[name] = intersection_over_union(logits > 0, _covered(mask, logits.shape[-1]) > 0.5)
    position, inside = _true_joints(batch)
    distance = (joint_positions(output.joint_logits) - position).norm(dim=-1)[inside]
    return iou | {
        "hand_side_accuracy": ((output.right_logit > 0) == (_side(batch) > 0.5)).float(),
        "hand_pck5": (distance < _PCK_SIDE).float(),
        "hand_joint_error": 100 * distance,
    }


def _covered(mask: Bool[Tensor, "batch view size size"], cells: int) -> Float[Tensor, "flat cell cell"]:
    """Share of each cell that the mask covers."""
    return functional.adaptive_avg_pool2d(mask.flatten(0, 1).float()[:, None], cells)[:, 0]


def _side(batch: Batch) -> Float[Tensor, " view"]:
    return batch.is_right.repeat_interleave(batch.images.shape[1]).float()


def _true_joints(batch: Batch) -> tuple[Float[Tensor, "view 21 2"], Bool[Tensor, "view 21"]]:
    """Positions in fractions of the side (0 where there is none), and which are inside the image."""
    position = batch.joints_px.flatten(0, 1).float() / batch.images.shape[-1]
    inside = ((position >= 0) & (position < 1)).all(-1)  # false for NaN
    return torch.where(inside[..., None], position, torch.zeros_like(position)), inside


def _mask_loss(
    logits: Float[Tensor, "view cell cell"], truth: Float[Tensor, "view cell cell"]
) -> Float[Tensor, " view"]:
    cross_entropy = functional.binary_cross_entropy_with_logits(logits, truth, reduction="none").mean((1, 2))
    p = logits.sigmoid()
    dice = 1 - (2 * (p * truth).sum((1, 2)) + 1) / (p.sum((1, 2)) + truth.sum((1, 2)) + 1)
    return cross_entropy + dice


def _joint_loss(
    logits: Float[Tensor, "view 21 cell cell"], batch: Batch, sigma_cells: float
) -> Float[Tensor, " view"]:
    position, inside = _true_joints(batch)
    count = logits.shape[-1]
    centres = torch.arange(count, device=logits.device) + 0.5
    # A Gaussian of two axes is the product of one of each; normalised over the cells of the image.
    per_axis = -0.5 * ((centres - count * position[..., None]) / sigma_cells) ** 2
    target = (per_axis[..., 1, :, None] + per_axis[..., 0, None, :]).flatten(2).log_softmax(-1)
    predicted = logits.flatten(2).log_softmax(-1)
    divergence = (target.exp() * (target - predicted)).sum(-1)
    return (divergence * inside).sum(1) / inside.sum(1).clamp_min(1)


def _montage(output: HandOutput, batch: Batch) -> UInt8[np.ndarray, "height width 3"]:
    """A column for each view: the image; what is true; what is predicted: hand green, object orange, joints."""
    images = batch.images.flatten(0, 1)[:_IMAGES].float().cpu()
    size = images.shape[-1]
    truth, inside = _true_joints(batch)

    def full(logits: Tensor) -> Tensor:
        return (
            functional.interpolate(logits[:, None].float(), size=(size, size), mode="bilinear")[:, 0].cpu()
            > 0
        )

    rows = (
        (batch.hand_visible.flatten(0, 1).cpu(), batch.object_visible.flatten(0, 1).cpu(), truth.cpu()),
        (full(output.mask_logits), full(output.object_logits), joint_positions(output.joint_logits).cpu()),
    )
    columns = []
    for view, image in enumerate(images):
        shown = [_marked(image, h[view], o[view], j[view][inside[view].cpu()]) for h, o, j in rows]
        columns.append(torch.cat([image, *shown], dim=1))
    montage = torch.cat(columns, dim=2).permute(1, 2, 0)
    return (255 * montage.clamp(0, 1)).round().to(torch.uint8).numpy()


def _marked(
    image: Float[Tensor, "3 size size"],
    hand: Bool[Tensor, "size size"],
    held: Bool[Tensor, "size size"],
    joints: Float[Tensor, "joint 2"],
) -> Float[Tensor, "3 size size"]:
    """Masks tinted, joints as white squares of about 1/40 of the side."""
    size = image.shape[-1]
    tinted = image
    for mask, color in ((hand, (0.1, 0.9, 0.2)), (held, (1.0, 0.45, 0.1))):
        tinted = torch.where(mask, 0.5 * tinted + 0.5 * torch.tensor(color)[:, None, None], tinted)
    centres = (torch.arange(size) + 0.5) / size
    near = (centres - joints[..., None]).abs() <= 1 / 80
    dots = (near[:, 1, :, None] & near[:, 0, None, :]).any(0)
    return torch.where(dots, torch.ones_like(tinted), tinted)
