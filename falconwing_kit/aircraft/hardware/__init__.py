"""hardware: what is bought, printed and soldered, as data: list of parts, cameras, the camera's filter, checklists."""
