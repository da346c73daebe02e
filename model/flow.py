"""The probability path, its losses and its sampler. No network appears here.

One convention everywhere: `clean` at t = 0, `noise` at t = 1, x_t = (1 - t) clean + t noise,
velocity = noise - clean (the target of Eq. 2). TRELLIS adds sigma_min = 1e-5 to the noise of clean samples;
here it is 0, which changes no prediction by more than 1e-5.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from model.errors import ModelError
from shards.settings import Range

__all__ = [
    "Guidance",
    "JointLoss",
    "LogitNormalTime",
    "SamplerSettings",
    "State",
    "TimeDistribution",
    "UniformTime",
    "Velocity",
    "binary_velocity",
    "euler_path",
    "euler_sample",
    "guided",
    "interpolate",
    "joint_cfm_loss",
    "noise_like",
    "preconditioned_velocity",
    "time_grid",
    "times_from_uniform",
    "velocity_target",
]

State = dict[str, Tensor]
"""Named tensors denoised together, e.g. {"geometry": [batch 8 16 16 16], "masks": [batch view 1 m m]}."""

Velocity = Callable[[State, Tensor], State]
"""(x_t, t Float[batch]) -> velocity of every tensor of x_t, same names and shapes."""


def _per_sample(t: Tensor, like: Tensor) -> Tensor:
    return t.to(like.dtype).reshape(-1, *[1] * (like.ndim - 1))


def interpolate(
    clean: Float[Tensor, " batch *shape"], noise: Float[Tensor, " batch *shape"], t: Float[Tensor, " batch"]
) -> Float[Tensor, " batch *shape"]:
    """x_t = (1 - t) clean + t noise, one t per sample."""
    time = _per_sample(t, clean)
    return (1 - time) * clean + time * noise


def velocity_target(
    clean: Float[Tensor, " batch *shape"], noise: Float[Tensor, " batch *shape"]
) -> Float[Tensor, " batch *shape"]:
    """dx_t/dt = noise - clean: what the network regresses (Eq. 2: epsilon - x_0)."""
    return noise - clean


def preconditioned_velocity(
    x_t: Float[Tensor, " batch *shape"], output: Float[Tensor, " batch *shape"], t: Float[Tensor, " batch"]
) -> Float[Tensor, " batch *shape"]:
    """The best linear guess of the velocity from x_t for clean tensors of unit variance, plus scaled output.

    With S = (1 - t)^2 + t^2: velocity = (2 t - 1) / S x_t + output / sqrt(S). The output's target has unit
    variance at every t, is uncorrelated with x_t, and is -clean at t = 1: a small network need not copy noise from
    its input to its output (the argument of Karras et al. 2022, Eq. 7, for this path).
    """
    time = _per_sample(t, x_t)
    variance = (1 - time) ** 2 + time**2
    return (2 * time - 1) / variance * x_t + variance.rsqrt() * output


_MIN_TIME = 1e-3


def binary_velocity(
    x_t: Float[Tensor, " batch *shape"],
    half_log_odds: Float[Tensor, " batch *shape"],
    t: Float[Tensor, " batch"],
) -> Float[Tensor, " batch *shape"]:
    """Velocity of a tensor that is -1 or +1 when clean, from half the log-odds of +1 apart from its own noise.

    The noisy value is itself evidence with half log-odds (1 - t) x_t / t^2, so by Bayes' rule
    E[clean | x_t] = tanh((1 - t) x_t / t^2 + half_log_odds) and velocity = (x_t - E[clean | x_t]) / t, the
    minimiser of Eq. 2. A network that outputs `half_log_odds` need only segment, and never copy noise.
    Below t = 0.001, where x_t gives the clean value away, the velocity falls to zero.
    """
    time = _per_sample(t, x_t.float()).clamp(min=_MIN_TIME)
    x, prior = x_t.to(time.dtype), half_log_odds.to(time.dtype)
    return ((x - torch.tanh((1 - time) * x / time**2 + prior)) / time).to(x_t.dtype)


@dataclass(frozen=True, kw_only=True)
class UniformTime:
    """t ~ U(0, 1), the paper's choice (section 3.3)."""


@dataclass(frozen=True, kw_only=True)
class LogitNormalTime:
    """t = sigmoid(z), z ~ N(mean, std^2); TRELLIS trains with mean 1, std 1 (FORMATS 4.4)."""

    mean: Annotated[float, Range(-100, 100)]
    std: Annotated[float, Range(1e-6, 100)]

    def __post_init__(self) -> None:
        if not self.std > 0:
            raise ModelError(
                "logit-normal time", f"std is {self.std}", expected="std > 0", action="Set it to 1."
            )


TimeDistribution = UniformTime | LogitNormalTime


def times_from_uniform(
    distribution: TimeDistribution, uniform: Float[Tensor, " batch"]
) -> Float[Tensor, " batch"]:
    """Training times from numbers in [0, 1), one per sample, shared by its geometry and its masks."""
    if isinstance(distribution, UniformTime):
        return uniform
    normal = torch.special.ndtri(uniform)
    return torch.sigmoid(distribution.mean + distribution.std * normal)


