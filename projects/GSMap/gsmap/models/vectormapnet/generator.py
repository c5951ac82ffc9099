"""VectorMapNet's polyline generator, which predicts the points of an element token by token."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import BEVEmbedding
from gsmap.models.vectormapnet.layers import Cache, GatedLayer, append_cache, keep_most_likely
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError

_CONDITION = 5  # tokens of class and box, which precede the tokens of the points
_FORBIDDEN = -1e9  # logit
Draw = Callable[[Tensor], Tensor]  # from probabilities (n, t, tokens) to tokens (n, t)


class Elements(NamedTuple):
    """Elements of one sample for which lines are generated."""

    labels: Tensor  # class indices (n,)
    boxes: Tensor  # x0, y0, x1, y1 in whole pixels of the canvas (n, 4)


class PolylineGenerator(BaseModule):
    """Autoregressive generator of polylines with any number of points within boxes.

    Args:
        canvas: Raster of the tokens.
        num_classes: Number of classes.
        in_channels: Channels C' of the BEV features.
        embed_dims: Channels C of the tokens.
        num_layers: Number of decoder layers.
        num_heads: Number of attention heads of a layer.
        ffn_dims: Hidden channels of the layers' feed-forward networks.
        dropout: Probability of setting a value to zero in training, in [0, 1].
        top_p: Probability mass in [0, 1] that tokens are sampled from; 0 takes the most likely
            token.
        max_points: Largest number of points of a generated line, >= 2.
        redraw: Whether every step samples all earlier tokens again as input of the first layer, as
            in the released code. The line keeps the tokens that were sampled first.
        noise_share: Share in [0, 1] of the coordinates that receive noise in training.
        noise_px: Standard deviations of the noise along x and y, in pixels.
        box_noise_by_x: Whether noise sets y of a box corner to its x, an error of the released
            code.
        num_positions: Largest number of points of an annotated line.
        shrunk_results: Whether tokens are converted to metres as if the canvas had no margin, as
            in the released code, which shrinks the annotated lines of its metric in this way too.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If a share is not in [0, 1], or if ``max_points`` is out of range.
    """

    def __init__(
        self,
        canvas: Canvas,
        num_classes: int,
        in_channels: int = 128,
        embed_dims: int = 256,
        num_layers: int = 6,
        num_heads: int = 8,
        ffn_dims: int = 512,
        dropout: float = 0.2,
        top_p: float = 0.9,
        max_points: int = 64,
        redraw: bool = False,
        noise_share: float = 0.3,
        noise_px: tuple[float, float] = (2.0, 1.0),
        box_noise_by_x: bool = True,
        num_positions: int = 500,
        shrunk_results: bool = False,
        init_cfg: dict | None = None,
    ) -> None:
        super().__init__(init_cfg)
        for name, share in (("top_p", top_p), ("noise_share", noise_share)):
            if not 0 <= share <= 1:
                raise InputError(f"{name} must be in [0, 1], got {share}.")
        if not 2 <= max_points <= num_positions:
            raise InputError(
                f"max_points must be 2 to num_positions = {num_positions}, got {max_points}."
            )
        self.canvas = canvas
        self.top_p = top_p
        self.max_points = max_points
        self.redraw = redraw
        self.noise_share = noise_share
        self.noise_px = noise_px
        self.box_noise_by_x = box_noise_by_x
        self.metres: Callable[[Tensor], Tensor] = (
            canvas.grid.metres_from_norm if shrunk_results else canvas.metres_from_norm
        )
        self.context = BEVEmbedding(in_channels, embed_dims)
        self.label = nn.Embedding(num_classes, embed_dims)
        self.vertex = nn.Embedding(canvas.num_tokens, embed_dims)
        self.position = nn.Embedding(num_positions, embed_dims)
        self.axis = nn.Embedding(2, embed_dims)
        self.corner = nn.Embedding(3, embed_dims)  # the third one is unused, as in the release
        self.layers: Any = nn.ModuleList(
            GatedLayer(embed_dims, num_heads, ffn_dims=ffn_dims, dropout=dropout)
            for _ in range(num_layers)
        )
        self.logits = nn.Linear(embed_dims, canvas.num_tokens)

    def init_weights(self) -> None:
        """Initialise matrices with Xavier's method."""
        super().init_weights()
        for module in (self.layers, self.context, self.logits):
            init_matrices(module)

    def memory(self, bev_feats: Tensor) -> list[Cache]:
        """Compute the keys and values of one sample's map for every layer. (C', H, W)"""
        cells = self.context(bev_feats[None]).flatten(2).transpose(1, 2)  # (1, H * W, C)
        return [layer.cross_attn.keys_values(cells) for layer in self.layers]

    def embed_condition(self, elements: Elements) -> Tensor:
        """Embed classes and boxes as the first tokens of the lines. (n, 5, C)"""
        number = torch.arange(4, device=elements.boxes.device)
        boxes = self.vertex(elements.boxes) + self.corner(number // 2) + self.axis(number % 2)
        return torch.cat([self.label(elements.labels)[:, None], boxes], dim=1)

    def embed_points(self, tokens: Tensor, start: int = 0) -> Tensor:
        """Embed the tokens of points, from token number ``start`` on. (n, T) -> (n, T, C)"""
        number = torch.arange(start, start + tokens.shape[1], device=tokens.device)
        return self.vertex(tokens) + self.position(number // 2) + self.axis(number % 2)

    def mask_forbidden(self, logits: Tensor, start: int = 0) -> Tensor:
        """Mask coordinates beyond the canvas, and stop tokens between x and y.

        Args:
            logits: Logits of T successive tokens. (n, T, tokens)
            start: Number of the first token in its line.

        Returns:
            Logits with -1e9 for forbidden tokens. (n, T, tokens)
        """
        token = torch.arange(self.canvas.num_tokens, device=logits.device)
        forbidden_x = token > self.canvas.size[0]
        forbidden_y = token > self.canvas.size[1]
        forbidden_y[0] = True
        forbidden = torch.stack([forbidden_x, forbidden_y])
        number = torch.arange(start, start + logits.shape[1], device=logits.device)
        return logits.masked_fill(forbidden[number % 2], _FORBIDDEN)

    def states(self, bev_feats: Tensor, elements: Elements, tokens: Tensor) -> list[Tensor]:
        """Compute the states of all tokens after each layer, with causal attention.

        Args:
            bev_feats: BEV features of one sample. (C', H, W)
            elements: Classes and boxes of n lines.
            tokens: Tokens of the lines. (n, T)

        Returns:
            States of the condition and of the tokens. (n, 5 + T, C) for each layer
        """
        states = torch.cat([self.embed_condition(elements), self.embed_points(tokens)], dim=1)
        mask = causal_mask(states.shape[1], states.device)
        outputs = []
        for layer, memory in zip(self.layers, self.memory(bev_feats), strict=True):
            states = layer(states, layer.keys_values(states), memory=memory, mask=mask)
            outputs.append(states)
        return outputs

    def log_probs(self, bev_feats: Tensor, elements: Elements, tokens: Tensor) -> Tensor:
        """Compute the log-probabilities of the first token and of the token after each given one.

        Args:
            bev_feats: BEV features of one sample. (C', H, W)
            elements: Classes and boxes of n lines.
            tokens: Tokens of the lines. (n, T)

        Returns:
            Log-probabilities. (n, T + 1, tokens)
        """
        states = self.states(bev_feats, elements, tokens=tokens)[-1]
        logits = self.logits(states[:, _CONDITION - 1 :]).float()
        return self.mask_forbidden(logits).log_softmax(dim=-1)

    def loss(
        self, bev_feats: Tensor, elements: Elements, tokens: Tensor, weights: Tensor
    ) -> Tensor:
        """Compute the weighted negative log-likelihood of one sample's lines, summed over tokens.

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Annotated classes and boxes.
            tokens: Annotated tokens with a stop token, filled with zeros. (n, T)
            weights: Weights of the tokens, 0 after the stop token. (n, T)

        Returns:
            Scalar loss.

        Raises:
            ValueError: If a line has more points than there are positions.
        """
        if tokens.shape[1] > 2 * self.position.num_embeddings + 1:
            raise InputError(
                f"an annotated line has {tokens.shape[1] // 2} points, and num_positions of "
                f"PolylineGenerator is {self.position.num_embeddings}: set it higher, or "
                "tolerance_m of FormatPolylineTargets."
            )
        if not len(tokens):
            return torch.stack([parameter.sum() for parameter in self.parameters()]).sum() * 0
        inputs = tokens[:, :-1]
        boxes = elements.boxes
        if self.training and self.noise_share:
            inputs = self.add_noise(inputs).where(inputs > 0, 0)
            boxes = self.add_noise(boxes, by_x=self.box_noise_by_x)
        log_probs = self.log_probs(bev_feats, Elements(elements.labels, boxes), tokens=inputs)
        target_log_probs = log_probs.gather(-1, tokens[..., None])[..., 0]
        return -(target_log_probs * weights).sum()

    def add_noise(self, tokens: Tensor, by_x: bool = False) -> Tensor:
        """Add rounded normal noise to a random share of coordinates.

        Args:
            tokens: Coordinates x, y, x, y, ... in pixels of the canvas. (n, T)
            by_x: Whether y of a noisy coordinate is replaced by its x.

        Returns:
            Coordinates on the canvas. (n, T)
        """
        axis = torch.arange(tokens.shape[1], device=tokens.device) % 2
        scale = constant(tokens, self.noise_px, torch.float)[axis]
        noise = (torch.randn(tokens.shape, device=tokens.device) * scale).round()
        is_noisy = torch.rand(tokens.shape, device=tokens.device) < self.noise_share
        return self.shift(tokens, noise.long(), by_x=by_x).where(is_noisy, tokens)

    def shift(self, tokens: Tensor, noise: Tensor, by_x: bool = False) -> Tensor:
        """Shift coordinates by noise and clamp them to the canvas.

        Args:
            tokens: Coordinates x, y, x, y, ... in pixels of the canvas. (n, T)
            noise: Shift of each coordinate, in pixels. (n, T)
            by_x: Whether y is replaced by x.

        Returns:
            Coordinates in [1, W] and [1, H]. (n, T)
        """
        number = torch.arange(tokens.shape[1], device=tokens.device)
        source = number // 2 * 2 if by_x else number
        shifted_tokens = (tokens + noise)[:, source].clamp(min=1)
        return shifted_tokens.minimum(constant(tokens, self.canvas.size)[number % 2])

    @torch.no_grad()
    def generate(self, bev_feats: Tensor, elements: Elements, draw: Draw) -> Tensor:
        """Generate the tokens of one sample's lines.

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Classes and boxes of the n lines.
            draw: Function that samples tokens (n, t) from probabilities (n, t, tokens).

        Returns:
            Tokens, 0 from the end of a line on. (n, 2 * max_points + 1)
        """
        memory = self.memory(bev_feats)
        condition = self.embed_condition(elements)
        num_steps = 2 * self.max_points + 1
        tokens = elements.labels.new_zeros(len(condition), num_steps)
        if not len(tokens):
            return tokens
        active = torch.arange(len(tokens), device=tokens.device)  # rows of unfinished lines
        caches: list[Cache | None] = [None] * len(self.layers)
        laws = condition.new_zeros(len(tokens), 0, self.canvas.num_tokens)
        states = condition
        for step in range(num_steps):
            for i, layer in enumerate(self.layers):
                cache = append_cache(caches[i], layer.keys_values(states))
                caches[i] = cache
                states = layer(states, cache, memory=memory[i])
            logits = self.mask_forbidden(self.logits(states[:, -1:]).float(), start=step)
            law = keep_most_likely(logits, self.top_p).softmax(dim=-1)  # (n, 1, tokens)
            laws = torch.cat([laws, law], dim=1) if self.redraw else law
            samples = draw(laws)
            tokens[active, step] = samples[:, -1]
            is_active = samples[:, -1] > 0
            if not is_active.any() or step == num_steps - 1:
                break
            active = active[is_active]
            laws = laws[is_active]
            samples = samples[is_active]
            condition = condition[is_active]
            for i, layer_cache in enumerate(caches):
                if layer_cache is not None:
                    keys, values = layer_cache
                    caches[i] = (keys[is_active], values[is_active])
            if self.redraw:
                inputs = torch.cat([condition, self.embed_points(samples[:, :-1])], dim=1)
                caches[0] = self.layers[0].keys_values(inputs)
            states = self.embed_points(samples[:, -1:], start=step)
        return tokens

    def seeded_draw(self, seed: int) -> Draw:
        """Return a function that samples tokens from probabilities with a seeded generator."""
        source = torch.Generator(self.vertex.weight.device).manual_seed(seed)

        def draw(laws: Tensor) -> Tensor:
            samples = laws.flatten(0, 1).multinomial(1, generator=source)
            return samples.view(laws.shape[:2])

        return draw

    def lines(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Convert tokens to points.

        Args:
            tokens: Tokens, from `generate`. (n, 2 P + 1)

        Returns:
            Points in metres, filled with the last point of a line, (n, P, 2), and the number of
            points of each line. (n,)
        """
        pairs = tokens[:, :-1].unflatten(1, (-1, 2))  # (n, P, 2)
        number = (pairs > 0).all(dim=-1).sum(dim=-1)
        last = (number[:, None] - 1).clamp(min=0)
        index = torch.arange(pairs.shape[1], device=tokens.device).minimum(last)  # (n, P)
        pixels = pairs.gather(1, index[..., None].expand(-1, -1, 2)) - 1
        steps = constant(pairs, self.canvas.steps, torch.float)
        return self.metres(pixels / steps), number


def causal_mask(number: int, device: torch.device) -> Tensor:
    """Create the attention mask of condition and point tokens.

    A token attends to itself and to earlier tokens; condition tokens attend to each other.

    Args:
        number: Number T of tokens, with the condition.
        device: Device of the mask.

    Returns:
        True where a token (row) attends to another one (column). (T, T)
    """
    mask = torch.ones(number, number, dtype=torch.bool, device=device).tril()
    mask[:_CONDITION, :_CONDITION] = True
    return mask
