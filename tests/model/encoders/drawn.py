"""Batches and images for the encoders, drawn rather than rendered."""

import torch
from jaxtyping import Float

from model.data.batch import Batch


def blob_image(size: int, x: float, y: float, radius: float) -> Float[torch.Tensor, "3 size size"]:
    """Grey, with a red spot of `radius` at (x, y), all in fractions of the side."""
    centres = (torch.arange(size) + 0.5) / size
    spot = torch.exp(-0.5 * ((centres - x)[None, :] ** 2 + (centres - y)[:, None] ** 2) / radius**2)
    return 0.5 + spot * torch.tensor([0.45, -0.4, -0.4])[:, None, None]


def hand_batch(n_samples: int, n_views: int, size: int, *, seed: int) -> Batch:
    """Hands stood in for by a coloured disc with 21 joints on it; right ones are red, left ones blue."""
    generator = torch.Generator().manual_seed(seed)
    shape = (n_samples, n_views)
    right = torch.rand(n_samples, generator=generator) > 0.5
    centre = 0.3 + 0.4 * torch.rand(*shape, 2, generator=generator)
    radius = 0.15 + 0.05 * torch.rand(*shape, generator=generator)
    angle = torch.arange(21) / 21 * 2 * torch.pi
    ring = torch.stack([angle.cos(), angle.sin()], dim=-1)
    joints = centre[:, :, None] + 0.9 * radius[..., None, None] * ring
    pixels = (torch.arange(size) + 0.5) / size
    dx = pixels - centre[..., 0, None]
    dy = pixels - centre[..., 1, None]
    mask = dx[..., None, :] ** 2 + dy[..., :, None] ** 2 < radius[..., None, None] ** 2
    color = torch.where(right[:, None], torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.2, 0.9]))
    background = 0.5 + 0.1 * torch.rand(*shape, 3, size, size, generator=generator)
    images = torch.where(mask[:, :, None], color[:, None, :, None, None], background)
    return Batch(
        images=images,
        object_amodal=~mask,
        object_visible=~mask,
        hand_visible=mask,
        K=torch.eye(3).expand(*shape, 3, 3).clone(),
        T_cam_from_canonical=torch.eye(4).expand(*shape, 4, 4).clone(),
        occupancy=torch.zeros(n_samples, 64, 64, 64, dtype=torch.bool),
        joints_px=size * joints,
        is_right=right,
        ids=tuple(f"motion-{i}:0:{i}" for i in range(n_samples)),
    )


def token_map(tokens: torch.Tensor, grid: int) -> torch.Tensor:
    """[view token channel] as [view row column channel]."""
    return tokens.unflatten(1, (grid, grid))
