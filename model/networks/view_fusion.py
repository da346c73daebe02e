"""What passes from the views to the geometry: the fusion weights w_n of Eq. 1, and the context of each view."""

from jaxtyping import Float
from torch import Tensor, nn

from model.networks.transformer import layer_norm

__all__ = ["MaskContext", "ViewFusion"]


class ViewFusion(nn.Module):
    """Fusion weights w_n = softmax over views of a learned score of each view's tokens.

    Eq. 1 gives one weight per frame, without a block index, and does not say how it is computed. Here the
    score is an MLP of the view's mean normalised token x_1^n. Its last layer starts at zero, so w_n = 1 / N at
    the start; ReconViaGen's published fusion is this uniform one (FORMATS 4.6).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.score = nn.Sequential(nn.Linear(channels, channels // 4), nn.SiLU(), nn.Linear(channels // 4, 1))
        for parameter in self.score[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, tokens: Float[Tensor, "batch view token channel"]) -> Float[Tensor, "batch view"]:
        """Weights of a sample sum to one; float32."""
        pooled = layer_norm(tokens).mean(2)
        return self.score(pooled)[..., 0].float().softmax(dim=1)


class MaskContext(nn.Module):
    """What geometry blocks attend to: projected layer-normed mask tokens, added to image features where there are any.

    Published weights expect layer-normed image features of width `condition_channels`. With `starts_at_zero` they get
    exactly these at the start, since the projection starts at zero. Without image features to add to, the projection
    starts as any layer does. All blocks share it; under LoRA their to_kv is frozen, and it is trained whole.
    """

    def __init__(self, channels: int, condition_channels: int, *, starts_at_zero: bool) -> None:
        super().__init__()
        self.projection = nn.Linear(channels, condition_channels)
        nn.init.xavier_uniform_(self.projection.weight)
        nn.init.zeros_(self.projection.bias)
        if starts_at_zero:
            nn.init.zeros_(self.projection.weight)

    def forward(
        self,
        tokens: Float[Tensor, "batch view token channel"],
        images: Float[Tensor, "batch view token condition"] | None,
    ) -> Float[Tensor, "batch view token condition"]:
        """One context per view; views stay apart. `images`: layer-normed image features of the same token grid."""
        projected = self.projection(layer_norm(tokens))
        return projected if images is None else images + projected
