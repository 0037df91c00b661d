"""core: frames, messages, flight files, checks and configuration. Imports nothing else of the kit."""
