"""jobs: many tasks in parallel, with a cache of their results."""
