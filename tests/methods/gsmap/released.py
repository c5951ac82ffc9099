"""Training settings of the release."""

from dataclasses import replace

from released_settings import MAPTR

RELEASED = {
    # the paper, section 4.1; its batch as its README reads it
    "projects/GSMap/configs/gsmap_maptr_r50_24e.py": replace(MAPTR, batch=2),
}  # fmt: skip
