"""Configuration of a MiniCity data set, and the random numbers that follow from it."""

import hashlib
from dataclasses import asdict, dataclass

import numpy as np

from gsmap.utils.errors import InputError

VERSION = "v1.0-trainval"  # folder of the tables, as in nuScenes
FORMAT = 1  # version of the generator's output
# Names of places in nuScenes. Training and validation towns have different ones.
TRAIN_LOCATIONS = ("singapore-onenorth", "singapore-hollandvillage", "singapore-queenstown")
VAL_LOCATIONS = ("boston-seaport",)
# Numbers of names of scenes in the official split of nuScenes. Each pass of a scene needs a name.
MAX_TRAIN_SCENES = 700
MAX_VAL_SCENES = 150
MAX_PASSES = 20


@dataclass(frozen=True)
class MiniCityConfig:
    """Configuration of a MiniCity data set; equal configurations give equal bytes.

    Attributes:
        scenes: Number of scenes, training and validation together, >= 2.
        seed: Seed of every random choice, >= 0.
        image_width: Width of the camera images in pixels, in [64, 3200].
        image_height: Height of the camera images in pixels, in [36, 1800].
        samples_per_scene: Number of key frames per scene, half a second apart, in [1, 40].
        sweeps_per_sample: Number of LiDAR sweeps between two key frames, in [0, 9].
        val_scenes: Number of validation scenes among ``scenes``; None takes a fifth, at least one.
        passes: Number of drives (passes) through every scene, in [1, 20].
        repainted: Share of the streets that are repainted between two passes, in [0, 1].
        new_passes: Number of passes after the repainting, at least 1, and at most ``passes - 1`` if
            there are several passes. With one pass, it must be 1 and has no effect.

    Raises:
        ValueError: If a value is out of range.
    """

    scenes: int
    seed: int = 0
    image_width: int = 800
    image_height: int = 450
    samples_per_scene: int = 10
    sweeps_per_sample: int = 2
    val_scenes: int | None = None
    passes: int = 1
    repainted: float = 0.0
    new_passes: int = 1

    def __post_init__(self) -> None:
        """Check the range of every value."""
        if self.scenes < 2:
            raise InputError(
                f"scenes must be at least 2 (one to train, one to test), got {self.scenes}."
            )
        if self.seed < 0:
            raise InputError(f"seed must be >= 0, got {self.seed}.")
        if not (64 <= self.image_width <= 3200 and 36 <= self.image_height <= 1800):
            raise InputError(
                "image size must lie between 64x36 and 3200x1800, got "
                f"{self.image_width}x{self.image_height}."
            )
        if not 1 <= self.samples_per_scene <= 40:
            raise InputError(f"samples_per_scene must be in 1..40, got {self.samples_per_scene}.")
        if not 0 <= self.sweeps_per_sample <= 9:
            raise InputError(f"sweeps_per_sample must be in 0..9, got {self.sweeps_per_sample}.")
        if self.val_scenes is not None and not 1 <= self.val_scenes < self.scenes:
            raise InputError(f"val_scenes must be in 1..{self.scenes - 1}, got {self.val_scenes}.")
        self._check_passes()

    def _check_passes(self) -> None:
        """Check the passes, and that the official split has enough names for their scenes."""
        if not 1 <= self.passes <= MAX_PASSES:
            raise InputError(f"passes must be in 1..{MAX_PASSES}, got {self.passes}.")
        if not 0 <= self.repainted <= 1:
            raise InputError(f"repainted must be a share in 0..1, got {self.repainted}.")
        if self.repainted > 0 and self.passes == 1:
            raise InputError("repainted streets need a pass before and one after: passes >= 2.")
        most_new = max(1, self.passes - 1)
        if not 1 <= self.new_passes <= most_new:
            raise InputError(
                f"new_passes must be in 1..{most_new}, as one pass is driven before the "
                f"repainting, got {self.new_passes}."
            )
        train_names = self.num_train * self.passes
        val_names = self.num_val * self.passes
        if val_names > MAX_VAL_SCENES or train_names > MAX_TRAIN_SCENES:
            raise InputError(
                f"the official nuScenes split names at most {MAX_TRAIN_SCENES} training and "
                f"{MAX_VAL_SCENES} validation scenes, got {train_names} and {val_names}: "
                "ask for fewer scenes."
            )

    @property
    def num_val(self) -> int:
        """Number of validation scenes. The passes of a scene count once."""
        return self.val_scenes if self.val_scenes is not None else max(1, self.scenes // 5)

    @property
    def num_train(self) -> int:
        """Number of training scenes. The passes of a scene count once."""
        return self.scenes - self.num_val

    def as_dict(self) -> dict:
        """All values and the format version of the generator, as a dictionary for JSON.

        The dictionary identifies a data set: a folder is complete if its dictionary is equal.
        ``passes``, ``repainted`` and ``new_passes`` are left out if they have their default values.
        """
        values = {"format": FORMAT, **asdict(self), "val_scenes": self.num_val}
        for name in ("passes", "repainted", "new_passes"):
            if values[name] == getattr(MiniCityConfig, name):
                del values[name]
        return values


PRESETS = {
    "protocol_s": MiniCityConfig(
        scenes=400, seed=0, image_width=400, image_height=225, samples_per_scene=5
    ),
    "protocol_s_test": MiniCityConfig(
        scenes=101,
        seed=1000,
        image_width=400,
        image_height=225,
        samples_per_scene=5,
        val_scenes=100,
    ),
}
"""Data sets of the published comparisons.

``protocol_s`` has 1,600 training and 400 validation samples. ``protocol_s_test`` has 500 validation
samples in a town of another seed. It is for one final test of each model: no recipe, weight or
epoch may be chosen by it. It has a single training scene because the format requires one.
"""


def _digest(parts: tuple) -> bytes:
    """Hash of 16 bytes of some values, converted to text."""
    text = "|".join(map(str, parts))  # unlike Python's `hash`, equal in every process
    return hashlib.blake2b(text.encode(), digest_size=16).digest()


def make_rng(*parts: object) -> np.random.Generator:
    """Make a random generator whose state depends on ``parts`` alone, in every process."""
    words = np.frombuffer(_digest(parts), dtype=np.uint32)  # four integers as the seed
    return np.random.default_rng(words.tolist())


def make_token(*parts: object) -> str:
    """Make a token of 32 hexadecimal digits, as in nuScenes, that depends on ``parts`` alone."""
    # The first word keeps tokens apart from the seeds of `make_rng`.
    return _digest(("token", *parts)).hex()
