"""What a part of a model needs of the training pipeline."""

from collections.abc import Mapping
from typing import Any, ClassVar


class NeedsTargets:
    """A head, loss or auxiliary head that names the transforms that make its targets.

    Attributes:
        transforms: Names of the transforms; a training pipeline without one is refused.
    """

    transforms: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of these transforms that follow from those of the part.

        Args:
            settings: Settings of the part, defaults included.
        """
        return {}
