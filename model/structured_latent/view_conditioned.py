"""Stage 2 as one module: the SLat flow conditioned on each view of an occluded object (section 3.3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from model.encoders.aggregator import FeatureAggregator
from model.networks.embeddings import sincos_position_embedding
from model.networks.sparse.tensor import SparseTensor
from model.networks.transformer import layer_norm
from model.networks.view_fusion import ViewFusion
from model.structured_latent.flow import SlatFlow
from model.structured_latent.vae.latent import LatentNormalisation

__all__ = ["ViewCondition", "ViewConditionedSlatFlow", "ViewContext"]


@dataclass(frozen=True, kw_only=True)
class ViewCondition:
    """What the flow attends to: the tokens of each view, and the views' weights, which sum to one."""

    contexts: Float[Tensor, "batch view token condition"]
    weights: Float[Tensor, "batch view"]

    def dropped(self, samples: Bool[Tensor, " batch"]) -> "ViewCondition":
        """Without condition for these samples: contexts of zeros, as TRELLIS's neg_cond (FORMATS 4.4).

        Equal contexts make the weights of such a sample irrelevant.
        """
        contexts = torch.where(samples[:, None, None, None], 0, self.contexts)
        return ViewCondition(contexts=contexts, weights=self.weights)

    def unconditional(self) -> "ViewCondition":
        """No sample with condition, for guidance."""
        everyone = torch.ones(len(self.weights), dtype=torch.bool, device=self.weights.device)
        return self.dropped(everyone)


class ViewContext(nn.Module):
    """Tokens of a view: its layer-normed image features plus what the hand and the position add.

    Published weights expect layer-normed image features of width `condition_channels`, and get exactly these at
    the start when the widths are equal: what is added starts at zero. Image features of another width are
    projected, and the addition starts as any layer does.
    """

    pos_emb: Tensor

    def __init__(self, aggregator: FeatureAggregator, condition_channels: int) -> None:
        super().__init__()
        config = aggregator.config
        self.aggregator = aggregator
        self.addition = nn.Linear(config.channels, condition_channels)
        nn.init.zeros_(self.addition.bias)
        if config.image_channels == condition_channels:
            self.image_projection: nn.Module = nn.Identity()
            nn.init.zeros_(self.addition.weight)
        else:
            self.image_projection = nn.Linear(config.image_channels, condition_channels)
            nn.init.xavier_uniform_(self.image_projection.weight)
            nn.init.zeros_(self.image_projection.bias)
            nn.init.xavier_uniform_(self.addition.weight)
        # Convolutional features do not know where they are. Computed, not learned: not saved.
        pos_emb = sincos_position_embedding(aggregator.grid, 2, config.channels)
        self.register_buffer("pos_emb", pos_emb, persistent=False)

    def forward(
        self,
        image_tokens: Float[Tensor, "batch view token image_channel"],
        hand_tokens: Float[Tensor, "batch view hand_token hand_channel"],
    ) -> Float[Tensor, "batch view token condition"]:
        """One context per view; views stay apart."""
        aggregated = self.aggregator(image_tokens, hand_tokens) + self.pos_emb
        return self.image_projection(layer_norm(image_tokens)) + self.addition(aggregated)


class ViewConditionedSlatFlow(nn.Module):
    """The trained parts of stage 2: `flow.*` are the parameters of a published flow, the rest is new.

    `fusion` weighs the views by their contexts, uniformly at the start. `normalisation` belongs to the latents
    that the flow is trained on and travels with it.
    """

    def __init__(
        self, aggregator: FeatureAggregator, flow: SlatFlow, normalisation: LatentNormalisation
    ) -> None:
        super().__init__()
        self.context = ViewContext(aggregator, flow.config.condition_channels)
        self.fusion = ViewFusion(flow.config.condition_channels)
        self.flow = flow
        self.normalisation = normalisation

    def condition(
        self,
        image_tokens: Float[Tensor, "batch view token image_channel"],
        hand_tokens: Float[Tensor, "batch view hand_token hand_channel"],
    ) -> ViewCondition:
        """From features of the occluded images; a sampler computes it once for all its steps."""
        contexts = self.context(image_tokens, hand_tokens)
        return ViewCondition(contexts=contexts, weights=self.fusion(contexts))

    def forward(
        self, x_t: SparseTensor, t: Float[Tensor, " batch"], condition: ViewCondition
    ) -> SparseTensor:
        """Velocity of normalised latents (noise - clean)."""
        return self.flow(x_t, t, condition.contexts, condition.weights)
