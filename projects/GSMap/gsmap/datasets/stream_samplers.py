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
    """Return the indices of the samples of each scene in the order of their times.

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
    """Iterator over the samples of a scene, as single frames or as pieces in temporal order.

    Args:
        samples: Indices of the samples in temporal order.
        rng: Generator for the order of the frames and pieces and for the cuts between pieces.
        pieces: Number of pieces that the scene is cut into at random places.
        finish_singles: Whether all single frames come before the first piece, as in the release.
    """

    def __init__(
        self, samples: Sequence[int], rng: np.random.Generator, pieces: int, finish_singles: bool
    ) -> None:
        self.samples = list(samples)
        self.rng = rng
        self.pieces = pieces
        self.finish_singles = finish_singles
        self.waiting: deque[list[int]] = deque()
        self.has_singles = True  # whether ``waiting`` has single frames

    def visit(self, in_order: bool) -> list[int]:
        """Return the next piece if ``in_order``, else the next single frame."""
        drops_singles = in_order and self.has_singles and not self.finish_singles
        if drops_singles:
            self.waiting.clear()
        if not self.waiting:
            self.waiting = self._draw_pieces() if in_order else self._draw_single_frames()
            self.has_singles = not in_order
        return self.waiting.popleft()

    def _draw_single_frames(self) -> deque[list[int]]:
        """Draw a random order of all samples."""
        order = self.rng.permutation(len(self.samples))
        return deque([self.samples[index]] for index in order)

    def _draw_pieces(self) -> deque[list[int]]:
        """Cut the scene at random places and draw a random order of the pieces."""
        num_pieces = min(self.pieces, len(self.samples))
        places = np.arange(1, len(self.samples))
        cuts = self.rng.choice(places, size=num_pieces - 1, replace=False)
        pieces = np.split(np.array(self.samples), np.sort(cuts))
        order = self.rng.permutation(num_pieces)
        return deque(pieces[index].tolist() for index in order)


@DATA_SAMPLERS.register_module()
class StreamTrainSampler(Sampler[int]):
    """Sampler for streaming training: each place of the batch receives scenes in temporal order.

    There are ``slots`` x ranks streams, one for each place of the batch on each rank. An endless
    sequence of random permutations of the scenes is dealt to the streams in turn: stream j takes
    entries j, j + streams, j + 2 streams and so on. A stream goes to the next scene at the end of a
    piece, so the streams change scenes at different times. The first iterations have single random
    frames. The samples depend only on the seed, the ranks and the epoch, so a resumed run continues
    with the samples of an uninterrupted run.

    Args:
        dataset: Data set without a wrapper.
        slots: ``batch_size`` of the data loader.
        single_frame_iters: Number of iterations with single frames.
        pieces: Number of pieces that a scene is cut into.
        late_switch: Whether a scene switches to pieces only after all single frames, as in the
            release. Half of the samples continue a stream after 1.6 x ``single_frame_iters``.
        seed: Seed of the random numbers, equal on all ranks.

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
        self.rank, self.ranks = get_dist_info()
        self.slots = slots
        self.pieces = pieces
        self.late_switch = late_switch
        self.single_frame_iters = single_frame_iters
        self.seed = seed or 0
        self.epoch = 0
        self.iterations = max(1, len(dataset) // (slots * self.ranks))

    def __len__(self) -> int:
        """Return the number of samples of one epoch on this rank."""
        return self.iterations * self.slots

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch, which continues the streams of the previous epoch."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[int]:
        start = self.epoch * self.iterations
        for batch in islice(self.batches(), start, start + self.iterations):
            yield from batch

    def batches(self) -> Iterator[list[int]]:
        """Yield the batches of this rank without end, from the first iteration on."""
        scenes = []
        for number, samples in enumerate(self.scenes):
            rng = np.random.default_rng([self.seed, self.rank, number])
            scene = _Scene(samples, rng=rng, pieces=self.pieces, finish_singles=self.late_switch)
            scenes.append(scene)
        first_stream = self.rank * self.slots
        orders = []
        queues: list[deque[int]] = []
        for slot in range(self.slots):
            orders.append(self._scene_order(first_stream + slot))
            queues.append(deque())
        for iteration in count():
            in_order = iteration >= self.single_frame_iters
            for queue, order in zip(queues, orders, strict=True):
                if not queue:
                    scene = scenes[next(order)]
                    queue.extend(scene.visit(in_order))
            yield [queue.popleft() for queue in queues]

    def _scene_order(self, stream: int) -> Iterator[int]:
        """Yield the numbers of the scenes of a stream, not twice in a row if there are several."""
        previous = -1
        num_streams = self.slots * self.ranks
        for number in islice(self._permutations(), stream, None, num_streams):
            if number != previous or len(self.scenes) == 1:
                yield number
                previous = number
            else:
                previous = -1  # a further repetition is not skipped

    def _permutations(self) -> Iterator[int]:
        """Yield the numbers of all scenes in random order, without end."""
        rng = np.random.default_rng(self.seed)
        while True:
            yield from rng.permutation(len(self.scenes)).tolist()


@DATA_SAMPLERS.register_module()
class StreamTestSampler(Sampler[int]):
    """Sampler for streaming tests: whole scenes one after another, in temporal order.

    Each scene is on one rank. The scenes are distributed so that ranks have similar numbers of
    samples.

    Args:
        dataset: Data set without a wrapper.
        seed: Not used; mmengine passes it to all samplers.

    Raises:
        TypeError: If the data set is not a `VectorizedMapDataset`.
    """

    def __init__(self, dataset: VectorizedMapDataset, seed: int | None = None) -> None:
        rank, ranks = get_dist_info()
        num_samples = [0] * ranks
        self.scenes: list[list[int]] = []
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
    last batches are smaller. The sampler is for the ``batch_sampler`` of a data loader.

    Args:
        sampler: Sampler of whole scenes.
        batch_size: Number of scenes in a batch.
    """

    def __init__(self, sampler: StreamTestSampler, batch_size: int) -> None:
        self.sampler = sampler
        self.batch_size = batch_size
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
