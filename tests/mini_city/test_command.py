"""Arguments of the generator's command."""

from argparse import ArgumentParser, ArgumentTypeError, Namespace

import pytest

from minicity.cli import add_arguments, chosen_config, image_size


def test_parsing_the_image_size() -> None:
    assert image_size("800x450") == (800, 450)
    with pytest.raises(ArgumentTypeError, match="WIDTHxHEIGHT"):
        image_size("800")


def parsed(*words: str) -> Namespace:
    parser = ArgumentParser()
    add_arguments(parser)
    return parser.parse_args(["--root", "root", *words])


def test_presets_are_data_sets_of_fixed_size_and_seed() -> None:
    trained_on = chosen_config(parsed("--preset", "protocol_s"))
    assert trained_on.num_train * trained_on.samples_per_scene == 1600
    assert trained_on.num_val * trained_on.samples_per_scene == 400
    assert (trained_on.image_width, trained_on.image_height) == (400, 225)
    test = chosen_config(parsed("--preset", "protocol_s_test"))
    assert test.num_val * test.samples_per_scene == 500
    assert test.seed != trained_on.seed


def test_a_preset_refuses_other_sizes() -> None:
    with pytest.raises(ValueError, match="leave out --seed, --image-size"):
        chosen_config(parsed("--preset", "protocol_s", "--seed", "3", "--image-size", "64x36"))
    with pytest.raises(ValueError, match="--scenes NUMBER, or --preset NAME"):
        chosen_config(parsed())
