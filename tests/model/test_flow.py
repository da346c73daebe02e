"""The probability path, its loss, guidance and the Euler sampler, against closed forms."""

import math

import numpy as np
import pytest
import torch

from model.errors import ModelError
from model.flow import (
    Guidance,
    LogitNormalTime,
    SamplerSettings,
    UniformTime,
    binary_velocity,
    euler_path,
    euler_sample,
    guided,
    interpolate,
    joint_cfm_loss,
    noise_like,
    preconditioned_velocity,
    time_grid,
    times_from_uniform,
    velocity_target,
)


def _random(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_path_ends_at_clean_and_noise() -> None:
    clean, noise = _random(0, 2, 3, 4), _random(1, 2, 3, 4)
    torch.testing.assert_close(interpolate(clean, noise, torch.zeros(2)), clean)
    torch.testing.assert_close(interpolate(clean, noise, torch.ones(2)), noise)


def test_velocity_target_is_the_derivative_of_the_path() -> None:
    clean, noise = _random(0, 2, 5), _random(1, 2, 5)
    t = torch.tensor([0.2, 0.7], dtype=torch.float64)
    step = 1e-3
    slope = (interpolate(clean, noise, t + step) - interpolate(clean, noise, t - step)) / (2 * step)
    torch.testing.assert_close(slope, velocity_target(clean, noise))


def test_uniform_and_logit_normal_times_have_their_distributions() -> None:
    uniform = torch.rand(20_000, generator=torch.Generator().manual_seed(0))
    assert torch.equal(times_from_uniform(UniformTime(), uniform), uniform)
    times = times_from_uniform(LogitNormalTime(mean=1.0, std=0.5), uniform)
    normal = torch.logit(times.double())
    assert abs(float(normal.mean()) - 1.0) < 0.02
    assert abs(float(normal.std()) - 0.5) < 0.02
    edge = times_from_uniform(LogitNormalTime(mean=1.0, std=1.0), torch.tensor([0.0, 1 - 2**-24]))
    assert torch.isfinite(edge).all()


@pytest.mark.parametrize("time", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_preconditioning_leaves_a_unit_target_uncorrelated_with_the_input(time: float) -> None:
    clean, noise = _random(0, 1, 200_000), _random(1, 1, 200_000)
    t = torch.tensor([time], dtype=torch.float64)
    x_t, velocity = interpolate(clean, noise, t), velocity_target(clean, noise)
    zero = torch.zeros_like(x_t)
    scale = preconditioned_velocity(zero, torch.ones_like(x_t), t)
    target = (velocity - preconditioned_velocity(x_t, zero, t)) / scale
    assert float(target.square().mean()) == pytest.approx(1, abs=0.02)
    assert float((target * x_t).mean()) == pytest.approx(0, abs=0.02)
    if time == 1.0:
        torch.testing.assert_close(target, -clean)


@pytest.mark.parametrize("time", [0.2, 0.5, 0.9, 1.0])
def test_binary_velocity_is_the_conditional_mean(time: float) -> None:
    """Against the mean of the true velocity over many draws that fall into one bin of x_t."""
    half_log_odds = 0.4
    generator = torch.Generator().manual_seed(0)
    probability = 1 / (1 + math.exp(-2 * half_log_odds))
    clean = 2.0 * (torch.rand(1, 400_000, generator=generator).double() < probability) - 1
    noise, t = _random(1, 1, 400_000), torch.tensor([time], dtype=torch.float64)
    x_t, target = interpolate(clean, noise, t), velocity_target(clean, noise)
    velocity = binary_velocity(x_t, torch.full_like(x_t, half_log_odds), t)
    for low in (-1.0, -0.1, 0.5):
        inside = (x_t > low) & (x_t < low + 0.2)
        assert float((velocity - target)[inside].mean()) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("time", [1e-3, 0.1, 0.7])
def test_a_certain_mask_gives_the_true_velocity(time: float) -> None:
    clean, noise, t = _random(0, 1, 64).sign().float(), _random(1, 1, 64).float(), torch.tensor([time])
    velocity = binary_velocity(interpolate(clean, noise, t), 100 * clean, t)
    torch.testing.assert_close(velocity, velocity_target(clean, noise), atol=1e-3, rtol=1e-3)
    assert torch.isfinite(binary_velocity(clean, torch.zeros(1, 64), torch.zeros(1))).all()


def test_joint_loss_is_eq_2_and_names_samples() -> None:
    masks, geometry = _random(0, 3, 2, 1, 4, 4), _random(1, 3, 8, 2, 2, 2)
    mask_error = torch.tensor([1.0, 0.0, 2.0]).double()
    loss = joint_cfm_loss(
        predicted_masks=masks + mask_error[:, None, None, None, None],
        target_masks=masks,
        predicted_geometry=geometry + 3,
        target_geometry=geometry,
        beta=0.5,
    )
    torch.testing.assert_close(loss.masks, torch.tensor([1.0, 0.0, 4.0]))
    torch.testing.assert_close(loss.geometry, torch.full((3,), 9.0))
    assert float(loss.total) == pytest.approx(5 / 3 + 0.5 * 9)


def test_loss_of_a_batch_is_the_mean_over_its_shares() -> None:
    a, b = _random(0, 4, 6), _random(1, 4, 6)

    def loss(rows: slice) -> float:
        joint = joint_cfm_loss(
            predicted_masks=a[rows],
            target_masks=b[rows],
            predicted_geometry=b[rows],
            target_geometry=a[rows],
            beta=2.0,
        )
        return float(joint.total)

    assert loss(slice(0, 4)) == pytest.approx((loss(slice(0, 2)) + loss(slice(2, 4))) / 2)


@pytest.mark.parametrize("rescale_t", [1.0, 3.0])
def test_sampler_is_exact_on_straight_paths(rescale_t: float) -> None:
    clean = {"geometry": _random(0, 2, 8, 4, 4, 4), "masks": _random(1, 2, 3, 1, 8, 8)}
    noise = noise_like(clean, torch.Generator().manual_seed(2))
    target = {name: velocity_target(clean[name], noise[name]) for name in clean}
    sampled = euler_sample(lambda x_t, t: target, noise, SamplerSettings(steps=3, rescale_t=rescale_t))
    for name, value in clean.items():
        torch.testing.assert_close(sampled[name], value)


@pytest.mark.parametrize("rescale_t", [1.0, 3.0])
def test_error_slope_of_euler_is_minus_one_on_a_linear_field(rescale_t: float) -> None:
    start = _random(0, 2, 3)
    steps = [32, 64, 128, 256, 512]
    errors = []
    for count in steps:
        end = euler_sample(
            lambda x, t: {"x": x["x"]}, {"x": start}, SamplerSettings(steps=count, rescale_t=rescale_t)
        )
        # dx/dt = x from t = 1 to 0: x(0) = x(1) / e.
        errors.append(float((end["x"] - start / math.e).abs().max()))
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(-1, abs=0.02)


def test_time_grid_is_trellis_rescaling() -> None:
    times = time_grid(SamplerSettings(steps=4, rescale_t=3.0))
    expected = [3 * t / (1 + 2 * t) for t in (1, 0.75, 0.5, 0.25, 0)]
    np.testing.assert_allclose(times.numpy(), expected)


def test_every_tensor_gets_the_same_time() -> None:
    seen = []

    def velocity(x_t: dict[str, torch.Tensor], t: torch.Tensor) -> dict[str, torch.Tensor]:
        seen.append((set(x_t), t.tolist()))
        return x_t

    noise = {"a": torch.ones(2, 1), "b": torch.ones(2, 3)}
    states = list(euler_path(velocity, noise, SamplerSettings(steps=2, rescale_t=1.0)))
    assert seen == [({"a", "b"}, [1.0, 1.0]), ({"a", "b"}, [0.5, 0.5])]
    assert [float(state["a"][0]) for state in states] == [0.5, 0.25]
    assert torch.equal(noise["a"], torch.ones(2, 1))  # the caller's tensors are left alone


def test_guidance_is_per_tensor_and_only_inside_its_interval() -> None:
    calls = []

    def unconditional(x_t: dict[str, torch.Tensor], t: torch.Tensor) -> dict[str, torch.Tensor]:
        calls.append(float(t[0]))
        return {name: torch.zeros_like(value) for name, value in x_t.items()}

    state = {"geometry": torch.ones(1, 2), "masks": torch.ones(1, 3)}
    guidance = Guidance(strength={"geometry": 5.0}, interval=(0.5, 1.0))
    velocity = guided(lambda x_t, t: x_t, unconditional, guidance)
    inside = velocity(state, torch.tensor([0.5]))
    assert inside["geometry"].tolist() == [[6.0, 6.0]]
    assert inside["masks"].tolist() == [[1.0, 1.0, 1.0]]
    outside = velocity(state, torch.tensor([0.49]))
    assert outside["geometry"].tolist() == [[1.0, 1.0]]
    assert calls == [0.5]


def test_zero_strength_is_conditional() -> None:
    def unconditional(x_t: dict[str, torch.Tensor], t: torch.Tensor) -> dict[str, torch.Tensor]:
        raise AssertionError("not needed")

    state = {"geometry": _random(0, 1, 2)}
    velocity = guided(
        lambda x_t, t: x_t, unconditional, Guidance(strength={"geometry": 0.0}, interval=(0.0, 1.0))
    )
    assert velocity(state, torch.ones(1))["geometry"] is state["geometry"]


def test_noise_repeats_with_the_generator_whatever_the_order_of_names() -> None:
    shapes = {"geometry": torch.zeros(1, 8), "masks": torch.zeros(1, 2)}
    first = noise_like(shapes, torch.Generator().manual_seed(3))
    second = noise_like(dict(reversed(shapes.items())), torch.Generator().manual_seed(3))
    assert all(torch.equal(first[name], second[name]) for name in shapes)


@pytest.mark.parametrize(
    "make",
    [
        lambda: SamplerSettings(steps=0, rescale_t=1.0),
        lambda: SamplerSettings(steps=5, rescale_t=0.0),
        lambda: Guidance(strength={}, interval=(0.8, 0.2)),
        lambda: LogitNormalTime(mean=0.0, std=0.0),
        lambda: guided(lambda x, t: x, lambda x, t: x, Guidance(strength={"mask": 1.0}, interval=(0.0, 1.0)))(
            {"masks": torch.ones(1)}, torch.ones(1)
        ),
    ],
)
def test_bad_settings_are_one_clear_line(make) -> None:
    with pytest.raises(ModelError, match="expected") as caught:
        make()
    assert "\n" not in str(caught.value)
