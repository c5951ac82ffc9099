import torch
from gsmap.models.decoders.gaussian_layer import GaussianDecoderLayer

from gsmap.models.decoders.map_decoder import refine_reference
from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid

SPACE = GaussianSpace(BEVGrid((-15, 15), (-30, 30), 1, 1))


def double_layer() -> GaussianDecoderLayer:
    """Return a small layer in float64 whose added parts are not neutral any more."""
    torch.manual_seed(0)
    settings = {"embed_dims": 8, "num_heads": 2, "num_sampling_points": 2, "ffn_dims": 8}
    layer = GaussianDecoderLayer(SPACE, dropout=0.0, **settings).double()
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return layer


def test_the_path_from_gaussians_through_the_layer_to_gaussians_has_its_true_gradient():
    layer = double_layer()
    query, position = torch.randn(2, 1, 3, 8, dtype=torch.float64)
    bev = torch.randn(1, 8, 6, 5, dtype=torch.float64)
    predict = torch.nn.Linear(8, 5).double()
    reference = torch.rand(1, 3, 5, dtype=torch.float64) * 0.6 + 0.2

    def gaussians(reference, query, bev):
        offsets = predict(layer(query, position, reference, bev))
        refined = SPACE.decode(refine_reference(reference, offsets))
        return torch.cat([refined.means, refined.scales, refined.rotations[..., None]], -1)

    inputs = [value.requires_grad_() for value in (reference, query, bev)]
    assert torch.autograd.gradcheck(gaussians, inputs)


def test_each_of_the_five_parameters_changes_where_the_layer_looks():
    layer = double_layer()
    query = torch.randn(1, 3, 8, dtype=torch.float64)
    reference = torch.full((1, 3, 5), 0.4, dtype=torch.float64)
    before = layer.cross_attn.sampling_locations(query, reference, (6, 5))
    for entry in range(5):
        changed = reference.clone()
        changed[..., entry] += 0.1
        after = layer.cross_attn.sampling_locations(query, changed, (6, 5))
        assert (after - before).abs().max() > 1e-3
