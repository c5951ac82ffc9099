"""Network parts: detectors, BEV encoders, decoders, heads, losses, matching."""
