"""Cases of general tests for this method."""

STREAM_EXPORTS = ("configs/streammapnet/streammapnet_r18_minicity.py", {})
