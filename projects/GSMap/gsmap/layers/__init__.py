"""BEV encoders and decoders."""
