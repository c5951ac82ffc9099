"""VectorMapNet's polyline generator, which predicts the points of an element token by token.

A token is an integer: the x or y of a point in pixels of the canvas plus one, or 0, the stop token.
The tokens of a line are x, y, x, y, ... and a stop token.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.checkpoints.class_axes import mark_classes
from gsmap.models.base.layers import init_matrices
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import BEVEmbedding
from gsmap.models.vectormapnet.layers import Cache, GatedLayer, append_cache, keep_most_likely
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError
from gsmap.utils.settings import check_positive

_CONDITION = 5  # tokens before the points: the class, and x0, y0, x1, y1 of the box
_FORBIDDEN = -1e9  # logit of a token that must not be sampled
Draw = Callable[[Tensor], Tensor]  # samples tokens (n, t) from probabilities (n, t, tokens)


class Elements(NamedTuple):
    """Classes and boxes of the elements of one sample; a line is generated for each element."""

    labels: Tensor  # class indices (n,)
    boxes: Tensor  # x0, y0, x1, y1 in whole pixels of the canvas, used as tokens (n, 4)


class PolylineGenerator(BaseModule):
    """Autoregressive generator of polylines with any number of points within boxes.

    Args:
        canvas: Raster of W x H pixels over the map and a margin, whose pixels are the tokens.
        num_classes: Number of classes.
        in_channels: Channels C' of the BEV features.
        embed_dims: Channels C of the tokens.
        num_layers: Number of decoder layers.
        num_heads: Number of attention heads of a layer.
        ffn_dims: Hidden channels of the layers' feed-forward networks.
        dropout: Probability of setting a value to zero in training, in [0, 1].
        top_p: Tokens are sampled from the smallest set of most likely tokens with at least this
            total probability, in [0, 1]. 0 takes the most likely token.
        max_points: Largest number of points of a generated line, >= 2.
        redraw: Whether every step samples all earlier tokens again, as in the released code. The
            new samples are inputs of the first layer only; the line consists of the first samples.
        noise_share: Share in [0, 1] of the coordinates that receive noise in training.
        noise_px: Standard deviations of the noise along x and y, in pixels.
        box_noise_by_x: Whether a y of a box corner that receives noise is replaced by the noisy x
            of the corner, which is an error of the released code.
        num_positions: Largest number of points of an annotated line.
        shrunk_results: Whether tokens are converted to metres as if the canvas had no margin, which
            shrinks the lines. The released code shrinks predicted and annotated lines in this way.
        init_cfg: Initialisation config of mmengine.

    Raises:
        ValueError: If ``top_p`` or ``noise_share`` is not in [0, 1], ``max_points`` is out of
            range, or ``num_layers`` is not positive.
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
        if not 0 <= top_p <= 1:
            raise InputError(f"top_p must be in [0, 1], got {top_p}.")
        if not 0 <= noise_share <= 1:
            raise InputError(f"noise_share must be in [0, 1], got {noise_share}.")
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
        self.metres_from_norm: Callable[[Tensor], Tensor] = canvas.metres_from_norm
        if shrunk_results:
            self.metres_from_norm = canvas.grid.metres_from_norm
        check_positive(num_layers=num_layers)
        self.context = BEVEmbedding(in_channels, embed_dims)
        # The embedding of a coordinate is the sum of three vectors: for its token, for its axis (x
        # or y), and for the number of its point or box corner.
        self.label = nn.Embedding(num_classes, embed_dims)
        mark_classes(self.label)
        self.vertex = nn.Embedding(canvas.num_tokens, embed_dims)
        self.position = nn.Embedding(num_positions, embed_dims)
        self.axis = nn.Embedding(2, embed_dims)
        self.corner = nn.Embedding(3, embed_dims)  # two corners; the third row is unused
        self.layers: Any = nn.ModuleList(
            GatedLayer(embed_dims, num_heads, ffn_dims=ffn_dims, dropout=dropout)
            for _ in range(num_layers)
        )
        self.logits = nn.Linear(embed_dims, canvas.num_tokens)

    def init_weights(self) -> None:
        """Initialise matrices with Xavier's method."""
        super().init_weights()
        for module in (self.layers, self.context, self.logits):  # others keep torch's default
            init_matrices(module)

    def memory(self, bev_feats: Tensor) -> list[Cache]:
        """Compute the keys and values of the BEV cells for the cross-attention of every layer.

        Args:
            bev_feats: BEV features of one sample. (C', H, W)
        """
        cells = self.context(bev_feats[None]).flatten(2).transpose(1, 2)  # (1, H * W, C)
        return [layer.cross_attn.keys_values(cells) for layer in self.layers]

    def embed_condition(self, elements: Elements) -> Tensor:
        """Embed classes and boxes as the first tokens of the lines. (n, 5, C)"""
        number = torch.arange(4, device=elements.boxes.device)  # 0 to 3 for x0, y0, x1, y1
        corners = self.corner(number // 2)
        axes = self.axis(number % 2)
        boxes = self.vertex(elements.boxes) + corners + axes  # (n, 4, C)
        labels = self.label(elements.labels)[:, None]  # (n, 1, C)
        return torch.cat([labels, boxes], dim=1)

    def embed_points(self, tokens: Tensor, start: int = 0) -> Tensor:
        """Embed the tokens of points.

        Args:
            tokens: Successive tokens of lines: x, y, x, y, ... (n, T)
            start: Number of the first token in its line, from 0.

        Returns:
            Embeddings. (n, T, C)
        """
        # Tokens 2 p and 2 p + 1 are x and y of point p.
        number = torch.arange(start, start + tokens.shape[1], device=tokens.device)
        positions = self.position(number // 2)
        axes = self.axis(number % 2)
        return self.vertex(tokens) + positions + axes

    def mask_forbidden(self, logits: Tensor, start: int = 0) -> Tensor:
        """Mask coordinates beyond the canvas, and stop tokens between x and y.

        Args:
            logits: Logits of T successive tokens. (n, T, tokens)
            start: Number of the first token in its line, from 0.

        Returns:
            Logits with -1e9 for forbidden tokens. (n, T, tokens)
        """
        # The last pixel along an axis of `size` pixels has the token `size`.
        token = torch.arange(self.canvas.num_tokens, device=logits.device)
        forbidden_x = token > self.canvas.size[0]
        forbidden_y = token > self.canvas.size[1]
        forbidden_y[0] = True  # the stop token
        forbidden = torch.stack([forbidden_x, forbidden_y])
        number = torch.arange(start, start + logits.shape[1], device=logits.device)
        axis = number % 2  # 0 for x, 1 for y
        return logits.masked_fill(forbidden[axis], _FORBIDDEN)

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
        """Compute the log-probabilities of the tokens at positions 0 to T of each line.

        The probabilities at position t depend on the given tokens before t.

        Args:
            bev_feats: BEV features of one sample. (C', H, W)
            elements: Classes and boxes of n lines.
            tokens: Tokens of the lines. (n, T)

        Returns:
            Log-probabilities. (n, T + 1, tokens)
        """
        states = self.states(bev_feats, elements, tokens=tokens)[-1]
        # A state predicts the next token, so the last condition token predicts the first token.
        first = _CONDITION - 1
        logits = self.logits(states[:, first:]).float()
        return self.mask_forbidden(logits).log_softmax(dim=-1)

    def loss(
        self, bev_feats: Tensor, elements: Elements, tokens: Tensor, weights: Tensor
    ) -> Tensor:
        """Compute the weighted negative log-likelihood of one sample's lines, summed over tokens.

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Annotated classes and boxes.
            tokens: Annotated tokens with a stop token, filled up with zeros. (n, T)
            weights: Weights of the tokens, 0 after the stop token. (n, T)

        Returns:
            Scalar loss.

        Raises:
            ValueError: If a line has more points than there are positions.
        """
        if tokens.shape[1] > 2 * self.position.num_embeddings + 1:
            raise InputError(
                f"an annotated line has {tokens.shape[1] // 2} points, and num_positions of "
                f"PolylineGenerator is {self.position.num_embeddings}: set a larger num_positions, "
                "or a larger tolerance_m of FormatPolylineTargets."
            )
        if not len(tokens):  # a loss of 0 that gives every parameter a gradient of 0
            sums = [parameter.sum() for parameter in self.parameters()]
            return torch.stack(sums).sum() * 0
        inputs = tokens[:, :-1]  # no token follows the last one
        boxes = elements.boxes
        if self.training and self.noise_share:
            inputs = self.add_noise(inputs).where(inputs > 0, 0)  # stop tokens and filling stay 0
            boxes = self.add_noise(boxes, by_x=self.box_noise_by_x)
        log_probs = self.log_probs(bev_feats, Elements(elements.labels, boxes), tokens=inputs)
        target_log_probs = log_probs.gather(-1, tokens[..., None])[..., 0]
        return -(target_log_probs * weights).sum()

    def add_noise(self, tokens: Tensor, by_x: bool = False) -> Tensor:
        """Add rounded normal noise to a random share of coordinates.

        Args:
            tokens: Coordinates x, y, x, y, ... in pixels of the canvas. (n, T)
            by_x: Whether each noisy y is replaced by the shifted x of its point.

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
            by_x: Whether each y is replaced by the shifted x of its point.

        Returns:
            Coordinates in [1, W] and [1, H]. (n, T)
        """
        number = torch.arange(tokens.shape[1], device=tokens.device)
        axis = number % 2
        # Index of the coordinate that is shifted; number - axis is the x of each point.
        shifted_index = number - axis if by_x else number
        largest = constant(tokens, self.canvas.size)[axis]
        shifted_tokens = (tokens + noise)[:, shifted_index].clamp(min=1)
        return shifted_tokens.minimum(largest)

    @torch.no_grad()
    def generate(self, bev_feats: Tensor, elements: Elements, draw: Draw) -> Tensor:
        """Generate the tokens of one sample's lines.

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Classes and boxes of the n lines.
            draw: Function that samples tokens (n, t) from probabilities (n, t, tokens).

        Returns:
            Tokens, 0 from the end of a line on. A line that is not finished after ``max_points``
            points is cut off. (n, 2 * max_points + 1)
        """
        memory = self.memory(bev_feats)
        condition = self.embed_condition(elements)
        num_steps = 2 * self.max_points + 1  # x and y of each point, and the stop token
        tokens = elements.labels.new_zeros(len(condition), num_steps)
        if not len(tokens):
            return tokens
        active = torch.arange(len(tokens), device=tokens.device)  # rows of unfinished lines
        caches: list[Cache | None] = [None] * len(self.layers)
        # Probabilities of all tokens so far with `redraw`, otherwise of the last token alone.
        all_probs = condition.new_zeros(len(tokens), 0, self.canvas.num_tokens)
        # New inputs of a step: the condition in the first step, later the previous token.
        states = condition
        for step in range(num_steps):
            for i, layer in enumerate(self.layers):
                # Keys and values of all tokens so far; the new tokens attend to them.
                cache = append_cache(caches[i], layer.keys_values(states))
                caches[i] = cache
                states = layer(states, cache, memory=memory[i])
            logits = self.mask_forbidden(self.logits(states[:, -1:]).float(), start=step)
            # `keep_most_likely` masks the tokens that `top_p` excludes.
            probs = keep_most_likely(logits, self.top_p).softmax(dim=-1)  # (n, 1, tokens)
            all_probs = torch.cat([all_probs, probs], dim=1) if self.redraw else probs
            samples = draw(all_probs)
            new_tokens = samples[:, -1]
            tokens[active, step] = new_tokens
            is_active = new_tokens > 0  # an entry for each row in `active`
            if not is_active.any() or step == num_steps - 1:
                break
            # Drop the lines that have ended from all tensors.
            active = active[is_active]
            all_probs = all_probs[is_active]
            samples = samples[is_active]
            condition = condition[is_active]
            for i, layer_cache in enumerate(caches):
                if layer_cache is not None:
                    keys, values = layer_cache
                    caches[i] = (keys[is_active], values[is_active])
            if self.redraw:  # the first layer attends to the new samples of earlier tokens
                inputs = torch.cat([condition, self.embed_points(samples[:, :-1])], dim=1)
                caches[0] = self.layers[0].keys_values(inputs)
            states = self.embed_points(samples[:, -1:], start=step)
        return tokens

    def seeded_draw(self, seed: int) -> Draw:
        """Return a function that samples tokens from probabilities with a seeded generator."""
        generator = torch.Generator(self.vertex.weight.device).manual_seed(seed)

        def draw(probs: Tensor) -> Tensor:
            samples = probs.flatten(0, 1).multinomial(1, generator=generator)
            return samples.view(probs.shape[:2])

        return draw

    def lines(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Convert tokens to points.

        Args:
            tokens: Tokens, from `generate`. (n, 2 P + 1)

        Returns:
            Points in metres (n, P, 2), with the last point of each line repeated to the end of the
            row, and the number of points of each line (n,).
        """
        pairs = tokens[:, :-1].unflatten(1, (-1, 2))  # (n, P, 2)
        num_points = (pairs > 0).all(dim=-1).sum(dim=-1)  # (n,)
        last = (num_points[:, None] - 1).clamp(min=0)
        index = torch.arange(pairs.shape[1], device=tokens.device).minimum(last)  # (n, P)
        filled_pairs = pairs.gather(1, index[..., None].expand(-1, -1, 2))
        pixels = filled_pairs - 1  # token 1 is pixel 0
        # Number of the last pixel along x and y, at which normalised coordinates are 1.
        steps = constant(pairs, self.canvas.steps, torch.float)
        return self.metres_from_norm(pixels / steps), num_points


def causal_mask(num_tokens: int, device: torch.device) -> Tensor:
    """Create the attention mask of condition and point tokens.

    A token attends to itself and to earlier tokens; condition tokens attend to each other.

    Args:
        num_tokens: Number S of tokens, including the tokens of the condition.
        device: Device of the mask.

    Returns:
        True where a token (row) attends to another one (column). (S, S)
    """
    mask = torch.ones(num_tokens, num_tokens, dtype=torch.bool, device=device).tril()
    mask[:_CONDITION, :_CONDITION] = True
    return mask
