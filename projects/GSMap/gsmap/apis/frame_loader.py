"""Batches of frames for inference, the broken ones set apart."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from mmengine.dataset import pseudo_collate
from torch.utils.data import DataLoader, Dataset, Subset

from gsmap.apis.blank_cameras import BlankCameraDataset


@dataclass(frozen=True)
class BrokenFrame:
    """A frame that cannot be used.

    Args:
        token: Its token.
        reason: Why, with the file's name.
    """

    token: str
    reason: str


class _Frames(Dataset):
    """Frames, or what is wrong with them."""

    def __init__(self, frames: BlankCameraDataset) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> dict[str, Any] | BrokenFrame:
        try:
            return self._frames[index]
        except (ValueError, OSError) as error:
            return BrokenFrame(self._frames.dataset.sample(index).token, str(error))


def _collate(items: Sequence[Any]) -> tuple[Any, list[BrokenFrame]]:
    """Put frames into one batch, None if there is none, and name the broken ones."""
    broken = [item for item in items if isinstance(item, BrokenFrame)]
    good = [item for item in items if not isinstance(item, BrokenFrame)]
    return (pseudo_collate(good) if good else None), broken


def frame_batches(
    frames: BlankCameraDataset, indices: Sequence[int] | None, batch_size: int, num_workers: int
) -> Iterator[tuple[Any, list[BrokenFrame]]]:
    """Read frames in their order.

    Args:
        frames: The frames.
        indices: Which; all by default.
        batch_size: Frames per batch.
        num_workers: Processes that read images.

    Yields:
        A batch of those that can be used, None if there is none, and the others.
    """
    chosen: Dataset = _Frames(frames)
    if indices is not None:
        chosen = Subset(chosen, list(indices))
    yield from DataLoader(
        chosen, batch_size=batch_size, num_workers=num_workers, collate_fn=_collate
    )
