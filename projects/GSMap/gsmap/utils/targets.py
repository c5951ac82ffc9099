"""What a part of a model needs of the training pipeline."""

from typing import ClassVar


class NeedsTargets:
    """A head, loss or auxiliary head that says which transforms make its targets.

    Attributes:
        transforms: Names of the transforms; a training pipeline without one is refused.
        shared: Settings that have one value in the part and in these transforms.
    """

    transforms: ClassVar[tuple[str, ...]] = ()
    shared: ClassVar[tuple[str, ...]] = ()
