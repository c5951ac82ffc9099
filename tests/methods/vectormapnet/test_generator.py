"""VectorMapNet's polyline generator: masks, cache, decoding, noise."""

import pytest
import torch
from methods.vectormapnet.cases import GRID, bev, generator

from gsmap.models.vectormapnet.canvas import Canvas
from gsmap.models.vectormapnet.generator import Elements, PolylineGenerator, causal_mask
from gsmap.models.vectormapnet.layers import keep_most_likely

ELEMENTS = Elements(
    torch.tensor([0, 1, 2]), torch.tensor([[3, 4, 90, 60], [5, 5, 9, 9], [100, 50, 199, 99]])
)


def feats():
    return bev()["bev_feats"][0]


def greedy(laws):
    return laws.argmax(-1)


def test_the_condition_sees_itself_and_points_what_is_before_them():
    mask = causal_mask(7, torch.device("cpu"))
    assert mask[:5, :5].all()
    assert not mask[:5, 5:].any()
    assert mask[5].tolist() == [True] * 6 + [False]


def test_kept_keys_and_values_say_what_one_pass_over_all_tokens_says():
    built = generator(top_p=0.0)
    tokens = built.generate(feats(), ELEMENTS, greedy)
    with torch.no_grad():
        law = built.log_probs(feats(), ELEMENTS, tokens[:, :-1])
    valid = torch.arange(tokens.shape[1]) <= (tokens > 0).sum(1, keepdim=True)
    assert valid.sum() > 10
    assert (law.argmax(-1) == tokens)[valid].all()


def test_a_line_does_not_depend_on_the_others():
    built = generator(top_p=0.0)
    tokens = built.generate(feats(), ELEMENTS, greedy)
    for i in range(3):
        alone = built.generate(feats(), Elements(*(part[i : i + 1] for part in ELEMENTS)), greedy)
        assert torch.equal(alone[0], tokens[i])


def test_a_line_may_have_as_many_points_as_there_are_positions():
    built = generator(top_p=0.0, num_positions=4, max_points=4)
    tokens = built.generate(feats(), ELEMENTS, lambda laws: laws[..., 1:].argmax(-1) + 1)
    assert tokens.shape == (3, 9)
    assert (tokens[:, :8] > 0).all()


def test_greedy_lines_are_the_same_whether_earlier_tokens_are_drawn_again():
    once, again = (
        generator(top_p=0.0, redraw=redraw).generate(feats(), ELEMENTS, greedy)
        for redraw in (False, True)
    )
    assert torch.equal(once, again)


def test_redrawn_tokens_reach_the_first_layer_alone():
    """With other earlier tokens the next law differs; with the same ones it does not."""
    found = []
    for other in (False, True):
        built, laws = generator(redraw=True), []

        def draw(given, other=other, laws=laws):
            laws.append(given[:, -1])
            tokens = torch.full(given.shape[:2], 7)
            if other:
                tokens[:, :-1] = 3
            return tokens

        tokens = built.generate(feats(), ELEMENTS, draw)
        assert (tokens == 7).all()
        found.append(laws)
    same, differing = (torch.equal(found[0][i], found[1][i]) for i in (1, 2))
    assert same
    assert not differing


def test_no_line_stops_between_x_and_y_nor_leaves_the_canvas():
    law = generator().log_probs(feats(), ELEMENTS, torch.ones(3, 3, dtype=torch.long)).exp()
    assert (law[:, 1::2, 0] == 0).all()
    assert (law[:, 1::2, 101:] == 0).all()
    assert (law[:, ::2] > 0).all()
    torch.testing.assert_close(law.sum(-1), torch.ones(3, 4))


def test_on_a_narrow_map_x_is_limited_too():
    narrow = PolylineGenerator(Canvas(type(GRID)((-15.0, 15.0), (-30.0, 30.0))), 3)
    logits = narrow.mask_forbidden(torch.zeros(1, 2, 201))
    assert (logits[0, 0] == 0).sum() == 101
    assert (logits[0, 1] == 0).sum() == 200


def test_the_tail_is_cut_where_the_mass_before_exceeds_the_share():
    law = torch.tensor([[0.2, 0.5, 0.3]])
    kept = {
        share: (keep_most_likely(law.log(), share) > -1e8)[0].tolist() for share in (0, 0.4, 0.6, 1)
    }
    assert kept[0] == [False, True, False]
    assert kept[0.4] == [False, True, False]
    assert kept[0.6] == [False, True, True]
    assert kept[1] == [True, True, True]


def test_a_seed_decides_what_is_drawn():
    built = generator(top_p=1.0)
    first, same, other = (
        built.generate(feats(), ELEMENTS, built.seeded_draw(seed)) for seed in (1, 1, 2)
    )
    assert torch.equal(first, same)
    assert not torch.equal(first, other)


def test_tokens_become_points_in_metres():
    tokens = torch.tensor([[1, 1, 200, 100, 0], [0, 0, 0, 0, 0], [5, 1, 7, 1, 9]])
    points, number = generator(max_points=2).lines(tokens)
    assert number.tolist() == [2, 0, 2]
    expected = torch.tensor([[-30.0, -15.0], [32.0, 17.0]])
    torch.testing.assert_close(points[0], expected)
    shrunk, _ = generator(max_points=2, shrunk_results=True).lines(tokens)
    torch.testing.assert_close(shrunk[0], torch.tensor([[-30.0, -15.0], [30.0, 15.0]]))


def test_noise_moves_some_numbers_and_stays_on_the_canvas():
    built = generator(noise_share=0.5)
    tokens = torch.tensor([[199, 99]]).repeat(1000, 1)
    torch.manual_seed(0)
    moved = built.add_noise(tokens)
    assert moved[:, 0].max() <= 200
    assert moved[:, 1].max() <= 100
    shares = (moved != tokens).float().mean(0)
    assert ((shares > 0.2) & (shares < 0.5)).all()
    assert built.shift(torch.tensor([[139, 54]]), torch.tensor([[-2, 1]])).tolist() == [[137, 55]]
    by_x = built.shift(torch.tensor([[139, 54]]), torch.tensor([[-2, 1]]), by_x=True)
    assert by_x.tolist() == [[137, 100]]


def test_the_loss_is_the_weighted_log_probability_of_the_next_token():
    built = generator()
    tokens = torch.tensor([[3, 4, 0, 0, 0], [5, 6, 7, 8, 0], [9, 9, 0, 0, 0]])
    weights = torch.tensor([[0.5, 0.5, 1, 0, 0], [0.2] * 5, [1.0, 0, 0, 0, 0]])
    law = built.log_probs(feats(), ELEMENTS, tokens[:, :-1])
    expected = -sum(law[i, t, tokens[i, t]] * weights[i, t] for i in range(3) for t in range(5))
    torch.testing.assert_close(built.loss(feats(), ELEMENTS, tokens, weights), expected)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"top_p must be in \[0, 1\], got 1.5"):
        generator(top_p=1.5)
    with pytest.raises(ValueError, match="max_points must be 2 to num_positions = 500, got 501"):
        generator(max_points=501)
    short, tokens = generator(num_positions=6), torch.ones(3, 15, dtype=torch.long)
    with pytest.raises(ValueError, match="has 7 points, and num_positions"):
        short.loss(feats(), ELEMENTS, tokens, torch.ones(3, 15))
