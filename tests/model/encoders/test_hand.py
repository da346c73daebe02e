"""The open hand encoder: its tokens, its file, and that it learns where hands and joints are."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from torch.nn import functional

from model.data.batch import Batch
from model.encoders.hand import HandEncoder, HandNet, HandNetConfig, HandOutput, load_hand_net, save_hand_net
from model.encoders.hand_training import HandLossConfig, HandTask, hand_losses, joint_positions
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from model.training.task import Task
from tests.model.encoders.drawn import blob_image, hand_batch

SMALL = HandNetConfig(image_size=64, stem=(8, 16), decoder=16)
LOSS = HandLossConfig(object_weight=1.0, joint_weight=1.0, side_weight=0.1, sigma_cells=1.0, color_jitter=0.0)


def network(seed: int = 0) -> HandNet:
    torch.manual_seed(seed)
    return HandNet(SMALL)


def exact_output(batch: Batch, cells: int) -> HandOutput:
    """What a perfect network would say."""
    position = cells * batch.joints_px.flatten(0, 1) / batch.images.shape[-1]
    centres = torch.arange(cells) + 0.5
    per_axis = -0.5 * (centres - position[..., None]) ** 2
    hand, held = (
        functional.adaptive_avg_pool2d(mask.flatten(0, 1).float()[:, None], cells)[:, 0]
        for mask in (batch.hand_visible, batch.object_visible)
    )
    return HandOutput(
        mask_logits=20 * (2 * hand - 1),
        object_logits=20 * (2 * held - 1),
        joint_logits=per_axis[..., 1, :, None] + per_axis[..., 0, None, :],
        right_logit=20 * (2 * batch.is_right.float() - 1).repeat_interleave(batch.images.shape[1]),
    )


def one_sample(batch: Batch, index: int) -> Batch:
    return batch.part(index, index + 1)


class Oracle(HandNet):
    """Stands in for a network that has learned everything."""

    def __init__(self, batch: Batch) -> None:
        super().__init__(SMALL)
        self.batch = batch

    def forward(self, images: torch.Tensor) -> HandOutput:
        return exact_output(self.batch, 16)


def test_the_recommended_network_is_small() -> None:
    network = HandNet(HandNetConfig(image_size=128, stem=(16, 32), decoder=64))
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) < 300_000


def test_only_the_decoder_is_trained_and_saved(tmp_path: Path) -> None:
    net = network().train()
    before = {name: value.clone() for name, value in net.backbone.state_dict().items()}
    batch = hand_batch(2, 1, 64, seed=6)
    optimizer = torch.optim.SGD([p for p in net.parameters() if p.requires_grad], lr=0.1)
    HandTask(network=net, config=LOSS).loss(batch, []).total.backward()
    optimizer.step()
    for name, value in net.backbone.state_dict().items():  # the batch norms' statistics among them
        assert torch.equal(value, before[name]), name
    assert all(p.grad is not None for p in net.parameters() if p.requires_grad)
    save_hand_net(net, tmp_path, dtype=torch.float32)
    with safe_open(tmp_path / "hand_encoder.safetensors", "pt") as stored:
        assert set(stored.keys()) == {n for n in net.state_dict() if not n.startswith("backbone.")}


def test_tokens_shape_protocol_and_frozenness(tmp_path: Path) -> None:
    save_hand_net(network(), tmp_path, dtype=torch.float32)
    encoder = HandEncoder(network=load_hand_net(tmp_path), grid=8)
    assert isinstance(encoder, FeatureEncoder)
    images = torch.rand(2, 3, 3, 96, 96, requires_grad=True)
    tokens = encoder(images)
    assert tokens.shape == (2, 3, 64, encoder.channels) == (2, 3, 64, 4 * 16 + 16)
    assert not tokens.requires_grad
    assert not any(p.requires_grad for p in encoder.network.parameters())
    assert torch.equal(tokens, encoder(images))
    half = encoder.to("cpu", torch.bfloat16)(images.detach().bfloat16())
    assert half.dtype == torch.bfloat16
    assert functional.cosine_similarity(half.float(), tokens, dim=-1).mean() > 0.98


def without_pyramid(net: HandNet) -> HandNet:
    """Its own layers alone: where the pyramid's maps look is tested with it."""
    for lateral in (net.lateral_4, net.lateral_8, net.lateral_16, net.lateral_32):
        torch.nn.init.zeros_(lateral.weight)
    return net


