"""MiniCity: a procedural town written in the nuScenes format."""
