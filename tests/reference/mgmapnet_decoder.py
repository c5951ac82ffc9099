"""MGMapNet: the decoder with its branches and masks, values and gradients."""

from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from gsmap.checkpoints.key_map import MGMAPNET
from gsmap.models.decoders.mgmapnet_decoder import MGMapNetDecoder
from gsmap.models.heads.references import PointReference, refine_reference
from gsmap.models.layers.mask_heads import (
    bev_mask_head,
    instance_mask_embedding,
    instance_mask_logits,
)
from gsmap.structures.grid import BEVGrid
from reference.golden import Golden
from reference.mgmapnet import GRAD_L2, B, C, GoldenParts, N, P, gradients_of
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm

FURTHER = 24  # one-to-many queries of the training set


class Head(nn.Module):
    """What a head puts around the decoder: queries, branches and masks."""

    def __init__(self) -> None:
        super().__init__()
        self.decoder = MGMapNetDecoder()
        self.instance_embedding = nn.Embedding(N + FURTHER, 2 * C)
        self.reference = PointReference(BEVGrid((-15, 15), (-30, 30), 1, 1))
        self.cls_branches = nn.ModuleList(self.cls_branch() for _ in range(6))
        masks = {"seg": bev_mask_head(C, 3), "ins_seg": instance_mask_embedding(C)}
        self.aux_heads = nn.ModuleDict(masks)

    @staticmethod
    def cls_branch() -> nn.Sequential:
        """Return one layer's classifier."""
        layers: list[nn.Module] = []
        for _ in range(2):
            layers += [nn.Linear(C, C), nn.LayerNorm(C), nn.ReLU()]
        return nn.Sequential(*layers, nn.Linear(C, 3))

    def forward(self, bev_feats: Tensor, attn_mask: Tensor | None = None) -> dict[str, Tensor]:
        """Return all predictions by the golden names; with a mask, of the further queries too."""
        chosen = self.instance_embedding.weight[: N if attn_mask is None else None]
        position, content = chosen.expand(B, -1, -1).split(C, 2)
        start = self.reference.initial(position).sigmoid()
        states = self.decoder(content, position, start, bev_feats, self.refine, attn_mask)
        scores = [b(s) for b, s in zip(self.cls_branches, states.instance_states, strict=True)]
        embeddings = self.aux_heads["ins_seg"](states.instance_states[-1])
        return {
            "init_reference": start[:, :, None].expand(-1, -1, P, -1),
            "instance_states": states.instance_states.transpose(1, 2),
            "point_states": states.point_states.unflatten(2, (-1, P)),
            "references": states.references.unflatten(2, (-1, P)),
            "mean_loc": states.mean_locations,
            "all_cls_scores": torch.stack(scores),
            "seg": self.aux_heads["seg"](bev_feats),
            "ins_seg": instance_mask_logits(embeddings, bev_feats),
        }

    def refine(self, layer: int, states: Tensor, reference: Tensor) -> Tensor:
        """Refine as `PointReference` does, in any precision."""
        return refine_reference(reference, self.reference.branches[layer](states))


DECODER_ROWS = {  # what the file holds of each output, and the tolerance
    "init_reference": (np.s_[:], 1e-5),
    "instance_states": (np.s_[..., ::2], 5e-4),
    "point_states": (np.s_[..., ::16], 5e-4),
    "references": (np.s_[:], 3e-5),
    "mean_loc": (np.s_[:], 3e-5),
    "all_cls_scores": (np.s_[:], 3e-4),
    "seg": (np.s_[:], 1e-4),
    "ins_seg": (np.s_[:, ::2], 3e-3),
}
LOSS_OF = {  # the outputs that the scalar weighs, by upstream's name, and their factor
    "all_cls_scores": ("all_cls_scores", 1.0),
    "all_pts_preds": ("references", 1.0),
    "all_MGA_Ref_preds": ("mean_loc", 1.0),
    "seg": ("seg", 1.0),
    "ins_seg": ("ins_seg", 0.01),
}


@check("mgmapnet_decoder_{variant}.npz")
def check_decoder(golden: Golden, name: str) -> Iterator[Row]:
    """Compare six layers with their branches and masks: values and gradients."""
    data, parts = golden.read_arrays(name), GoldenParts(golden)
    head = parts.load(Head(), "map_head.")
    with torch.no_grad():
        outputs = head(parts.bev)
    for key, (part, tolerance) in DECODER_ROWS.items():
        yield Row(name, key, largest_difference(outputs[key][part], data[key]), tolerance)
    yield from group_rows(name, data, parts, head)
    yield from decoder_gradient_rows(name, data, parts, head.double())


def decoder_gradient_rows(
    name: str, data: Mapping[str, np.ndarray], parts: GoldenParts, head: Head
) -> Iterator[Row]:
    """Compare gradients, ours in float64: in float32 a single ReLU that flips moves them by 1 %."""
    bev = parts.bev.double().requires_grad_()
    outputs = head(bev)
    scalar = sum(
        factor * (outputs[key] * parts.normal(f"mgm_gd_{theirs}", tuple(outputs[key].shape))).sum()
        for theirs, (key, factor) in LOSS_OF.items()
    )
    scalar.backward()
    yield Row(name, "scalar (relative)", largest_relative(scalar.item(), data["scalar"]), 1e-4)
    off = relative_norm(bev.grad.flatten(2).transpose(1, 2)[..., ::16], data["grad_bev_sub"])
    yield Row(name, "gradient of BEV (relative)", off, GRAD_L2)
    embedding = head.instance_embedding.weight.grad[:N]
    off = relative_norm(embedding, data["grad_instance_embedding"])
    yield Row(name, "gradient of the queries (relative)", off, GRAD_L2)
    yield from parts.gradient_rows(name, "", data, gradients_of(head, "map_head."))
    idle = [name for name, p in head.named_parameters() if p.grad is None]
    idle += [key for key in data["no_grad_keys"] if key not in MGMAPNET.unused]
    yield Row(name, "parameters that only one of us trains", len(idle), 0)


@torch.no_grad()
def group_rows(
    name: str, data: Mapping[str, np.ndarray], parts: GoldenParts, head: Head
) -> Iterator[Row]:
    """Compare the training queries: a mask keeps the groups apart in the self-attention only."""
    group = torch.arange(N + FURTHER) >= N
    outputs = head(parts.bev, group[:, None] != group)
    ours = {
        "one2one_cls": (outputs["all_cls_scores"][:, :, :N], 3e-4),
        "one2one_pts": (outputs["references"][:, :, :N], 3e-5),
        "one2many_cls": (outputs["all_cls_scores"][:, :, N:], 3e-4),
        "one2many_pts": (outputs["references"][:, :, N:], 3e-5),
        "one2many_mean_loc": (outputs["mean_loc"][-1, :, N:], 3e-5),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, f"train_{key}", largest_difference(value, data[f"train_{key}"]), tolerance)
