"""Cases of general tests for this method."""

EXPORTS = {"as it is": ("configs/mgmap/mgmap_r18_minicity.py", {})}

LOSSES = ("masks", ())  # field of the ground truth; losses that may be zero
