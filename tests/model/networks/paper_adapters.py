"""The adapters of the paper on a flow of TRELLIS-image-large: 24 blocks of 1024 channels, in either stage."""


def paper_adapters() -> dict[str, tuple[int, ...]]:
    """Names and shapes of all trainable parameters: rank 64 on every projection of every attention."""
    shapes = {
        "self_attn.to_qkv": (3072, 1024),
        "self_attn.to_out": (1024, 1024),
        "cross_attn.to_q": (1024, 1024),
        "cross_attn.to_kv": (2048, 1024),
        "cross_attn.to_out": (1024, 1024),
    }
    expected: dict[str, tuple[int, ...]] = {}
    for j in range(24):
        for layer, (rows, columns) in shapes.items():
            expected[f"blocks.{j}.{layer}.lora_A.default.weight"] = (64, columns)
            expected[f"blocks.{j}.{layer}.lora_B.default.weight"] = (rows, 64)
    return expected
