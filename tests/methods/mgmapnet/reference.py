"""MGMapNet: key table, BEV pyramid, attention and decoder layer, with gradients."""

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import torch
from reference.golden import Golden
from reference.maptr import state_rows
from reference.parts import GRAD_L2, GoldenParts
from reference.registry import check
from reference.report import Row, largest_difference, largest_relative, relative_norm
from torch import Tensor, nn

from gsmap.models.mgmapnet.attention import Granularities, MultiGranularityAttention
from gsmap.models.mgmapnet.decoder import MGMapNetDecoder
from gsmap.models.mgmapnet.keys import MGMAPNET

CONFIG = "mgmapnet/mgmapnet_r50_110e.py"
STATE = "mgmapnet_state.json"
B, N, P, C = 2, 12, 20, 256
BEV = (50, 26)
TAGS = {"first": 0, "later": 2}  # the layers whose weights the module's golden values have


class MGMapNetParts(GoldenParts):
    """MGMapNet's modules and inputs."""

    def __init__(self, golden: Golden) -> None:
        super().__init__(golden, "mgmapnet", MGMAPNET)

    def decoder(self) -> MGMapNetDecoder:
        """Return the pyramid and the first layers."""
        decoder = MGMapNetDecoder(num_layers=max(TAGS.values()) + 1)
        return self.load(decoder, "map_head.decoder.")

    @property
    def bev(self) -> Tensor:
        """BEV features. (B, C, H, W)"""
        tokens = self.normal("mgm_bev", (B, BEV[0] * BEV[1], C))
        return tokens.transpose(1, 2).unflatten(2, BEV)

    @property
    def reference(self) -> Tensor:
        """References. (B, N, P, 2)"""
        values = self.recipe.uniform("mgm_ref", (B, N, P, 2), 0.02, 0.98, self.golden.seed)
        return torch.from_numpy(values)

    def query(self, name: str) -> Tensor:
        """Instance queries ``mgm_query``, ``mgm_query_pos``, ``mgm_sin_pos``. (B, N, C)"""
        return self.normal(name, (N, B, C)).transpose(0, 1)

    def state(self, number: int) -> Granularities:
        """Return the queries that a layer starts from."""
        query = self.query("mgm_query")
        if not number:
            return Granularities(query)
        points = self.normal("mgm_point_pre", (B, N, P, C))
        return Granularities(query, points, self.normal("mgm_point_pe_pre", (B, N, P, C)))


@check(STATE)
def check_state(golden: Golden, name: str) -> Iterator[Row]:
    """Compare MGMapNet's state with ours."""
    yield from state_rows(golden, name, CONFIG)
    shapes = golden.state_shapes(name)
    made = {key: value for key, value in MGMAPNET.unused.items() if value is not None}
    wrong = [key for key, value in made.items() if tuple(value.shape) != shapes.get(key)]
    yield Row(name, "unused keys of another shape", len(wrong), 0)


