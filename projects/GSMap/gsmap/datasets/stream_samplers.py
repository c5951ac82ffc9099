"""Samplers that keep the temporal order of the samples of each scene."""

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain, count, islice

import numpy as np
from mmengine.dist import get_dist_info
from mmengine.registry import DATA_SAMPLERS
from torch.utils.data import Sampler

from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.utils.errors import InputError, InputTypeError


def scenes_of(dataset: VectorizedMapDataset) -> list[list[int]]:
    """Return the indices of the samples of each scene in temporal order.

    Args:
        dataset: Data set without a wrapper.

    Raises:
        TypeError: If the data set is not a `VectorizedMapDataset`.
    """
    if not isinstance(dataset, VectorizedMapDataset):
        raise InputTypeError(
            f"streams need a VectorizedMapDataset, got {type(dataset).__name__}: a wrapper mixes "
            "the samples of its scenes."
        )
    return dataset.scenes()


class _Scene:
    """Endless source of the samples of a scene, as single frames or as pieces of the scene.

    A piece consists of consecutive samples in temporal order.

    Args:
        samples: Indices of the samples in temporal order.
        rng: Generator for the order of the frames and pieces and for the cuts between pieces.
        num_pieces: Number of pieces that the scene is cut into at random places.
        finish_singles: Whether the scene returns all of its single frames before its first piece,
            as in the public code of the method that introduced this training.
    """

    def __init__(
        self,
        samples: Sequence[int],
        rng: np.random.Generator,
        num_pieces: int,
        finish_singles: bool,
    ) -> None:
        self.samples = list(samples)
        self.rng = rng
        self.num_pieces = num_pieces
        self.finish_singles = finish_singles
        # Pieces, or single frames as lists of one sample, that are not returned yet.
        self.waiting: deque[list[int]] = deque()
        self.has_singles = False  # whether ``waiting`` has single frames

    def next_frames(self, in_pieces: bool) -> list[int]:
        """Return the next piece if ``in_pieces``, and otherwise the next single frame."""
        if in_pieces and self.has_singles and not self.finish_singles:
            self.waiting.clear()  # drop the remaining single frames
        if not self.waiting:
            self.waiting = self._draw_pieces() if in_pieces else self._draw_single_frames()
            self.has_singles = not in_pieces
        return self.waiting.popleft()

    def _draw_single_frames(self) -> deque[list[int]]:
        """Draw a random order of all samples."""
        order = self.rng.permutation(len(self.samples))
        return deque([self.samples[index]] for index in order)

    def _draw_pieces(self) -> deque[list[int]]:
        """Cut the scene at random places and draw a random order of the pieces."""
        num_pieces = min(self.num_pieces, len(self.samples))
        # A cut at k ends a piece before sample k. Every piece has at least one sample.
        possible_cuts = np.arange(1, len(self.samples))
        cuts = self.rng.choice(possible_cuts, size=num_pieces - 1, replace=False)
        pieces = np.split(np.array(self.samples), np.sort(cuts))
        order = self.rng.permutation(num_pieces)
        return deque(pieces[index].tolist() for index in order)


