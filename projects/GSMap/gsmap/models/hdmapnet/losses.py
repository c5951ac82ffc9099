"""HDMapNet's losses of classes, instance embeddings and directions."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.models.hdmapnet.decoder import LineMaps
from gsmap.structures.tensors import constant
from gsmap.utils.errors import InputError


@dataclass(frozen=True)
class LineMapLosses:
    """HDMapNet's losses with their weights, by default as in the released code.

    Args:
        semantic: Weight of the classification loss, a binary cross-entropy.
        pull: Weight of the pull loss: distances of the embeddings of an instance from their mean.
        push: Weight of the push loss: proximity of the mean embeddings of different instances.
        direction: Weight of the direction loss, a binary cross-entropy.
        pos_weight: Weight of positive pixels in the classification loss.
        pull_margin: Distance from the mean embedding up to which the pull loss is 0.
        push_margin: Distance of two mean embeddings from which the push loss is 0.

    Raises:
        ValueError: If a setting is negative.
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
        """Compute the weighted losses.

        Args:
            maps: Predictions of a batch: logits ``semantic`` of the background and the classes
                (B, 1 + classes, H, W), instance embeddings ``embedding`` (B, E, H, W), and logits
                ``direction`` of no direction and of K directions (B, 1 + K, H, W).
            numbers: Instance number of each pixel in each class, 0 for none. No two instances of a
                sample have the same number, even if their classes differ. (B, classes, H, W)
            directions: Index, 1 to K, of the forward and of the backward direction of the line at
                each pixel, 0 for no line. (B, 2, H, W)

        Returns:
            ``loss_semantic``, ``loss_pull``, ``loss_push`` and ``loss_direction``, all scalars. The
            pull and push losses are means over the samples.
        """
        background = (numbers == 0).all(dim=1, keepdim=True)
        classes = torch.cat([background, numbers > 0], dim=1)  # (B, 1 + classes, H, W)
        # A cached scalar on the device of `numbers`
        weight = constant(numbers, self.pos_weight, torch.float)
        semantic = F.binary_cross_entropy_with_logits(
            maps.semantic, classes.to(maps.semantic), pos_weight=weight
        )
        # A pixel has a line in at most one class, so the maximum is the number of this line.
        instances = numbers.amax(dim=1)  # (B, H, W)
        pull_terms = []
        push_terms = []
        for i, embedding in enumerate(maps.embedding):
            pull, push = self.embedding_losses(embedding, instances[i])
            pull_terms.append(pull)
            push_terms.append(push)
        return {
            "loss_semantic": self.semantic * semantic,
            "loss_pull": self.pull * torch.stack(pull_terms).mean(),
            "loss_push": self.push * torch.stack(push_terms).mean(),
            "loss_direction": self.direction * direction_loss(maps.direction, directions),
        }

    def embedding_losses(self, embedding: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the pull loss and the push loss of one sample.

        The losses follow De Brabandere et al., 2017, Eqs. 1 and 2, but the push loss is half of the
        mean over unordered pairs of instances. Both losses are 0 if there is no instance.

        Args:
            embedding: Instance embeddings. (E, H, W)
            numbers: Instance number of each pixel, 0 for none. (H, W)

        Returns:
            The pull loss and the push loss, two unweighted scalars.
        """
        is_instance = numbers > 0
        pixels = embedding[:, is_instance].T  # (n, E)
        # `index` is the instance of each pixel, from 0 without gaps, and `counts` the number of
        # pixels of each instance.
        _, index, counts = numbers[is_instance].unique(return_inverse=True, return_counts=True)
        if not len(counts):
            # The product is 0, and keeps the loss connected to the network with a gradient of 0.
            return embedding.sum() * 0, embedding.sum() * 0
        sums = pixels.new_zeros(len(counts), len(embedding)).index_add(0, index, pixels)
        means = sums / counts[:, None]  # (instances, E)
        distance = (pixels - means[index]).norm(dim=1)
        squared_excess = (distance - self.pull_margin).clamp(min=0) ** 2
        # The mean over the pixels of each instance, then over the instances.
        pull = (squared_excess / counts[index]).sum() / len(counts)
        if len(counts) == 1:  # no pair to push apart
            return pull, means.sum() * 0
        # The indices of all pairs of different instances, each pair once.
        first, second = torch.triu_indices(len(counts), len(counts), offset=1, device=means.device)
        separation = (means[first] - means[second]).norm(dim=1)
        squared_overlap = (self.push_margin - separation).clamp(min=0) ** 2
        return pull, squared_overlap.mean() / 2


def direction_loss(logits: Tensor, directions: Tensor) -> Tensor:
    """Compute the binary cross-entropy of the directions, averaged over the pixels of lines.

    Args:
        logits: Logits of no direction and of K directions. (B, 1 + K, H, W)
        directions: Forward and backward direction 1 to K of each pixel, 0 for none. (B, 2, H, W)

    Returns:
        Unweighted scalar.
    """
    num_classes = logits.shape[1]
    # On lines, the forward and the backward direction have a target probability of 1/2 each. Beside
    # lines, both indices are 0, which gives channel 0 ("no direction") a target of 2 * 1/2 = 1.
    counts = F.one_hot(directions, num_classes).sum(dim=1).movedim(-1, 1)  # (B, 1 + K, H, W)
    target = counts.to(logits) / 2
    is_line = 1 - target[:, :1]  # 1 on lines, 0 beside them. (B, 1, H, W)
    # As in the released code of HDMapNet, the softmax over the channels is followed by a binary
    # cross-entropy of each channel.
    loss = F.binary_cross_entropy(logits.softmax(dim=1), target, reduction="none")
    # The mean over the channels of all pixels of lines; 0 without lines.
    return (loss * is_line).sum() / (is_line.sum() * num_classes).clamp(min=1)
