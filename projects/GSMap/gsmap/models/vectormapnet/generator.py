"""VectorMapNet's polyline generator: the points of an element, token after token."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from mmengine.model import BaseModule
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices
from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.detector import CodedMap
from gsmap.models.vectormapnet.layers import Cache, GatedLayer, joined, most_likely
from gsmap.structures.tensors import constant

_CONDITION = 5  # tokens of class and box, in front of those of the points
_FORBIDDEN = -1e9  # logit
Draw = Callable[[Tensor], Tensor]  # from laws (n, t, tokens) to tokens (n, t)


class Elements(NamedTuple):
    """What the lines of one sample are generated from."""

    labels: Tensor  # class indices (n,)
    boxes: Tensor  # x0, y0, x1, y1 in whole pixels of the canvas (n, 4)


class PolylineGenerator(BaseModule):
    """Generate polylines of any number of points within boxes.

    Args:
        canvas: Where tokens lie.
        num_classes: Number of classes.
        in_channels: Channels of the BEV features.
        embed_dims: Channels C of the tokens; ``num_layers``, ``num_heads``, ``ffn_dims`` and
            ``dropout`` are the layers'.
        top_p: Share of the law that tokens are drawn from, 0 to take the most likely one.
        max_points: Points of a line at most.
        redraw: Whether every step draws all earlier tokens anew and shows these to the first layer,
            as released, where the line keeps those that were drawn first.
        noise_share: Share of the numbers that get noise in training.
        noise_px: Its standard deviations along x and y.
        box_noise_by_x: Whether noise sets y of a box to its x, as released by mistake.
        num_positions: Points of an annotated line at most.
        shrunk_results: Whether points are brought back to metres as if the canvas had no margin, as
            released, where the annotated ones that they are compared with are shrunk alike.

    Raises:
        ValueError: If a share is not in [0, 1], or a number of points is not positive.
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
                raise ValueError(f"{name} must be in [0, 1], got {share}.")
        if not 2 <= max_points <= num_positions:
            raise ValueError(
                f"max_points must be 2 to num_positions = {num_positions}, got {max_points}."
            )
        self.canvas, self.top_p, self.max_points, self.redraw = canvas, top_p, max_points, redraw
        self.noise_share, self.noise_px = noise_share, noise_px
        self.box_noise_by_x = box_noise_by_x
        self.metres: Callable[[Tensor], Tensor] = (
            canvas.grid.metres_from_norm if shrunk_results else canvas.metres_from_norm
        )
        self.context = CodedMap(in_channels, embed_dims)
        self.label = nn.Embedding(num_classes, embed_dims)
        self.vertex = nn.Embedding(canvas.num_tokens, embed_dims)
        self.position = nn.Embedding(num_positions, embed_dims)
        self.axis = nn.Embedding(2, embed_dims)
        self.corner = nn.Embedding(3, embed_dims)  # the third has no use, as released
        self.layers: Any = nn.ModuleList(
            GatedLayer(embed_dims, num_heads, ffn_dims, dropout) for _ in range(num_layers)
        )
        self.logits = nn.Linear(embed_dims, canvas.num_tokens)

    def init_weights(self) -> None:
        """Initialise the layers' matrices (Xavier)."""
        super().init_weights()
        for part in (self.layers, self.context, self.logits):
            init_matrices(part)

    def memory(self, bev_feats: Tensor) -> list[Cache]:
        """Return every layer's keys and values of a sample's map. (C', H, W)"""
        cells = self.context(bev_feats[None]).flatten(2).transpose(1, 2)
        return [layer.cross_attn.keys_values(cells) for layer in self.layers]

    def condition(self, elements: Elements) -> Tensor:
        """Return the embeddings of class and box. (n, 5, C)"""
        number = torch.arange(4, device=elements.boxes.device)
        box = self.vertex(elements.boxes) + self.corner(number // 2) + self.axis(number % 2)
        return torch.cat([self.label(elements.labels)[:, None], box], 1)

    def points(self, tokens: Tensor, start: int = 0) -> Tensor:
        """Return the embeddings of tokens of points, the first of which has a number. (n, T, C)"""
        number = torch.arange(start, start + tokens.shape[1], device=tokens.device)
        return self.vertex(tokens) + self.position(number // 2) + self.axis(number % 2)

    def allowed(self, logits: Tensor, start: int = 0) -> Tensor:
        """Return logits of tokens of which the first has a number, forbidden ones -1e9.

        No coordinate is beyond the canvas, and no line ends between x and y. (n, T, tokens)
        """
        token = torch.arange(self.canvas.num_tokens, device=logits.device)
        forbidden = torch.stack([token > self.canvas.size[0], token > self.canvas.size[1]])
        forbidden[1, 0] = True
        number = torch.arange(start, start + logits.shape[1], device=logits.device)
        return logits.masked_fill(forbidden[number % 2], _FORBIDDEN)

    def states(self, bev_feats: Tensor, elements: Elements, tokens: Tensor) -> list[Tensor]:
        """Return the states of all tokens behind each layer, given those before them.

        (C', H, W), tokens (n, T) -> (n, 5 + T, C) each
        """
        states = torch.cat([self.condition(elements), self.points(tokens)], 1)
        mask, found = causal_mask(states.shape[1], states.device), []
        for layer, memory in zip(self.layers, self.memory(bev_feats), strict=True):
            states = layer(states, layer.keys_values(states), memory, mask)
            found.append(states)
        return found

    def log_probs(self, bev_feats: Tensor, elements: Elements, tokens: Tensor) -> Tensor:
        """Return the log-probabilities of the next token, at the first and behind each.

        (C', H, W), tokens (n, T) -> (n, T + 1, tokens)
        """
        states = self.states(bev_feats, elements, tokens)[-1][:, _CONDITION - 1 :]
        return self.allowed(self.logits(states).float()).log_softmax(-1)

    def loss(
        self, bev_feats: Tensor, elements: Elements, tokens: Tensor, weights: Tensor
    ) -> Tensor:
        """Return the summed loss of a sample's lines.

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Annotated classes and boxes.
            tokens: Annotated tokens, each line's with its stop. (n, T)
            weights: Their weights, 0 behind the stop. (n, T)

        Raises:
            ValueError: If a line has more points than there are positions.
        """
        if tokens.shape[1] > 2 * self.position.num_embeddings + 1:
            raise ValueError(
                f"an annotated line has {tokens.shape[1] // 2} points, and num_positions of "
                f"PolylineGenerator is {self.position.num_embeddings}: set it higher, or "
                "tolerance_m of FormatPolylineTargets."
            )
        if not len(tokens):
            return torch.stack([parameter.sum() for parameter in self.parameters()]).sum() * 0
        given, boxes = tokens[:, :-1], elements.boxes
        if self.training and self.noise_share:
            given = self.noisy(given).where(given > 0, 0)
            boxes = self.noisy(boxes, self.box_noise_by_x)
        law = self.log_probs(bev_feats, Elements(elements.labels, boxes), given)
        return -(law.gather(-1, tokens[..., None])[..., 0] * weights).sum()

    def noisy(self, tokens: Tensor, by_x: bool = False) -> Tensor:
        """Return coordinates x, y, x, y, ... some of which are drawn anew around them. (n, T)"""
        axis = torch.arange(tokens.shape[1], device=tokens.device) % 2
        scale = constant(tokens, self.noise_px, torch.float)[axis]
        noise = (torch.randn(tokens.shape, device=tokens.device) * scale).round()
        chosen = torch.rand(tokens.shape, device=tokens.device) < self.noise_share
        return self.moved(tokens, noise.long(), by_x).where(chosen, tokens)

    def moved(self, tokens: Tensor, noise: Tensor, by_x: bool = False) -> Tensor:
        """Return coordinates plus noise, on the canvas; with ``by_x``, y is x. (n, T)"""
        number = torch.arange(tokens.shape[1], device=tokens.device)
        moved = (tokens + noise)[:, number // 2 * 2 if by_x else number]
        return moved.clamp(min=1).minimum(constant(tokens, self.canvas.size)[number % 2])

    @torch.no_grad()
    def generate(self, bev_feats: Tensor, elements: Elements, draw: Draw) -> Tensor:
        """Return the tokens of a sample's lines, 0 behind their end. (n, T)

        Args:
            bev_feats: BEV features of the sample. (C', H, W)
            elements: Classes and boxes of the lines.
            draw: Draws tokens (n, t) from laws (n, t, tokens).
        """
        memory, states = self.memory(bev_feats), self.condition(elements)
        start, number = states, 2 * self.max_points + 1
        tokens = elements.labels.new_zeros(len(states), number)
        alive = torch.arange(len(states), device=states.device)
        kept: list[Cache | None] = [None] * len(self.layers)
        laws = states.new_zeros(len(states), 0, self.canvas.num_tokens)
        for step in range(number if len(states) else 0):
            for i, layer in enumerate(self.layers):
                kept[i] = own = joined(kept[i], layer.keys_values(states))
                states = layer(states, own, memory[i])
            law = self.allowed(self.logits(states[:, -1:]).float(), step)
            law = most_likely(law, self.top_p).softmax(-1)
            laws = torch.cat([laws, law], 1) if self.redraw else law
            drawn = draw(laws)
            tokens[alive, step] = drawn[:, -1]
            going = drawn[:, -1] > 0
            if not going.any() or step == number - 1:
                break
            alive, laws, drawn, start = (p[going] for p in (alive, laws, drawn, start))
            kept = [(own[0][going], own[1][going]) for own in kept if own is not None]
            if self.redraw:
                first = torch.cat([start, self.points(drawn[:, :-1])], 1)
                kept[0] = self.layers[0].keys_values(first)
            states = self.points(drawn[:, -1:], step)
        return tokens

    def seeded_draw(self, seed: int) -> Draw:
        """Return a function that draws from laws, the same for the same seed."""
        source = torch.Generator(self.vertex.weight.device).manual_seed(seed)

        def draw(laws: Tensor) -> Tensor:
            found = laws.flatten(0, 1).multinomial(1, generator=source)
            return found.view(laws.shape[:2])

        return draw

    def lines(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return points in metres, the last one repeated, and their numbers. (n, P, 2), (n,)"""
        pairs = tokens[:, :-1].unflatten(1, (-1, 2))
        number = (pairs > 0).all(-1).sum(-1)
        index = torch.arange(pairs.shape[1], device=tokens.device)
        index = index.minimum((number[:, None] - 1).clamp(min=0))
        points = pairs.gather(1, index[..., None].expand(-1, -1, 2)) - 1
        steps = constant(pairs, self.canvas.steps, torch.float)
        return self.metres(points / steps), number


def causal_mask(number: int, device: torch.device) -> Tensor:
    """Return which tokens a token sees: those before it and itself, and the condition all of it.

    (number, number)
    """
    mask = torch.ones(number, number, dtype=torch.bool, device=device).tril()
    mask[:_CONDITION, :_CONDITION] = True
    return mask