@DATA_SAMPLERS.register_module()
class StreamTrainSampler(Sampler[int]):
    """Sampler for streaming training: each place of the batch is a stream of consecutive samples.

    There are N = ``slots`` x ranks streams, one for each place of the batch on each rank. Random
    permutations of the scenes form an endless sequence, and stream j takes the entries j, j + N,
    j + 2 N and so on of this sequence. A scene is cut into pieces at random places, and a stream
    takes one piece of each of its scenes in turn. In the first iterations, it takes one random
    frame of each of its scenes instead. The samples depend only on the seed, the ranks and the
    epoch, so a resumed run continues with the samples of an uninterrupted run.

    Args:
        dataset: Data set without a wrapper.
        slots: ``batch_size`` of the data loader.
        single_frame_iters: Number of iterations with single frames.
        pieces: Number of pieces that a scene is cut into.
        late_switch: Whether a scene switches to pieces only after all of its single frames, as in
            the code that introduced this training. The scenes then switch at different times:
            after 1.6 times ``single_frame_iters`` iterations, half of the samples come from
            pieces.
        seed: Seed of the random numbers, equal on all ranks. None means 0.

    Raises:
        TypeError: If the data set is not a `VectorizedMapDataset`.
        ValueError: If ``slots`` or ``pieces`` is less than 1, or ``single_frame_iters`` negative.
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
        self.rank, self.num_ranks = get_dist_info()  # 0 and 1 if training is not distributed
        self.slots = slots
        self.pieces = pieces
        self.late_switch = late_switch
        self.single_frame_iters = single_frame_iters
        self.seed = seed or 0
        self.epoch = 0
        self.iters_per_epoch = max(1, len(dataset) // (slots * self.num_ranks))

    def __len__(self) -> int:
        """Return the number of samples of one epoch on this rank."""
        return self.iters_per_epoch * self.slots

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch. Its samples continue the streams of the previous epoch."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        start = self.epoch * self.iters_per_epoch
        # All batches of earlier epochs are drawn again, so that no state has to be saved.
        for batch in islice(self.batches(), start, start + self.iters_per_epoch):
            yield from batch

    def batches(self) -> Iterator[list[int]]:
        """Yield the batches of this rank from the first iteration of training, without end."""
        # All streams of this rank share these scenes, so each piece goes to one stream only.
        scenes = []
        for number, samples in enumerate(self.scenes):
            rng = np.random.default_rng([self.seed, self.rank, number])
            scene = _Scene(
                samples, rng=rng, num_pieces=self.pieces, finish_singles=self.late_switch
            )
            scenes.append(scene)
        first_stream = self.rank * self.slots
        orders = []  # numbers of the scenes of each stream of this rank, without end
        queues: list[deque[int]] = []  # samples of the current piece of each stream
        for slot in range(self.slots):
            orders.append(self._scene_order(first_stream + slot))
            queues.append(deque())
        for iteration in count():
            in_pieces = iteration >= self.single_frame_iters
            for queue, order in zip(queues, orders, strict=True):
                if not queue:
                    number = next(order)
                    queue.extend(scenes[number].next_frames(in_pieces))
            yield [queue.popleft() for queue in queues]

    def _scene_order(self, stream: int) -> Iterator[int]:
        """Yield the numbers of the scenes of a stream.

        A scene that would follow itself, at the border of two permutations, is skipped once.
        """
        previous = -1
        num_streams = self.slots * self.num_ranks
        for number in islice(self._permutations(), stream, None, num_streams):
            if number != previous or len(self.scenes) == 1:  # a single scene follows itself
                yield number
                previous = number
            else:
                previous = -1  # no scene has this number, so the next one is not skipped

    def _permutations(self) -> Iterator[int]:
        """Yield the numbers of all scenes in random order, without end."""
        # The seed contains no rank, so all ranks have equal permutations to share.
        rng = np.random.default_rng(self.seed)
        while True:
            yield from rng.permutation(len(self.scenes)).tolist()


@DATA_SAMPLERS.register_module()
class StreamTestSampler(Sampler[int]):
    """Sampler for streaming tests: whole scenes one after another, in temporal order.

    All samples of a scene go to one rank. The scenes are distributed so that the ranks have similar
    numbers of samples.

    Args:
        dataset: Data set without a wrapper.
        seed: Not used; mmengine passes it to all samplers.

    Raises:
        TypeError: If the data set is not a `VectorizedMapDataset`.
    """

    def __init__(self, dataset: VectorizedMapDataset, seed: int | None = None) -> None:
        rank, num_ranks = get_dist_info()
        num_samples = [0] * num_ranks
        self.scenes: list[list[int]] = []
        # Each scene goes to the rank with the fewest samples. Short scenes come last, because they
        # even out the differences that long scenes leave.
        longest_first = sorted(scenes_of(dataset), key=len, reverse=True)
        for scene in longest_first:
            least_loaded = num_samples.index(min(num_samples))
            num_samples[least_loaded] += len(scene)
            if least_loaded == rank:
                self.scenes.append(scene)

    def __len__(self) -> int:
        return sum(map(len, self.scenes))

    def __iter__(self) -> Iterator[int]:
        return chain.from_iterable(self.scenes)


@DATA_SAMPLERS.register_module()
class StreamBatches(Sampler[list[int]]):
    """Batch sampler for streaming tests with one sample of each of ``batch_size`` scenes.

    A scene that ends is replaced by the next one. No batch has two samples of one scene, so the
    last batches are smaller. Pass this sampler to a data loader as ``batch_sampler``.

    Args:
        sampler: Sampler of whole scenes.
        batch_size: Number of scenes in a batch.
    """

    def __init__(self, sampler: StreamTestSampler, batch_size: int) -> None:
        self.sampler = sampler
        self.batch_size = batch_size
        waiting = deque(sampler.scenes)  # scenes that have not begun
        active: list[deque[int]] = []  # remaining samples of the scenes in the current batch
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
