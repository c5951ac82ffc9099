"""Interface of the parts of a model that need targets from the training pipeline."""

from collections.abc import Mapping
from typing import Any, ClassVar


class NeedsTargets:
    """Base class of a head, loss or auxiliary head with targets from the training pipeline.

    Attributes:
        transforms: Names of the transforms that compute the targets; a training pipeline must have
            all of them.
    """

    transforms: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def target_settings(cls, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of the transforms that follow from the settings of this part.

        Args:
            settings: Settings of this part, including default values.
        """
        return {}
