"""MiniCity: procedural towns written in the nuScenes format."""
