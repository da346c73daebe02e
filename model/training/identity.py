"""What decides the weights of a part: its configuration, the data, and the parts and files that it stands on."""

import hashlib

from model.config import ImportedVae, TrainingConfig, as_yaml
from model.weights.weight_file import weights_sha256

__all__ = ["part_sha256"]


def part_sha256(name: str, config: TrainingConfig) -> str:
    """Changes with anything that decides what training a part gives. ModelError when a weight file is missing."""
    vae, start = config.vae, config.stage_one.start
    parts = {
        "vae": (vae, config.data),
        "hand_encoder": (config.hand_encoder, config.data),
        "stage_one": (config.stage_one, config.encoders, vae, config.hand_encoder, config.data),
    }[name]
    texts = [as_yaml(part) for part in parts if part is not None]
    if name == "stage_one":
        weights = [vae.weights] if isinstance(vae, ImportedVae) else []
        weights += [start.weights] if start is not None else []
        texts += [weights_sha256(path) for path in weights]
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()