@dataclass(frozen=True, kw_only=True)
class JointLoss:
    """Eq. 2. `masks` and `geometry` are per sample, so that a bad sample can be named; `total` is what to minimise."""

    total: Float[Tensor, ""]
    masks: Float[Tensor, " batch"]
    geometry: Float[Tensor, " batch"]


def _squared_error(predicted: Tensor, target: Tensor) -> Tensor:
    # Float32: a bfloat16 mean over 10^5 elements loses the digits that a falling loss lives in.
    return (predicted.float() - target.float()).square().flatten(1).mean(1)


def joint_cfm_loss(
    *,
    predicted_masks: Float[Tensor, " batch *mask"],
    target_masks: Float[Tensor, " batch *mask"],
    predicted_geometry: Float[Tensor, " batch *latent"],
    target_geometry: Float[Tensor, " batch *latent"],
    beta: float,
) -> JointLoss:
    """L = L_2D + beta L_3D (Eq. 2): mean squared error of the velocities, both taken at the same t.

    Means are per sample first, so the loss of a global batch does not depend on how ranks share it.
    """
    masks = _squared_error(predicted_masks, target_masks)
    geometry = _squared_error(predicted_geometry, target_geometry)
    return JointLoss(total=(masks + beta * geometry).mean(), masks=masks, geometry=geometry)


@dataclass(frozen=True, kw_only=True)
class SamplerSettings:
    """Euler steps from noise to clean.

    `rescale_t` r maps t to r t / (1 + (r - 1) t): r > 1 spends more steps near the noise (TRELLIS ships
    25 steps with r = 3).
    """

    steps: Annotated[int, Range(1, 100_000)]
    rescale_t: Annotated[float, Range(1e-3, 1e3)]

    def __post_init__(self) -> None:
        if self.steps < 1 or self.rescale_t <= 0:
            problem = f"steps {self.steps}, rescale_t {self.rescale_t}"
            raise ModelError(
                "sampler", problem, expected="steps >= 1 and rescale_t > 0", action="Use 25 and 3."
            )


@dataclass(frozen=True, kw_only=True)
class Guidance:
    """Classifier-free guidance in TRELLIS's convention: (1 + w) v_c - w v_u while t is inside `interval`.

    `strength` gives w per tensor name; a name that is absent goes unguided (w = 0). ReconViaGen's
    strength s is w + 1 (FORMATS 4.6). TRELLIS ships w = 5 inside [0.5, 1].
    """

    strength: Mapping[str, float]
    interval: tuple[float, float]

    def __post_init__(self) -> None:
        low, high = self.interval
        if not 0 <= low <= high <= 1:
            raise ModelError(
                "guidance",
                f"interval {self.interval}",
                expected="0 <= low <= high <= 1",
                action="Use [0.5, 1].",
            )


def guided(conditional: Velocity, unconditional: Velocity, guidance: Guidance) -> Velocity:
    """The guided velocity; `unconditional` is evaluated only where it has an effect.

    Every sample of a state is at the same t (the sampler's), so one comparison decides.
    """
    low, high = guidance.interval
    known = {name: w for name, w in guidance.strength.items() if w != 0}

    def velocity(x_t: State, t: Tensor) -> State:
        unknown = sorted(known.keys() - x_t.keys())
        if unknown:
            raise ModelError(
                "guidance",
                f"strength for {unknown}",
                expected=f"names in {sorted(x_t)}",
                action="Rename them.",
            )
        with_condition = conditional(x_t, t)
        if not known or not low <= float(t[0]) <= high:
            return with_condition
        without = unconditional(x_t, t)
        return {
            name: (1 + known[name]) * v - known[name] * without[name] if name in known else v
            for name, v in with_condition.items()
        }

    return velocity


def time_grid(settings: SamplerSettings) -> Float[Tensor, " step"]:
    """steps + 1 times falling from exactly 1 to exactly 0, rescaled; float64."""
    t = torch.linspace(1, 0, settings.steps + 1, dtype=torch.float64)
    return settings.rescale_t * t / (1 + (settings.rescale_t - 1) * t)


def noise_like(state: Mapping[str, Tensor], generator: torch.Generator) -> State:
    """Standard normal noise for every tensor, drawn in the order of their names."""
    return {
        name: torch.randn(state[name].shape, generator=generator, device=generator.device).to(state[name])
        for name in sorted(state)
    }


def euler_path(velocity: Velocity, noise: State, settings: SamplerSettings) -> Iterator[State]:
    """The states after each Euler step x <- x - (t - t_next) v(x, t), last one clean (Eq. 3, run from noise).

    All tensors take the same step with velocities from the same call. Deterministic given `noise`.
    """
    times = time_grid(settings)
    state = dict(noise)
    any_tensor = next(iter(state.values()))
    for t, t_next in pairwise(times):
        batch_t = torch.full((any_tensor.shape[0],), float(t), dtype=torch.float32, device=any_tensor.device)
        step = velocity(state, batch_t)
        state = {name: x - float(t - t_next) * step[name] for name, x in state.items()}
        yield state


def euler_sample(velocity: Velocity, noise: State, settings: SamplerSettings) -> State:
    """The clean state at the end of `euler_path`."""
    state = noise
    for state in euler_path(velocity, noise, settings):  # noqa: B007 the last one is the result
        pass
    return state
