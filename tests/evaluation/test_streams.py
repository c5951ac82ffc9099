"""Files that are read sample by sample: any order and layout, the same figures, little memory."""

import json
import random
import tracemalloc
from operator import itemgetter
from pathlib import Path

import pytest

from benchmarks.evaluation import CLASSES, generated_frames, write_repeated_frames
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, chamfer_report, match_chamfer
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import CHUNK, SamplePairs, evaluate_files
from gsmap.evaluation.core.matches import MatchTable
from gsmap.evaluation.core.raster_ap import RasterConfig, match_raster, raster_report
from gsmap.evaluation.core.report import flat_metrics
from gsmap.evaluation.core.results_json import RESULTS_KEY, SampleFile

EVALUATOR = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES))
COUNT = 3 * CHUNK


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    return write_repeated_frames(tmp_path_factory.mktemp("race"), generated_frames(COUNT), COUNT)


def rewritten(path: Path, key: str, target: Path, change, **layout) -> Path:
    samples = json.loads(path.read_text())[key]
    change(samples)
    target.write_text(json.dumps({key: samples, "meta": {"GTs": [1]}}, **layout))
    return target


def test_order_and_layout_change_no_digit(files, tmp_path):
    results, truth = files
    wanted, wanted_notes = evaluate_files(results, truth, EVALUATOR)
    (note,) = wanted_notes  # generated lines wind out of the range
    assert note.startswith("ground truth reaches x ")
    shuffled = rewritten(truth, "GTs", tmp_path / "a.json", random.Random(0).shuffle, indent=2)
    last_first = rewritten(results, "results", tmp_path / "b.json", list.reverse, ensure_ascii=True)
    for pair in ((results, shuffled), (last_first, truth), (last_first, shuffled)):
        found, notes = evaluate_files(*pair, EVALUATOR)
        assert flat_metrics(found) == flat_metrics(wanted)
        assert notes == wanted_notes


def test_samples_that_lack_a_partner_are_counted_wherever_they_lie(files, tmp_path):
    results, truth = files

    def change(samples):
        del samples[1], samples[CHUNK:-1]
        samples.insert(0, {"sample_token": "other", "vectors": []})

    some = rewritten(results, "results", tmp_path / "a.json", change)
    left = CHUNK + 1
    with pytest.raises(ValueError, match=f"^{COUNT - left} samples have no results.*1 result has"):
        evaluate_files(some, truth, EVALUATOR)
    pairs = SamplePairs(some, truth, CLASSES, allow_mismatch=True)
    found = {token: (len(predictions), len(true)) for token, predictions, true in pairs}
    assert len(found) == COUNT
    everything = SamplePairs(results, truth, CLASSES)
    for number, (token, predictions, true) in enumerate(everything):
        known = number != 1 and (number <= CHUNK or number == COUNT - 1)
        assert found[token] == (len(predictions) * known, len(true))
    assert len(pairs.notes(False)) == 2


def test_memory_does_not_grow_with_the_file(tmp_path):
    frames, peaks = generated_frames(20), []
    for count in (800, 3200):
        results, _ = write_repeated_frames(tmp_path, frames, count)
        assert results.stat().st_size > 4000 * count
        tracemalloc.start()
        assert sum(1 for _ in SampleFile(results, RESULTS_KEY, CLASSES)) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 1_000_000  # the tokens; the file is 10 MB longer


def test_places_lead_to_the_same_elements_also_behind_letters_of_many_bytes(tmp_path):
    vectors = [{"pts": [[0, 1.5], [2, 3]], "cls_name": "divider", "confidence_level": 0.5}]
    samples = [{"vectors": vectors, "sample_token": f"Straße 東 {i}"} for i in range(3)]
    path = tmp_path / "a.json"
    content = {"ü": "東", RESULTS_KEY: samples, "n": 12}
    path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")
    file = SampleFile(path, RESULTS_KEY, CLASSES)
    for token, elements, place in file:
        start, length = place
        assert json.loads(path.read_bytes()[start : start + length])["sample_token"] == token
        again = file.load(token, place)
        assert again.points.tolist() == elements.points.tolist() == [[0, 1.5], [2, 3]]


def test_update_and_compute_give_the_figures_of_the_functions(files):
    samples = list(SamplePairs(*files, CLASSES))
    wanted = {}
    for config, match, report in (
        (ChamferConfig(CLASSES), match_chamfer, chamfer_report),
        (RasterConfig(CLASSES), match_raster, raster_report),
    ):
        found = [match(predictions, truth, config, token) for token, predictions, truth in samples]
        wanted |= report(MatchTable(found), config).metrics
    evaluator = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES))
    for _, predictions, truth in sorted(samples, key=itemgetter(0)):  # equal scores: by token
        evaluator.update(predictions, truth)
    assert evaluator.compute() == wanted
    assert evaluator.compute()["chamfer/num_samples"] == COUNT
    evaluator.reset()
    with pytest.raises(ValueError, match="no sample to score"):
        evaluator.compute()
    for token, predictions, truth in [*samples, samples[0]]:
        evaluator.update(predictions, truth, token)
    assert evaluator.compute() == wanted


@pytest.mark.parametrize("change", [list.reverse, list.clear])
def test_a_file_that_changes_while_samples_wait_is_named(files, tmp_path, change):
    """The files have opposite orders, so that samples wait by their places."""
    results, truth = files
    last_first = rewritten(truth, "GTs", tmp_path / "a.json", list.reverse)
    stream = iter(SamplePairs(results, last_first, CLASSES))
    next(stream)
    rewritten(last_first, "GTs", last_first, change)
    with pytest.raises(ValueError, match=r"a\.json was changed while it was read"):
        list(stream)
