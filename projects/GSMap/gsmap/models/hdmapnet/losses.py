"""HDMapNet's losses: of classes, of instance embeddings, and of directions."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.models.hdmapnet.decoder import LineMaps
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class LineMapLosses:
    """Weights of the losses, and their settings, as in the release.

    Args:
        semantic: Weight of the classes' cross-entropy.
        pull: Weight of the distance of an instance's pixels from its mean embedding.
        push: Weight of the nearness of different instances.
        direction: Weight of the directions' cross-entropy.
        pos_weight: Weight of a class's own pixels in its cross-entropy.
        pull_margin: Distance from the mean that costs nothing.
        push_margin: Distance of two means that costs nothing.
    """

    semantic: float = 1.0
    pull: float = 1.0
    push: float = 1.0
    direction: float = 0.2
    pos_weight: float = 2.13
    pull_margin: float = 0.5
    push_margin: float = 3.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 0:
                raise InputError(f"losses.{name} must not be negative.")

    def __call__(self, maps: LineMaps, numbers: Tensor, directions: Tensor) -> dict[str, Tensor]:
        """Return the weighted losses.

        Args:
            maps: What the network says, of a batch.
            numbers: Which instance of a class a pixel belongs to, 0 for none. (B, classes, H, W)
            directions: Direction 1 to K forward and backward, 0 for none. (B, 2, H, W)
        """
        classes = torch.cat([(numbers == 0).all(1, keepdim=True), numbers > 0], 1)
        weight = constant(numbers, self.pos_weight, torch.float)
        semantic = F.binary_cross_entropy_with_logits(
            maps.semantic, classes.to(maps.semantic), pos_weight=weight
        )
        pairs = zip(maps.embedding, numbers.amax(1), strict=True)
        embeddings = [self.embedding_losses(*pair) for pair in pairs]
        pull, push = (torch.stack(parts).mean() for parts in zip(*embeddings, strict=True))
        return {
            "loss_semantic": self.semantic * semantic,
            "loss_pull": self.pull * pull,
            "loss_push": self.push * push,
            "loss_direction": self.direction * direction_loss(maps.direction, directions),
        }

    def embedding_losses(self, embedding: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far pixels are from their instance's mean, and how near means are.

        De Brabandere et al., 2017, Eqs. 1 and 2, with the mean of unordered pairs halved. Both are
        0 without an instance. (E, H, W), (H, W) -> (), ()
        """
        drawn = numbers > 0
        pixels = embedding[:, drawn].T  # (n, E)
        _, index, counts = numbers[drawn].unique(return_inverse=True, return_counts=True)
        if not len(counts):
            return embedding.sum() * 0, embedding.sum() * 0
        sums = pixels.new_zeros(len(counts), len(embedding)).index_add(0, index, pixels)
        means = sums / counts[:, None]
        away = ((pixels - means[index]).norm(dim=1) - self.pull_margin).clamp(min=0) ** 2
        pull = (away / counts[index]).sum() / len(counts)
        if len(counts) == 1:
            return pull, means.sum() * 0
        one, other = torch.triu_indices(len(counts), len(counts), 1, device=means.device)
        near = (self.push_margin - (means[one] - means[other]).norm(dim=1)).clamp(min=0) ** 2
        return pull, near.mean() / 2


def direction_loss(logits: Tensor, directions: Tensor) -> Tensor:
    """Return the cross-entropy of each direction by itself, a mean over the pixels of lines.

    (B, 1 + K, H, W), (B, 2, H, W)
    """
    classes = logits.shape[1]
    target = F.one_hot(directions, classes).sum(1).movedim(-1, 1).to(logits) / 2
    drawn = 1 - target[:, :1]
    each = F.binary_cross_entropy(logits.softmax(1), target, reduction="none")
    return (each * drawn).sum() / (drawn.sum() * classes).clamp(min=1)
