"""What the sections of both flows have in common: guidance, and what cannot be trained."""

from dataclasses import dataclass
from typing import Annotated

from model.flow import Guidance
from model.networks.lora import LoraSettings
from shards.settings import Range

__all__ = ["GuidanceConfig", "guidance_of", "require_adapter", "require_condition"]


@dataclass(frozen=True, kw_only=True)
class GuidanceConfig:
    """Classifier-free guidance, as `model.flow.Guidance` says."""

    strength: Annotated[float, Range(0, 1e3)]  # w: (1 + w) v_c - w v_u
    interval: Annotated[tuple[float, float], Range(0, 1, rising=True)]  # of t, inside [0, 1]

    def __post_init__(self) -> None:
        if self.strength == 0:
            raise ValueError("strength is 0: expected another number, or `guidance: null` for none")
        Guidance(strength={}, interval=self.interval)  # refuses what is not inside [0, 1]


def guidance_of(config: GuidanceConfig | None, tensor: str) -> Guidance:
    """Guidance of one of a flow's tensors; the others go unguided."""
    if config is None:
        return Guidance(strength={}, interval=(0.0, 1.0))
    return Guidance(strength={tensor: config.strength}, interval=config.interval)


def require_adapter(lora: LoraSettings | None, *, starts: bool) -> None:
    """ValueError: adapters on nothing, or with dropout.

    All randomness of a step is drawn from its own generators, or no resume would be exact.
    """
    if lora is None:
        return
    if lora.dropout > 0:
        raise ValueError(
            f"lora.dropout is {lora.dropout}: expected 0, as in the paper; a resume would not be exact"
        )
    if not starts:
        raise ValueError(
            "lora adapts weights that are there, and start is null: expected a file to start from; "
            "name one (`forehoi weights import`), or set lora to null"
        )


def require_condition(drop_condition: float, guidance: GuidanceConfig | None) -> None:
    """ValueError: no share, or guidance by a velocity that is never trained."""
    if not 0 <= drop_condition < 1:
        raise ValueError(f"drop_condition is {drop_condition}: expected a share below 1")
    if guidance is not None and drop_condition == 0:
        raise ValueError(
            f"guidance.strength is {guidance.strength} and drop_condition 0: guidance needs the velocity without a "
            "condition; expected drop_condition > 0, or guidance: null"
        )