@torch.no_grad()
def test_the_layout_does_not_look_aside() -> None:
    """With all kernels mirrored, a mirrored image has mirrored features: only for centred cells."""
    plain, mirrored = without_pyramid(network()), without_pyramid(network())
    for module in mirrored.modules():
        if isinstance(module, torch.nn.Conv2d):
            module.weight.copy_(module.weight.flip(-1))
    images = torch.rand(2, 3, 64, 64)
    expected = plain.features(images, 16).unflatten(1, (16, 16))
    found = mirrored.features(images.flip(-1), 16).unflatten(1, (16, 16)).flip(2)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)


@torch.no_grad()
def test_a_spot_changes_the_tokens_over_it_most() -> None:
    row, column = 5, 10
    with_spot = blob_image(64, (column + 0.5) / 16, (row + 0.5) / 16, 0.02)
    change = torch.zeros(256)
    for seed in range(8):
        tokens = without_pyramid(network(seed)).features(
            torch.stack([torch.full_like(with_spot, 0.5), with_spot]), 16
        )
        change += (tokens[1] - tokens[0])[:, : SMALL.decoder].norm(dim=-1)
    found_row, found_column = divmod(int(change.argmax()), 16)
    assert abs(found_row - row) <= 1
    assert abs(found_column - column) <= 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_saved_and_loaded_again(tmp_path: Path, dtype: torch.dtype) -> None:
    before = network()
    save_hand_net(before, tmp_path, dtype=dtype)
    after = load_hand_net(tmp_path)
    assert after.config == before.config
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hand_encoder.json",
        "hand_encoder.safetensors",
    ]
    images = torch.rand(2, 3, 64, 64)
    tolerance = 0.0 if dtype == torch.float32 else 0.02
    torch.testing.assert_close(
        after(images).mask_logits, before(images).mask_logits.detach(), rtol=0, atol=tolerance
    )


def test_missing_weights_name_the_command(tmp_path: Path) -> None:
    with pytest.raises(
        ModelError, match=r"there is no hand_encoder\.json.*`forehoi train hand_encoder --config hands`"
    ):
        load_hand_net(tmp_path)
    save_hand_net(network(), tmp_path, dtype=torch.float32)
    (tmp_path / "hand_encoder.safetensors").unlink()
    with pytest.raises(
        ModelError,
        match=r"there is no hand_encoder\.safetensors.*`forehoi train hand_encoder --config hands`",
    ):
        load_hand_net(tmp_path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("hand_encoder.safetensors", b"\x00\x01"),
        ("hand_encoder.json", b"{"),
        ("hand_encoder.json", b'{"image_size": 64}'),
        ("hand_encoder.json", b'{"image_size": 64, "stem": [8, 24], "decoder": 16}'),
        ("hand_encoder.json", b'{"image_size": 48, "stem": [8, 16], "decoder": 16}'),
    ],
)
def test_broken_files_are_one_clear_line(tmp_path: Path, name: str, content: bytes) -> None:
    save_hand_net(network(), tmp_path, dtype=torch.float32)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ModelError) as caught:
        load_hand_net(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_perfect_output_has_no_loss_and_full_marks() -> None:
    batch = hand_batch(3, 2, 64, seed=1)
    losses = hand_losses(exact_output(batch, 16), batch, LOSS)
    assert {name: tuple(loss.shape) for name, loss in losses.items()} == dict.fromkeys(
        ("mask", "object", "joints", "side"), (3,)
    )
    assert float(losses["joints"].max()) < 1e-4
    assert float(losses["side"].max()) < 1e-6
    evaluation = HandTask(network=Oracle(batch), config=LOSS).measure([batch]).evaluation()
    assert evaluation.metrics == {
        "hand_mask_iou": 1.0,
        "held_object_iou": 1.0,
        "hand_side_accuracy": 1.0,
        "hand_pck5": 1.0,
        "hand_joint_error": pytest.approx(0, abs=0.3),
    }
    assert evaluation.images["hand"].shape == (3 * 64, 6 * 64, 3)


def test_joint_positions_are_finer_than_a_cell() -> None:
    batch = hand_batch(2, 1, 64, seed=2)
    found = joint_positions(exact_output(batch, 16).joint_logits)
    torch.testing.assert_close(found, batch.joints_px.flatten(0, 1) / 64, rtol=0, atol=0.1 / 16)


def test_joints_outside_the_image_and_behind_the_camera_do_not_count() -> None:
    batch = hand_batch(2, 1, 64, seed=3)
    with torch.no_grad():
        output = network()(batch.images.flatten(0, 1))
    inside = hand_losses(output, batch, LOSS)["joints"]
    batch.joints_px[0, 0, 0] = torch.nan
    batch.joints_px[0, 0, 1] = torch.tensor([-5.0, 10.0])
    changed = hand_losses(output, batch, LOSS)["joints"]
    assert torch.isfinite(changed).all()
    assert float(changed[0]) != float(inside[0])
    assert float(changed[1]) == float(inside[1])
    batch.joints_px[:] = torch.nan
    net = network()
    losses = hand_losses(net(batch.images.flatten(0, 1)), batch, LOSS)
    assert losses["joints"].tolist() == [0.0, 0.0]
    sum(loss.sum() for loss in losses.values()).backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)


