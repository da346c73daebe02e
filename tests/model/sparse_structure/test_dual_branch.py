"""Dual-branch flow: symmetry over views, exchange of gradients, schedule, precision, memory options."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from model.errors import ModelError
from model.flow import joint_cfm_loss
from model.sparse_structure.dual_branch import (
    DualBranchConfig,
    DualBranchFlow,
    DualCondition,
    DualVelocity,
    mask_block_schedule,
)
from model.sparse_structure.geometry_branch import GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranchConfig

CONFIG = DualBranchConfig(
    geometry=GeometryBranchConfig(
        latent_resolution=4,
        latent_channels=8,
        patch=2,
        channels=24,
        condition_channels=20,
        blocks=3,
        heads=2,
        mlp_ratio=2,
        preconditioned=False,
    ),
    masks=MaskBranchConfig(feature_channels=10, grid=3, patch=4, channels=16, blocks=2, heads=2, mlp_ratio=2),
    checkpoint_blocks=False,
)


def _model(
    config: DualBranchConfig = CONFIG, *, trained: bool = True, image_context: bool = False
) -> DualBranchFlow:
    """A model in float64; `trained` moves every parameter off its initial value (gates and scores too)."""
    torch.manual_seed(0)
    model = DualBranchFlow(config, image_context=image_context).double()
    if trained:
        with torch.no_grad():
            for parameter in model.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
    return model


def _inputs(views: int, batch: int = 2, *, image_context: bool = False) -> dict[str, Any]:
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return {
        "x_t": draw(batch, 8, 4, 4, 4),
        "masks_t": draw(batch, views, 1, 12, 12),
        "t": torch.rand(batch, generator=generator, dtype=torch.float64),
        "condition": DualCondition(
            features=draw(batch, views, 9, 10), images=draw(batch, views, 9, 20) if image_context else None
        ),
    }


def _of_views(inputs: dict[str, Any], views: list[int]) -> dict[str, Any]:
    features, images = inputs["condition"].features, inputs["condition"].images
    condition = DualCondition(
        features=features[:, views], images=None if images is None else images[:, views]
    )
    return inputs | {"masks_t": inputs["masks_t"][:, views], "condition": condition}


@pytest.mark.parametrize("views", [1, 2, 6])
def test_velocities_have_the_shapes_of_their_states(views: int) -> None:
    inputs = _inputs(views)
    out = _model()(**inputs)
    assert isinstance(out, DualVelocity)
    assert out.geometry.shape == inputs["x_t"].shape
    assert out.masks.shape == inputs["masks_t"].shape


def test_fusion_is_uniform_at_the_start_and_learned_after() -> None:
    inputs = _inputs(4)
    for trained in (False, True):
        model = _model(trained=trained)
        weights = model.fusion(model.masks.embed(inputs["masks_t"], inputs["condition"].features))
        torch.testing.assert_close(weights.sum(1), torch.ones(2))
        uniform = torch.allclose(weights, torch.full((2, 4), 0.25))
        assert uniform is not trained


@pytest.mark.parametrize("image_context", [False, True])
@pytest.mark.parametrize("trained", [False, True])
def test_permuting_views_permutes_masks_and_nothing_else(trained: bool, image_context: bool) -> None:
    model, order = _model(trained=trained, image_context=image_context), [2, 0, 3, 1]
    inputs = _inputs(4, image_context=image_context)
    straight, permuted = model(**inputs), model(**_of_views(inputs, order))
    torch.testing.assert_close(permuted.geometry, straight.geometry)
    torch.testing.assert_close(permuted.masks, straight.masks[:, order])


def test_identical_views_equal_one_view() -> None:
    model, inputs = _model(), _inputs(1)
    one, five = model(**inputs), model(**_of_views(inputs, [0] * 5))
    # float32 softmax weights of five equal scores: 0.2 to 1e-8.
    torch.testing.assert_close(five.geometry, one.geometry, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(five.masks, one.masks.expand(-1, 5, -1, -1, -1), atol=1e-6, rtol=1e-6)


def test_both_branches_embed_and_read_out_at_the_time_given() -> None:
    """Without heads, velocities follow from the noisy tensors and t alone."""
    model = _model(replace(CONFIG, geometry=replace(CONFIG.geometry, preconditioned=True)))
    inputs, embedded = _inputs(3), []
    with torch.no_grad():
        for branch in (model.geometry, model.masks):
            branch.t_embedder.register_forward_pre_hook(lambda _, given: embedded.append(given[0]))
            branch.out_layer.weight.zero_()
            branch.out_layer.bias.zero_()
        found = model(**inputs)
    assert len(embedded) == 2
    assert all(torch.equal(t, inputs["t"]) for t in embedded)
    t, x, m = inputs["t"].reshape(-1, 1, 1, 1, 1), inputs["x_t"], inputs["masks_t"]
    # Masks are read out in float32.
    torch.testing.assert_close(found.masks, (m - torch.tanh((1 - t) * m / t**2)) / t, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(found.geometry, (2 * t - 1) / ((1 - t) ** 2 + t**2) * x)


def _gradients(
    model: DualBranchFlow, *, masks: float, geometry: float, image_context: bool = False
) -> dict[str, float]:
    """Norm of the gradient of each parameter for a loss that weighs the two terms as given."""
    inputs = _inputs(3, image_context=image_context)
    out = model(**inputs)
    model.zero_grad()
    loss = joint_cfm_loss(
        predicted_masks=out.masks,
        target_masks=torch.zeros_like(out.masks),
        predicted_geometry=out.geometry,
        target_geometry=torch.zeros_like(out.geometry),
        beta=1.0,
    )
    (masks * loss.masks.mean() + geometry * loss.geometry.mean()).backward()
    return {
        name: float(parameter.grad.norm()) if parameter.grad is not None else 0.0
        for name, parameter in model.named_parameters()
        if name != "fusion.score.2.bias"  # a constant added to every view's score changes no weight
    }


def test_each_loss_reaches_the_other_branch_from_the_first_step() -> None:
    of_masks = _gradients(_model(trained=False), masks=1.0, geometry=0.0)
    of_geometry = _gradients(_model(trained=False), masks=0.0, geometry=1.0)
    for name in (
        "input_layer.weight",
        "blocks.0.cross_attn.to_q.weight",
        "blocks.0.cross_attn.to_out.weight",
    ):
        assert of_masks[f"geometry.{name}"] > 0
        assert of_geometry[f"masks.{name}"] > 0
    assert of_geometry["masks.feature_layer.weight"] > 0
    assert of_geometry["context.projection.weight"] > 0


def test_each_loss_reaches_every_parameter_that_can_act_on_it() -> None:
    of_masks = _gradients(_model(), masks=1.0, geometry=0.0)
    of_geometry = _gradients(_model(), masks=0.0, geometry=1.0)
    # Mask blocks run beside geometry blocks 0 and 1; what geometry blocks 1 and 2 write is read by no mask.
    unread = ("geometry.blocks.1.", "geometry.blocks.2.", "geometry.out_layer.")
    assert {name for name, norm in of_masks.items() if norm == 0} == {
        name for name in of_masks if name.startswith(unread)
    }
    assert {name for name, norm in of_geometry.items() if norm == 0} == {
        name for name in of_geometry if name.startswith("masks.out_layer.")
    }


@pytest.mark.parametrize("image_context", [False, True])
def test_every_parameter_is_trained_by_the_joint_loss(image_context: bool) -> None:
    model = _model(image_context=image_context)
    gradients = _gradients(model, masks=1.0, geometry=1.0, image_context=image_context)
    assert [name for name, norm in gradients.items() if norm == 0] == []


def test_mask_tokens_are_added_to_image_features_from_the_second_step() -> None:
    """What they add starts at zero, and the first step moves it."""
    model = _model(trained=False, image_context=True)
    assert not model.context.projection.weight.any()
    of_geometry = _gradients(model, masks=0.0, geometry=1.0, image_context=True)
    assert of_geometry["context.projection.weight"] > 0
    torch.optim.SGD(model.context.parameters(), lr=0.1).step()
    of_geometry = _gradients(model, masks=0.0, geometry=1.0, image_context=True)
    assert of_geometry["masks.feature_layer.weight"] > 0


def test_views_meet_only_through_the_geometry() -> None:
    """Cutting the mask branch's cross-attention makes each view's mask its own affair."""
    model, inputs = _model(), _inputs(3)
    with torch.no_grad():
        for block in model.masks.blocks:
            block.get_parameter("cross_attn.to_out.weight").zero_()
        together, alone = model(**inputs), model(**_of_views(inputs, [1]))
    torch.testing.assert_close(together.masks[:, 1:2], alone.masks)
    assert not torch.allclose(together.geometry, alone.geometry)


@pytest.mark.parametrize(
    ("geometry", "masks", "expected"),
    [
        (3, 3, (0, 1, 2)),
        (6, 3, (0, None, 1, None, 2, None)),
        (3, 2, (0, 1, None)),
        (4, 1, (0, None, None, None)),
    ],
)
def test_mask_blocks_are_spread_evenly(geometry: int, masks: int, expected: tuple[int | None, ...]) -> None:
    assert mask_block_schedule(geometry, masks) == expected


def test_schedule_runs_every_mask_block_once_in_order() -> None:
    for geometry in range(1, 30):
        for masks in range(1, geometry + 1):
            ran = [i for i in mask_block_schedule(geometry, masks) if i is not None]
            assert ran == list(range(masks))


def test_checkpointing_gives_the_same_gradients() -> None:
    plain = _gradients(_model(), masks=1.0, geometry=1.0)
    saved = _gradients(_model(replace(CONFIG, checkpoint_blocks=True)), masks=1.0, geometry=1.0)
    assert saved == plain


def test_bfloat16_autocast_is_close_to_float32() -> None:
    model = _model(trained=False).float()
    inputs = _inputs(3)
    condition = DualCondition(features=inputs["condition"].features.float(), images=None)
    inputs = {name: inputs[name].float() for name in ("x_t", "masks_t", "t")} | {"condition": condition}
    exact = model(**inputs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rough = model(**inputs)
        (rough.geometry.float().square().mean() + rough.masks.float().square().mean()).backward()
    for name in ("geometry", "masks"):
        torch.testing.assert_close(getattr(rough, name).float(), getattr(exact, name), atol=0.02, rtol=0.05)
    assert all(
        torch.isfinite(parameter.grad).all() for parameter in model.parameters() if parameter.grad is not None
    )


@pytest.mark.parametrize("image_context", [False, True])
def test_dropping_takes_the_condition_from_these_samples_only(image_context: bool) -> None:
    condition = _inputs(2, batch=3, image_context=image_context)["condition"]
    condition.features[1, 0, 0, 0] = torch.inf  # would survive a product with zero
    dropped, nothing = condition.dropped(torch.tensor([False, True, False])), condition.unconditional()
    for name in ("features", "images") if image_context else ("features",):
        tokens, kept = getattr(condition, name), getattr(dropped, name)
        assert not kept[1].any()
        assert torch.equal(kept[[0, 2]], tokens[[0, 2]])
        assert torch.equal(getattr(nothing, name), torch.zeros_like(tokens))
    if not image_context:
        assert dropped.images is None
        assert nothing.images is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(CONFIG, masks=replace(CONFIG.masks, blocks=4)), "P <= M"),
        (lambda: replace(CONFIG.geometry, heads=5), "5 heads do not divide 24"),
        (lambda: replace(CONFIG.masks, heads=5), "5 heads do not divide 16"),
        (lambda: replace(CONFIG.geometry, patch=3), "patch 3 does not divide"),
        (
            lambda: _model()(
                **(
                    _inputs(2)
                    | {"condition": DualCondition(features=torch.zeros(2, 2, 9, 11).double(), images=None)}
                )
            ),
            "feature_channels",
        ),
        (lambda: _model()(**(_inputs(2) | {"x_t": torch.zeros(2, 8, 6, 6, 6).double()})), "latent shape"),
    ],
)
def test_contradictions_are_one_clear_line(make, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
