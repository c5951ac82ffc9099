"""How a run starts, saves and resumes: launch arguments, config checks, checkpoint safety."""