def test_the_loss_of_a_batch_is_the_mean_of_its_samples() -> None:
    """What gradient accumulation and many processes rely on."""
    task = HandTask(network=network(), config=LOSS)
    assert isinstance(task, Task)
    whole = hand_batch(4, 2, 64, seed=4)
    total = task.loss(whole, []).total
    samples = [one_sample(whole, i) for i in range(4)]
    parts = torch.stack([task.loss(sample, []).total for sample in samples])
    torch.testing.assert_close(total, parts.mean())


def test_colours_are_random_but_repeatable_and_the_same_in_any_batch() -> None:
    task = HandTask(network=network(), config=replace(LOSS, color_jitter=0.3))
    whole = hand_batch(3, 2, 64, seed=5)

    def generators(*seeds: int) -> list[torch.Generator]:
        return [torch.Generator().manual_seed(seed) for seed in seeds]

    total = task.loss(whole, generators(1, 2, 3)).total
    assert torch.equal(total, task.loss(whole, generators(1, 2, 3)).total)
    assert not torch.equal(total, task.loss(whole, generators(1, 2, 4)).total)
    alone = [task.loss(one_sample(whole, i), generators(i + 1)).total for i in range(3)]
    torch.testing.assert_close(total, torch.stack(alone).mean())


@pytest.fixture
def _one_thread() -> Iterator[None]:
    """Steps this small lose more to waiting for each other than they win."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("_one_thread")
def test_it_learns_masks_and_joints() -> None:
    torch.manual_seed(0)
    net = HandNet(HandNetConfig(image_size=64, stem=(8, 16), decoder=16))
    task = HandTask(network=net, config=LOSS)
    optimizer = torch.optim.AdamW(task.module.parameters(), lr=5e-3)
    for step in range(120):
        losses = task.loss(hand_batch(8, 1, 64, seed=100 + step), [])
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
    metrics = task.measure([hand_batch(16, 2, 64, seed=9)]).evaluation().metrics
    assert metrics["hand_mask_iou"] > 0.85, metrics
    assert metrics["hand_pck5"] > 0.5, metrics
    assert metrics["hand_side_accuracy"] > 0.9, metrics


def test_evaluation_without_anything_to_measure_is_nan() -> None:
    metrics = HandTask(network=network(), config=LOSS).measure([]).evaluation().metrics
    assert all(value != value for value in metrics.values())