@check("mgmapnet_patchmerge_{variant}.npz")
def check_pyramid(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the halved BEV features and the gradient."""
    data, parts = golden.read_arrays(name), MGMapNetParts(golden)
    pyramid = parts.decoder().bev_pyramid
    cells = parts.normal("mgm_pm_x", (B, BEV[0] * BEV[1], C)).requires_grad_()
    out = pyramid(cells.transpose(1, 2).unflatten(2, BEV))[1]
    tokens = out.flatten(2).transpose(1, 2)  # (B, h w, C)
    yield Row(name, "out", largest_difference(tokens.detach()[..., ::4], data["out"]), 1e-4)
    row = tokens.detach()[0, : BEV[1] // 2]
    yield Row(name, "out, first row", largest_difference(row, data["out_full_row0"]), 1e-4)
    (tokens * parts.normal("mgm_pm_g", tuple(tokens.shape))).sum().backward()
    off = relative_norm(cells.grad[..., ::8], data["grad_x_sub"])
    yield Row(name, "gradient of the features (relative)", off, GRAD_L2)
    prefix = "map_head.decoder.bev_pyramid."
    theirs = "pts_bbox_head.transformer.bev_downsample."
    yield from parts.gradient_rows(name, "", data, parts.gradients_of(pyramid, prefix, theirs))


def named(outputs: Granularities) -> dict[str, Tensor]:
    """Return the queries in the golden layout, by the golden names."""
    return {
        "instance": outputs.instances.transpose(0, 1),
        "point": outputs.points,
        "point_pe": outputs.point_code,
        "mean_loc": outputs.mean_locations,
    }


TOLERANCE = {"instance": 1e-4, "point": 1e-4, "point_pe": 2e-5, "mean_loc": 1e-5}


def query_rows(
    name: str, tag: str, data: Mapping[str, np.ndarray], outputs: Granularities, point_stride: int
) -> Iterator[Row]:
    """Compare the queries that a module returns."""
    strides = {"point": point_stride, "point_pe": 8}
    for key, value in named(outputs).items():
        ours = value.detach()[..., :: strides.get(key, 1)]
        off = largest_difference(ours, data[f"{tag}_{key}"])
        yield Row(name, f"{tag}: {key}", off, TOLERANCE[key])


@check("mgmapnet_attention_{variant}.npz")
def check_attention(golden: Golden, name: str) -> Iterator[Row]:
    """Compare the attention alone: what happens inside, outputs, gradients."""
    data, parts = golden.read_arrays(name), MGMapNetParts(golden)
    decoder = parts.decoder()
    start = MultiGranularityAttention().sampling_offsets.bias
    off = largest_difference(start.detach(), data["init_sampling_offsets_bias"])
    yield Row(name, "initial offsets", off, 1e-6)
    for tag, number in TAGS.items():
        attention = decoder.layers[number].cross_attn
        position = "mgm_sin_pos" if number else "mgm_query_pos"
        levels = [level.detach() for level in decoder.bev_pyramid(parts.bev)]
        inputs = {
            "query": parts.query("mgm_query"),
            "value": torch.cat([level.flatten(2) for level in levels], 2),  # (B, C, tokens)
            "ref": parts.reference,
            position.removeprefix("mgm_"): parts.query(position),
        }
        if number:
            _, inputs["point_pre"], inputs["point_pe_pre"], _ = parts.state(number)
        for value in inputs.values():
            value.requires_grad_()
        sizes = [level.shape[-2] * level.shape[-1] for level in levels]
        feats = [
            tokens.unflatten(2, level.shape[-2:])
            for tokens, level in zip(inputs["value"].split(sizes, 2), levels, strict=True)
        ]
        state = Granularities(*(inputs.get(key) for key in ("query", "point_pre", "point_pe_pre")))
        call = (state, inputs[position.removeprefix("mgm_")], inputs["ref"], feats)
        yield from inside_rows(name, tag, data, attention, call)
        outputs = attention(*call)
        yield from query_rows(name, tag, data, outputs, 2)
        scalar = sum(
            (value * parts.normal(f"mgm_g_{tag}_{short}", tuple(value.shape))).sum()
            for short, value in zip(
                ("ins", "pt", "pe", "loc"), named(outputs).values(), strict=True
            )
        )
        attention.zero_grad()
        scalar.backward()
        off = largest_relative(scalar.detach(), data[f"{tag}_scalar"])
        yield Row(name, f"{tag}: scalar (relative)", off, 1e-4)
        own = {k.removeprefix(f"{tag}_"): v for k, v in data.items() if k.startswith(f"{tag}_")}
        for key, value in inputs.items():
            ours = input_gradient(key, value.grad)
            off = relative_norm(ours, own[f"grad_{key}"])
            yield Row(name, f"{tag}: gradient of {key} (relative)", off, GRAD_L2)
        prefix = f"map_head.decoder.layers.{number}.cross_attn."
        theirs = f"pts_bbox_head.transformer.decoder.layers.{number}.attentions.1."
        gradients = parts.gradients_of(attention, prefix, theirs)
        yield from parts.gradient_rows(name, f"{tag}: ", own, gradients)


def input_gradient(key: str, gradient: Tensor) -> Tensor:
    """Return an input's gradient in the golden layout."""
    if key == "value":
        return gradient.permute(2, 0, 1)[..., ::16]
    if key.startswith("point"):
        return gradient[..., ::16]
    return gradient if key == "ref" else gradient.transpose(0, 1)


@torch.no_grad()
def inside_rows(
    name: str,
    tag: str,
    data: Mapping[str, np.ndarray],
    attention: MultiGranularityAttention,
    call: tuple,
) -> Iterator[Row]:
    """Compare what the attention computes on its way."""
    state, position, reference, feats = call
    samples = attention.compute_samples(state.instances + position, reference, feats)
    instances, points = attention.aggregate(feats, samples)
    point_code, instance_code = attention.codes(samples)
    exchanged = attention.attend_to_points(points, point_code, state)
    joined = exchanged + instances[:, :, None]
    out = attention.attend_to_instances(joined, point_code, instances, instance_code)
    values = torch.cat([attention.values(level.flatten(2).transpose(1, 2)) for level in feats], 1)
    ours = {  # (B, N, P, levels, heads, K) -> (B, N, heads, levels, P, K)
        "loc": (samples.locations.permute(0, 1, 4, 3, 2, 5, 6)[:, :, ::2], 1e-5),
        "w_instance": (samples.weights.permute(0, 1, 4, 3, 2, 5)[:, :, ::2].flatten(4), 1e-5),
        "agg_instance": (instances, 1e-4),
        "instance_pe": (instance_code, 2e-5),
        "agg_point": (points.flatten(0, 1)[..., ::4], 1e-4),
        "p2p_out": (exchanged.flatten(0, 1)[..., ::8], 1e-4),
        "p2i_in": (joined.flatten(1, 2)[..., ::8], 1e-4),
        "p2i_out": (out.flatten(1, 2)[..., ::8], 1e-4),
        "value_proj_sub": (values[:, ::20, :, ::4], 1e-4),
    }
    for key, (value, tolerance) in ours.items():
        yield Row(name, f"{tag}: {key}", largest_difference(value, data[f"{tag}_{key}"]), tolerance)


@check("mgmapnet_layer_{variant}.npz")
@torch.no_grad()
def check_layer(golden: Golden, name: str) -> Iterator[Row]:
    """Compare one decoder layer, without and with a mask between two groups of instances."""
    data, parts = golden.read_arrays(name), MGMapNetParts(golden)
    decoder = parts.decoder()
    feats = decoder.bev_pyramid(parts.bev)
    group = torch.arange(N) >= 8
    for tag, number in TAGS.items():
        layer = decoder.layers[number]
        layer.reference_code = Given(parts.query("mgm_sin_pos")) if number else None
        update = partial(
            layer.update_instances,
            parts.state(number),
            parts.query("mgm_query_pos"),
            parts.reference.flatten(1, 2),
            feats,
        )
        yield from query_rows(name, tag, data, update(None), 8)
        masked = update(group[:, None] != group)
        yield from query_rows(name, f"{tag}_masked", data, masked, 8)


class Given(nn.Module):
    """Stands for a position code: returns the tensor it was made with."""

    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.value = value

    def forward(self, _: Tensor) -> Tensor:
        return self.value
