"""From a scene to a system: defaults, species, starting configuration, force terms, user code."""
