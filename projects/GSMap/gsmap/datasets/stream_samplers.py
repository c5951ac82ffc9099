"""Samplers of drives: consecutive samples of a scene for each place of the batch, or in order."""

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain, islice

import numpy as np
from mmengine.dist import get_dist_info
from mmengine.registry import DATA_SAMPLERS
from torch.utils.data import Sampler

from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.utils.errors import InputError, InputTypeError


def scenes_of(dataset: VectorizedMapDataset) -> list[list[int]]:
    """Return the samples of each scene in the order of their times.

    Raises:
        TypeError: If the data set does not know its scenes, as a wrapped one.
    """
    if not isinstance(dataset, VectorizedMapDataset):
        raise InputTypeError(
            f"streams need a VectorizedMapDataset, got {type(dataset).__name__}: a wrapper mixes "
            "the samples of its scenes."
        )
    return dataset.scenes()


class _Scene:
    """Hands out a scene's samples, single ones or pieces in order.

    Args:
        samples: Its samples in order.
        rng: Draws what is handed out.
        pieces: Pieces that a pass in order is cut into, at random places.
        finish_singles: Hand out every single frame before the first piece, as released.
    """

    def __init__(
        self, samples: Sequence[int], rng: np.random.Generator, pieces: int, finish_singles: bool
    ) -> None:
        self.samples, self.rng = list(samples), rng
        self.pieces, self.finish_singles = pieces, finish_singles
        self.waiting: deque[list[int]] = deque()
        self.singles = True

    def visit(self, in_order: bool) -> list[int]:
        """Return the samples of the next visit."""
        if self.waiting and in_order and self.singles and not self.finish_singles:
            self.waiting.clear()
        if not self.waiting:
            self.waiting = self._sequences() if in_order else self._single_frames()
            self.singles = not in_order
        return self.waiting.popleft()

    def _single_frames(self) -> deque[list[int]]:
        order = self.rng.permutation(len(self.samples))
        return deque([self.samples[index]] for index in order)

    def _sequences(self) -> deque[list[int]]:
        count = min(self.pieces, len(self.samples))
        cuts = self.rng.choice(np.arange(1, len(self.samples)), count - 1, replace=False)
        parts = np.split(np.array(self.samples), np.sort(cuts))
        return deque(parts[index].tolist() for index in self.rng.permutation(count))


@DATA_SAMPLERS.register_module()
class StreamTrainSampler(Sampler[int]):
    """Hand each place of the batch the samples of one scene after another, in order.

    Over all ranks there are ``slots`` x ranks streams. Stream j takes scenes j, j + streams, ... of
    endless random permutations, and its next one when a piece of a scene is used up, so the streams
    change scenes at different times. The first iterations are single random frames. What comes
    depends on the seed, the ranks and the epoch alone, so a resumed run sees the same samples.

    Args:
        dataset: The data set.
        slots: The loader's ``batch_size``.
        single_frame_iters: Iterations of single frames.
        pieces: Pieces that a pass through a scene is cut into.
        late_switch: Let a scene change to pieces only when all of its single frames were handed
            out, as released: half of the samples are continued at 1.6 times the iterations.
        seed: Seed of all draws, the same on all ranks.

    Raises:
        TypeError: If the data set does not know its scenes.
        ValueError: If a number is not positive.
    """

    def __init__(
        self,
        dataset: VectorizedMapDataset,
        slots: int,
        single_frame_iters: int = 0,
        pieces: int = 2,
        late_switch: bool = False,
        seed: int | None = 0,
    ) -> None:
        if slots < 1 or pieces < 1 or single_frame_iters < 0:
            raise InputError(
                "slots and pieces must be >= 1 and single_frame_iters >= 0, got "
                f"{slots}, {pieces}, {single_frame_iters}."
            )
        self.scenes = scenes_of(dataset)
        self.rank, self.ranks = get_dist_info()
        self.slots, self.pieces, self.late_switch = slots, pieces, late_switch
        self.single_frame_iters, self.seed, self.epoch = single_frame_iters, seed or 0, 0
        self.iterations = max(1, len(dataset) // (slots * self.ranks))

    def __len__(self) -> int:
        """Return the samples of one epoch on this rank."""
        return self.iterations * self.slots

    def set_epoch(self, epoch: int) -> None:
        """Go to an epoch; the streams continue over its border."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        start = self.epoch * self.iterations
        for batch in islice(self.batches(), start, start + self.iterations):
            yield from batch

    def batches(self) -> Iterator[list[int]]:
        """Yield the endless batches of this rank, from the first iteration on."""
        scenes = [
            _Scene(
                samples,
                np.random.default_rng([self.seed, self.rank, number]),
                self.pieces,
                self.late_switch,
            )
            for number, samples in enumerate(self.scenes)
        ]
        orders = [self._scene_order(self.rank * self.slots + slot) for slot in range(self.slots)]
        waiting: list[deque[int]] = [deque() for _ in orders]
        iteration = 0
        while True:
            for slot, order in zip(waiting, orders, strict=True):
                if not slot:
                    in_order = iteration >= self.single_frame_iters
                    slot.extend(scenes[next(order)].visit(in_order))
            yield [slot.popleft() for slot in waiting]
            iteration += 1

    def _scene_order(self, stream: int) -> Iterator[int]:
        """Yield the scenes of a stream, none twice in a row if there are several."""
        last = -1
        for number in islice(self._permutations(), stream, None, self.slots * self.ranks):
            if number != last or len(self.scenes) == 1:
                yield number
                last = number
            else:
                last = -1  # it is skipped once only

    def _permutations(self) -> Iterator[int]:
        rng = np.random.default_rng(self.seed)
        while True:
            yield from rng.permutation(len(self.scenes)).tolist()


@DATA_SAMPLERS.register_module()
class StreamTestSampler(Sampler[int]):
    """Hand out whole scenes, each on one rank, one after another with their samples in order.

    Args:
        dataset: The data set.
        seed: Not used; mmengine gives it to every sampler.

    Raises:
        TypeError: If the data set does not know its scenes.
    """

    def __init__(self, dataset: VectorizedMapDataset, seed: int | None = None) -> None:
        rank, ranks = get_dist_info()
        loads = [0] * ranks
        self.scenes: list[list[int]] = []
        for scene in sorted(scenes_of(dataset), key=len, reverse=True):  # to whom has least to do
            chosen = loads.index(min(loads))
            loads[chosen] += len(scene)
            if chosen == rank:
                self.scenes.append(scene)

    def __len__(self) -> int:
        return sum(map(len, self.scenes))

    def __iter__(self) -> Iterator[int]:
        return chain.from_iterable(self.scenes)


@DATA_SAMPLERS.register_module()
class StreamBatches(Sampler[list[int]]):
    """Batches of a `StreamTestSampler`: as many scenes side by side, each with its next sample.

    For a loader's ``batch_sampler``. The last batches are smaller: no batch has two samples of one
    scene.

    Args:
        sampler: The sampler.
        batch_size: Scenes side by side.
    """

    def __init__(self, sampler: StreamTestSampler, batch_size: int) -> None:
        self.sampler, self.batch_size = sampler, batch_size
        waiting = deque(sampler.scenes)
        active: list[deque[int]] = []
        self.batches: list[list[int]] = []
        while waiting or active:
            while waiting and len(active) < batch_size:
                active.append(deque(waiting.popleft()))
            self.batches.append([scene.popleft() for scene in active])
            active = [scene for scene in active if scene]

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)
