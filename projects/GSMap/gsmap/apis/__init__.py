"""A trained model on recorded samples; ``map_inferencer.MapInferencer`` is the entry."""
