"""Parts of MapTR as its paper or release prints them; paper.json has further numbers."""

from paper_cases import head_of


def test_detections_are_chosen_as_by_maptr():
    coder = head_of("configs/maptr/maptr_r50_24e.py").coder
    assert (coder.max_num, coder.margin_m, coder.score_threshold) == (50, 5.0, None)
