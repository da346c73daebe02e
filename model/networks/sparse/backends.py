"""Which kernels run: pure PyTorch everywhere; spconv and packed FlashAttention on CUDA where they can."""

from functools import cache
from importlib.util import find_spec

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["uses_packed_attention", "uses_spconv"]


def uses_spconv(features: Float[Tensor, "voxel channel"]) -> bool:
    """spconv is installed and has kernels for these features: CUDA, float32 or float16."""
    if features.device.type != "cuda" or features.dtype not in (torch.float32, torch.float16):
        return False
    return _has_spconv()


@cache
def _has_spconv() -> bool:
    """Asked for by every layer, so looked up once: 0.1 ms a time."""
    return find_spec("spconv") is not None


def uses_packed_attention(q: Float[Tensor, "row head channel"]) -> bool:
    """PyTorch's own FlashAttention over packed sequences can run: CUDA from compute 8.0, half precision."""
    if q.device.type != "cuda" or q.dtype not in (torch.float16, torch.bfloat16):
        return False
    if q.shape[-1] % 8 or not torch.backends.cuda.is_flash_attention_available():
        return False
    return torch.cuda.get_device_capability(q.device) >= (8, 0)
