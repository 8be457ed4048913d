"""One TOML file per airframe, read through `importlib.resources`."""
