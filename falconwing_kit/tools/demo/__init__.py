"""demo: the kit's main job on recorded flights, and the figures of an identification."""
